/** What a window shows of the cameras, as it states it to the vehicle. Pure; px of the full image, px of the screen, ms. */

import { placement, visible } from "./framing.js";
import { groundOf, groundPlacement, sharesOf } from "./ground.js";

/** @typedef {import("./framing.js").Rectangle} Rectangle */
/** @typedef {import("./projection.js").Point} Point */
/** @typedef {{x: number, y: number, width: number, height: number, screen_width: number, screen_height: number}} Seen */
/**
 * @typedef {{width: number, height: number, ratio: number, view: import("./framing.js").View}} Display
 * a box, CSS px; ratio: px of the screen in each
 */
/** @typedef {{columns: number, points: (Point|null)[]}} Grid of points of the image, in rows */

const LEAST_MS = 100; // between two statements
const AGAIN_MS = 500;
const MOST_PX = 65535; // that can be stated
const NOISE = 1e-6; // px, of computing
const SHARE = 0.02; // a smaller share of a picture cannot be told from none

/** @type {Readonly<Seen>} */
export const NOWHERE = Object.freeze({ x: 0, y: 0, width: 0, height: 0, screen_width: 0, screen_height: 0 });

/**
 * What a box shows of a camera.
 * @param {Rectangle} frame the region of the full image that is laid out in the box
 * @param {Display} display
 */
export function seenInBox(frame, display) {
  if (!(display.width > 0 && display.height > 0)) return NOWHERE;
  const { x, y, ...size } = visible(display, frame, display.view); // centred: mirroring changes nothing
  return seen({ x: frame.x + x, y: frame.y + y, ...size }, placement(display, frame, display.view).scale * display.ratio);
}

/**
 * What a box shows of a camera whose image is straightened.
 * @param {Rectangle} frame  @param {Display} display
 * @param {Grid} mesh of the straightened image, which has the size of the full one
 * @param {import("./framing.js").Size} full
 */
export function seenStraight(frame, display, mesh, full) {
  if (!(display.width > 0 && display.height > 0)) return NOWHERE;
  const { scale } = placement(display, full, display.view);
  const rows = mesh.points.length / mesh.columns;
  const cell_size = { width: full.width / (mesh.columns - 1), height: full.height / (rows - 1) };
  const part = visible(display, full, display.view);
  const isShown = (cell, first, length, step) => cell * step < first + length && (cell + 1) * step > first;
  const isUsed = (cell) => {
    const [column, row] = [cell % mesh.columns, Math.floor(cell / mesh.columns)];
    return isShown(column, part.x, part.width, cell_size.width) && isShown(row, part.y, part.height, cell_size.height);
  };
  const times = scale * display.ratio;
  return seenThrough(mesh, isUsed, { across: cell_size.width * times, down: cell_size.height * times }, frame);
}

/**
 * What the bird's-eye view shows of each camera.
 * @param {import("./ground.js").Sight[]} sights  @param {import("./ground.js").Lattice} lattice
 * @param {Rectangle[]} frames the region of each full image that pictures may show
 * @param {{width: number, height: number, ratio: number}} display
 * @param {import("./guides.js").Dimensions} dimensions
 */
export function seenFromAbove(sights, lattice, frames, display, dimensions) {
  const { width, height } = groundOf(dimensions);
  const scale = groundPlacement(display, dimensions).px_per_m * display.ratio;
  const steps = { across: (width / (lattice.columns - 1)) * scale, down: (height / (lattice.rows - 1)) * scale };
  const shares = sharesOf(sights, frames);
  const { columns } = lattice;
  return sights.map(({ points }, i) => {
    const isUsed = (cell) => cornersOf(cell, columns).some((corner) => shares[i][corner] >= SHARE);
    return seenThrough({ columns, points }, isUsed, steps, frames[i]);
  });
}

/**
 * The part of an image that a grid samples, as large as where it is magnified most.
 * @param {Grid} grid  @param {(cell: number) => boolean} isUsed whether a cell is shown, by its first corner
 * @param {{across: number, down: number}} steps between neighbouring vertices, px of the screen
 * @param {Rectangle} frame beyond which nothing is shown
 */
