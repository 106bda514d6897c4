/**
 * The guides of one camera, drawn by the worker into a canvas of its own above the picture's: sharp whatever the size of
 * the picture, and drawn only when they change.
 */

import { imageToBox, placement } from "./framing.js";
import { imageOf, pathGuides, straightGuides } from "./guides.js";
import { projection } from "./projection.js";
import { resize } from "./resizing.js";

export const COLOURS = { width: "#ffffff", distance: "#ffffff", path: "#5cd6ff" };
const LINE_WIDTHS = { width: 1.5, distance: 1.5, path: 3 }; // CSS px, on a picture of 960 px
export const ESTIMATED = "ESTIMATED"; // label of what is computed for a camera that is not calibrated
const USUAL_PX = 960;
export const STEERING_STEP_RAD = 1e-3; // a smaller change of the steering moves no line by a pixel

/** @typedef {{width: number, height: number, ratio: number, view: import("./framing.js").View}} Display a box on the screen, CSS px */
/**
 * @typedef {object} Seen a picture that was drawn
 * @property {import("./framing.js").Size} picture px
 * @property {import("./framing.js").Rectangle} region of the full image that it shows, px
 * @property {number|null} rad steering when it was captured; null: unknown
 */

export class GuideLayer {
  shown = false;
  drawn = "nothing yet"; // what the canvas shows
  /** @type {{kind: string, metres: number|null, pieces: import("./projection.js").Point[][]}[]} */
  lines = []; // for tests: the drawn lines, CSS px of the box
  /** @type {OffscreenCanvas|null} */
  canvas = null;
  /** @type {OffscreenCanvasRenderingContext2D|null} */
  context = null;

  /**
   * @param {import("./projection.js").Optics & {calibrated: boolean}} camera
   * @param {import("./guides.js").Dimensions} dimensions
   */
  constructor(camera, dimensions) {
    this.dimensions = dimensions;
    this.label = camera.calibrated ? "" : ESTIMATED;
    this.toImage = projection(camera);
    this.straight = this.straightLines();
  }

  /** Set the picture's optics: straightened, or the original. @param {import("./projection.js").Optics} optics */
  setOptics(optics) {
    this.toImage = projection(optics);
    this.straight = this.straightLines();
    this.drawn = "nothing yet";
  }

  straightLines() {
    return straightGuides(this.dimensions).map((guide) => this.project(guide));
  }

  attach(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d", { desynchronized: true });
    this.drawn = "nothing yet";
  }

  project({ kind, metres, places }) {
    return { kind, metres, pieces: imageOf(places, this.toImage) };
  }

  /**
   * Draw the guides that belong to a picture.
   * @param {Display} display
   * @param {Seen|null} seen null: no moving picture, or an unknown region
   */
  draw(display, seen) {
    const { canvas, context } = this;
    if (!canvas || !context) return;
    const target = this.shown && seen && display.width && display.height ? { ...seen, rad: seen.rad && STEERING_STEP_RAD * Math.round(seen.rad / STEERING_STEP_RAD) } : null;
    const described = JSON.stringify(target && [display, target]);
    if (described === this.drawn) return;
    context.reset(); // lines that no longer match disappear, whatever the size
    this.lines = [];
    if (target && !clearTo(context, display)) return;
    this.drawn = described;
    if (target) this.drawOn(context, display, target);
  }

  drawOn(context, display, { picture, region, rad }) {
    const shown = placement(display, picture, display.view);
    const toBox = imageToBox(display, picture, display.view, region);
    const thick = Math.min(1.5, Math.max(0.6, shown.width / USUAL_PX));
    const paths = rad === null ? [] : pathGuides(this.dimensions, rad).map((guide) => this.project(guide));
    context.scale(display.ratio, display.ratio);
    context.beginPath();
    context.rect(shown.x, shown.y, shown.width, shown.height);
    context.clip();
    const lines = (this.lines = [...this.straight, ...paths].map((guide) => ({ ...guide, pieces: guide.pieces.map((piece) => piece.map(toBox)) })));
    for (const { kind, pieces } of lines) for (const piece of pieces) stroke(context, piece, thick * (LINE_WIDTHS[kind] + 2), "rgba(0,0,0,0.55)");
    for (const { kind, pieces } of lines) for (const piece of pieces) stroke(context, piece, thick * LINE_WIDTHS[kind], COLOURS[kind]);
    const visible = visibleIn(display, shown);
    labelDistances(context, lines, visible);
    if (this.label) labelPicture(context, this.label, visible);
  }
}

/** The part of the box that the picture covers. */
function visibleIn({ width, height }, shown) {
  const [left, top] = [Math.max(0, shown.x), Math.max(0, shown.y)];
  return { left, top, right: Math.min(width, shown.x + shown.width), bottom: Math.min(height, shown.y + shown.height) };
}

function stroke(context, points, thick, colour) {
  context.lineWidth = thick;
  context.strokeStyle = colour;
  context.lineJoin = "round";
  context.beginPath();
  for (const { x, y } of points) context.lineTo(x, y);
  context.stroke();
}

/** Write the distances next to the right ends of their lines, where there is room. */
function labelDistances(context, lines, visible) {
  const size = fontSize(visible, 0.028);
  context.font = `600 ${size}px system-ui, "DejaVu Sans", sans-serif`;
  context.textBaseline = "middle";
  /** @type {{x: number, y: number}[]} */
  const labelled = [];
  for (const { metres, pieces } of lines.filter((line) => line.kind === "distance")) {
    const words = `${metres} m`;
    const ends = pieces.flatMap((piece) => [piece[0], piece[piece.length - 1]]).sort((a, b) => b.x - a.x);
    const wide = context.measureText(words).width + size;
    const at = ends.find(({ x, y }) => x >= visible.left && x + wide <= visible.right && y >= visible.top + size && y <= visible.bottom - size);
    if (!at || labelled.some(({ x, y }) => Math.abs(at.x - x) < wide && Math.abs(at.y - y) < 1.2 * size)) continue;
    labelled.push(at);
    context.lineWidth = size / 4;
    context.strokeStyle = "rgba(0,0,0,0.7)";
    context.strokeText(words, at.x + size / 2, at.y);
    context.fillStyle = "#fff";
    context.fillText(words, at.x + size / 2, at.y);
  }
}

/**
 * Clear a canvas that has the size of its box.
 * @param {OffscreenCanvasRenderingContext2D} context  @param {Omit<Display, "view">} display
 * @returns {boolean} whether it has; if not, it will be drawn later
 */
export function clearTo(context, { width, height, ratio }) {
  const isResized = resize(context.canvas, { width: Math.round(width * ratio), height: Math.round(height * ratio) });
  if (isResized) context.reset();
  return isResized;
}

/** A label in the lower left corner of the visible part. */
export function labelPicture(context, words, { left, top, bottom }) {
  const size = fontSize({ top, bottom }, 0.035);
  context.font = `700 ${size}px system-ui, "DejaVu Sans", sans-serif`;
  context.textAlign = "start";
  context.textBaseline = "middle";
  const wide = context.measureText(words).width + size;
  context.fillStyle = "#ffb000";
  context.fillRect(left, bottom - 1.5 * size, wide, 1.5 * size);
  context.fillStyle = "#000";
  context.fillText(words, left + size / 2, bottom - 0.75 * size);
}

const fontSize = ({ top, bottom }, share) => Math.round(Math.min(22, Math.max(10, share * (bottom - top))));
