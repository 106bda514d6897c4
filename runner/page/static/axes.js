/** Ranges and ticks of the charts. Pure. */

const LONGEST_S = 300;
const SPANS_S = [30, 60, 120, 180, 240, LONGEST_S];
const CLOSE = 0.04; // of the largest factor: the labels of two ticks that are nearer would overlap

/**
 * The axis of a drive that has lasted so long, s before now: it grows with the drive up to five minutes.
 * @param {number} lasted s
 * @returns {{range: [number, number], dtick: number}}
 */
export function timeAxis(lasted) {
  const span = SPANS_S.find((each) => each >= lasted) ?? LONGEST_S;
  return { range: [-span, 0], dtick: span / Math.max(3, Math.ceil(span / 60)) };
}

/**
 * Ticks at the factors S of all cameras, rising.
 * @param {{scaling: number[]}[]} cameras
 */
export function factorTicks(cameras) {
  const factors = [...new Set(cameras.flatMap(({ scaling }) => scaling))].sort((a, b) => a - b);
  const apart = CLOSE * (factors.at(-1) ?? 0);
  return factors.reduce((kept, each) => (each - (kept.at(-1) ?? -1) < apart ? kept : [...kept, each]), /** @type {number[]} */ ([]));
}
