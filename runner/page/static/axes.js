/** Ranges and ticks of the charts. Pure. */

const MAX_SPAN_S = 300;
const SPANS_S = [30, 60, 120, 180, 240, MAX_SPAN_S];
const LABEL_PX = 18; // a label and the space to the next one

/**
 * The time axis of the charts, in s before now: it grows with the drive up to five minutes.
 * @param {number} elapsed s since the drive began
 * @returns {{range: [number, number], dtick: number}}
 */
export function timeAxis(elapsed) {
  const span = SPANS_S.find((each) => each >= elapsed) ?? MAX_SPAN_S;
  return { range: [-span, 0], dtick: span / Math.max(3, Math.ceil(span / 60)) };
}

/** How many labels fit beside each other on a vertical axis, at least its ends. @param {number} high px */
export const ticksWithin = (high) => Math.max(2, Math.floor(high / LABEL_PX));

/**
 * The axis of the factors, with ticks at those of all cameras, in ascending order, where their labels do not overlap; the
 * largest one has its label.
 * @param {{scaling: number[]}[]} cameras
 * @param {number} highest of the factors that are drawn: mode S allows others
 * @param {number} high px
 * @returns {{range: [number, number], ticks: number[]}}
 */
export function factorAxis(cameras, highest, high) {
  const factors = [...new Set(cameras.flatMap(({ scaling }) => scaling))].sort((a, b) => b - a);
  const top = 1.05 * Math.max(highest, factors[0] ?? 1);
  const gap = (top * LABEL_PX) / high;
  const ticks = factors.reduce((kept, each) => ((kept[0] ?? Infinity) - each < gap ? kept : [each, ...kept]), /** @type {number[]} */ ([]));
  return { range: [0, top], ticks };
}
