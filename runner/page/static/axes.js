/** Ranges and ticks of the charts. Pure. */

const MAX_SPAN_S = 300;
const SPANS_S = [30, 60, 120, 180, 240, MAX_SPAN_S];
const MIN_GAP = 0.04; // of the largest factor: labels of closer ticks would overlap

/**
 * The time axis of the charts, in s before now: it grows with the drive up to five minutes.
 * @param {number} elapsed s since the drive began
 * @returns {{range: [number, number], dtick: number}}
 */
export function timeAxis(elapsed) {
  const span = SPANS_S.find((each) => each >= elapsed) ?? MAX_SPAN_S;
  return { range: [-span, 0], dtick: span / Math.max(3, Math.ceil(span / 60)) };
}

/**
 * Ticks at the factors S of all cameras, in ascending order.
 * @param {{scaling: number[]}[]} cameras
 */
export function factorTicks(cameras) {
  const factors = [...new Set(cameras.flatMap(({ scaling }) => scaling))].sort((a, b) => a - b);
  const gap = MIN_GAP * (factors.at(-1) ?? 0);
  return factors.reduce((kept, each) => (each - (kept.at(-1) ?? -1) < gap ? kept : [...kept, each]), /** @type {number[]} */ ([]));
}