function seenThrough({ columns, points }, isUsed, steps, frame) {
  const box = { left: Infinity, top: Infinity, right: -Infinity, bottom: -Infinity };
  let scale = 0;
  const isBetween = (at, from, length) => at >= from && at <= from + length;
  const isInside = (point) => point && isBetween(point.x, frame.x, frame.width) && isBetween(point.y, frame.y, frame.height);
  const magnify = (a, b, step) => {
    if (isInside(a) && isInside(b)) scale = Math.max(scale, step / Math.hypot(a.x - b.x, a.y - b.y));
  };
  for (let i = 0; i + columns + 1 < points.length; i++) {
    if (i % columns === columns - 1 || !isUsed(i)) continue;
    const [a, b, c, d] = cornersOf(i, columns).map((corner) => points[corner]);
    for (const point of [a, b, c, d]) if (point) widen(box, point);
    for (const [from, to] of [[a, b], [c, d]]) magnify(from, to, steps.across);
    for (const [from, to] of [[a, c], [b, d]]) magnify(from, to, steps.down);
  }
  const [left, right] = [Math.max(frame.x, box.left), Math.min(frame.x + frame.width, box.right)];
  const [top, bottom] = [Math.max(frame.y, box.top), Math.min(frame.y + frame.height, box.bottom)];
  return seen({ x: left, y: top, width: right - left, height: bottom - top }, scale);
}

const cornersOf = (cell, columns) => [cell, cell + 1, cell + columns, cell + columns + 1];

function widen(box, { x, y }) {
  Object.assign(box, { left: Math.min(box.left, x), right: Math.max(box.right, x) });
  Object.assign(box, { top: Math.min(box.top, y), bottom: Math.max(box.bottom, y) });
}

/**
 * In whole px, with all of a part.
 * @param {Rectangle} part  @param {number} scale px of the screen for each px of the image  @returns {Seen}
 */
function seen({ x, y, width, height }, scale) {
  if (!(width > 0 && height > 0 && scale > 0)) return NOWHERE;
  const [left, top] = [Math.floor(x + NOISE), Math.floor(y + NOISE)];
  const [wide, high] = [Math.ceil(x + width - NOISE) - left, Math.ceil(y + height - NOISE) - top];
  return { x: left, y: top, width: wide, height: high, ...onScreen(wide, high, scale) };
}

const onScreen = (width, height, scale) => ({ screen_width: shown(width * scale), screen_height: shown(height * scale) });
const shown = (length) => Math.min(MOST_PX, Math.ceil(length - NOISE));

/**
 * What two displays of a camera show together: the smallest region with both, as large as either shows its own.
 * @param {Seen} one  @param {Seen} other  @returns {Seen}
 */
export function united(one, other) {
  if (!one.width || !other.width) return one.width ? one : other;
  const [x, y] = [Math.min(one.x, other.x), Math.min(one.y, other.y)];
  const width = Math.max(one.x + one.width, other.x + other.width) - x;
  const height = Math.max(one.y + one.height, other.y + other.height) - y;
  return { x, y, width, height, ...onScreen(width, height, Math.max(scaleOf(one), scaleOf(other))) };
}

const scaleOf = ({ width, height, screen_width, screen_height }) => Math.max(screen_width / width, screen_height / height);

/** When to state what is shown: on change, at most ten times a second, and again while it is unchanged. */
export class Stating {
  /** @type {string|null} */
  text = null; // last stated; null: nothing since the window connected
  at = -Infinity;

  /** Whether it may be time to: what is shown need not be looked at before. */
  isDue(now) {
    return now - this.at >= LEAST_MS;
  }

  /** Whether to state this now. @param {string} text  @param {number} now */
  states(text, now) {
    if (!this.isDue(now) || (text === this.text && now - this.at < AGAIN_MS)) return false;
    Object.assign(this, { text, at: now });
    return true;
  }
}
