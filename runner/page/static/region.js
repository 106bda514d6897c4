/** Regions of interest set by hand: zoomed, moved, kept in the full image's aspect ratio. Pure; px of the full image. */

export const SMALLEST = 16;

/** @typedef {import("./framing.js").Rectangle} Rectangle */
/** @typedef {import("./framing.js").Size} Size */

/**
 * The nearest region in whole px that lies inside the image and is not too small.
 * @param {Rectangle} region  @param {Size} full
 * @returns {Rectangle}
 */
export function inside({ x, y, width, height }, full) {
  const [wide, high] = [limit(Math.round(width), SMALLEST, full.width), limit(Math.round(height), SMALLEST, full.height)];
  return { x: limit(Math.round(x), 0, full.width - wide), y: limit(Math.round(y), 0, full.height - high), width: wide, height: high };
}

const limit = (value, low, high) => Math.max(low, Math.min(value, high));

/**
 * A region scaled by a factor about a point, which stays where it is, to within half a px. It keeps its aspect ratio until
 * one side reaches the image's; then only the other one grows, up to the full image.
 * @param {Rectangle} region  @param {{x: number, y: number}} point  @param {number} factor  @param {Size} full
 */
export function zoomed({ x, y, width, height }, point, factor, full) {
  const times = Math.max(factor, SMALLEST / width, SMALLEST / height);
  const [wide, high] = [Math.min(full.width, Math.round(width * times)), Math.min(full.height, Math.round(height * times))];
  const share = (at, from, length) => limit((at - from) / length, 0, 1);
  const [left, top] = [x + share(point.x, x, width) * (width - wide), y + share(point.y, y, height) * (height - high)];
  return inside({ x: left, y: top, width: wide, height: high }, full);
}

/** @param {Rectangle} region  @param {{x: number, y: number}} offset  @param {Size} full */
export const moved = ({ x, y, ...size }, offset, full) => inside({ x: x + offset.x, y: y + offset.y, ...size }, full);

/**
 * The largest part of a region with an aspect ratio, at the corner where a drag began.
 * @param {Rectangle} region  @param {number} aspect width / height  @param {{right: boolean, down: boolean}} towards where the drag went
 * @returns {Rectangle}
 */
export function withAspect({ x, y, width, height }, aspect, { right, down }) {
  const wide = Math.max(SMALLEST, SMALLEST * aspect, Math.min(width, height * aspect));
  const high = wide / aspect;
  return { x: right ? x : x + width - wide, y: down ? y : y + height - high, width: wide, height: high };
}
