/**
 * The guides of one camera, drawn by the worker into a canvas of their own above its picture: in px of the screen, however few the
 * picture has, and only when they change.
 */

import { imageToBox, placement } from "./framing.js";
import { imageOf, pathGuides, straightGuides } from "./guides.js";
import { projection } from "./projection.js";
import { resize } from "./resizing.js";

export const COLOURS = { width: "#ffffff", distance: "#ffffff", path: "#5cd6ff" };
const LINE_WIDTHS = { width: 1.5, distance: 1.5, path: 3 }; // CSS px, on a picture of 960 px
const OUTLINE = 2; // CSS px, likewise
export const ESTIMATED = "ESTIMATED"; // label of what is computed for a camera that is not calibrated
const USUAL_PX = 960;
const STRAIGHT_PX = 0.25; // of the screen: points closer to a straight line are left out
export const STEERING_STEP_RAD = 1e-3; // a smaller change of the steering moves no line by a pixel

/** @typedef {{kind: string, metres: number|null, pieces: import("./projection.js").Point[][]}} Line */
/** @typedef {{lines: Line[], strokes: Map<string, Path2D>}} InCanvas lines in the canvas, px, and what is stroked for each kind */
/**
 * @typedef {object} Shown how a picture is shown
 * @property {import("./framing.js").Rectangle} region of the full image that it shows, px
 * @property {number|null} rad steering when it was captured; null: unknown
 * @property {import("./framing.js").Size} picture px of the canvas with the picture
 * @property {{width: number, height: number, ratio: number, view: import("./framing.js").View}} display its box, CSS px, and px per CSS px
 */

/** @type {InCanvas} */
const NOTHING = { lines: [], strokes: new Map() };

export class GuideLines {
  shown = false;
  isResizeDue = false; // whether the canvas keeps an old size for now
  /** @type {OffscreenCanvasRenderingContext2D|null} */
  context = null;
  /** @type {Line[]} */
  drawn = []; // in the canvas, px; empty: nothing is
  /** @type {{rad: number, lines: Line[]}} */
  paths = { rad: NaN, lines: [] }; // in the full image
  /** @type {{where: string, rad: number|null, straight: InCanvas, wheels: InCanvas}} */
  placed = { where: "", rad: null, straight: NOTHING, wheels: NOTHING };

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

  /** @param {OffscreenCanvas} canvas */
  attach(canvas) {
    this.context = canvas.getContext("2d", { desynchronized: true });
    this.drawn = [];
  }

  /** Set the picture's optics: straightened, or the original. @param {import("./projection.js").Optics} optics */
  setOptics(optics) {
    this.toImage = projection(optics);
    this.straight = this.straightLines();
    this.paths = { rad: NaN, lines: [] };
    this.placed.where = "";
  }

  straightLines() {
    return straightGuides(this.dimensions).map((guide) => this.project(guide));
  }

  project({ kind, metres, places }) {
    return { kind, metres, pieces: imageOf(places, this.toImage) };
  }

  /** The path for a steering angle, in the full image. */
  pathsFor(rad) {
    if (this.paths.rad !== rad) this.paths = { rad, lines: pathGuides(this.dimensions, rad).map((guide) => this.project(guide)) };
    return this.paths.lines;
  }

  /**
   * Draw the guides over a picture; those that have not moved since the last one take no time.
   * @param {Shown|null} seen null: no moving picture, or an unknown region
   */
  draw(seen) {
    const { context } = this;
    if (!context) return;
    if (!this.shown || !seen) return this.clear(context);
    const { display, picture } = seen;
    const [width, height] = [Math.round(display.width * display.ratio), Math.round(display.height * display.ratio)];
    this.isResizeDue = !resize(context.canvas, { width, height });
    if (this.isResizeDue) return this.clear(context); // in the old size, the browser would stretch them
    if (!this.place(seen) && this.drawn.length) return;
    this.clear(context);
    this.drawn = [...this.placed.straight.lines, ...this.placed.wheels.lines];
    const whole = placement(display, picture, display.view);
    const visible = inside(whole, display, display.ratio);
    context.save();
    context.beginPath();
    context.rect(visible.left, visible.top, visible.right - visible.left, visible.bottom - visible.top);
    context.clip(); // the box may be wider than its picture
    this.strokeAll(context, display.ratio * Math.min(1.5, Math.max(0.6, whole.width / USUAL_PX)));
    context.restore();
    labelDistances(context, this.drawn, visible, display.ratio);
    if (this.label) labelPicture(context, this.label, visible, display.ratio);
  }

  clear(context) {
    if (this.drawn.length) context.clearRect(0, 0, context.canvas.width, context.canvas.height);
    this.drawn = [];
  }

  /** Place the lines in the canvas. @param {Shown} seen  @returns {boolean} whether they have moved */
  place({ region, rad, picture, display }) {
    const { width, height, ratio, view } = display;
    const { x, y, width: wide, height: high } = region;
    const where = [x, y, wide, high, picture.width, picture.height, width, height, ratio, view.fit, view.mirrored].join();
    const rounded = rad === null ? null : STEERING_STEP_RAD * Math.round(rad / STEERING_STEP_RAD);
    const moved = where !== this.placed.where;
    if (!moved && rounded === this.placed.rad) return false;
    const inBox = imageToBox(display, picture, view, region);
    const toCanvas = (point) => {
      const at = inBox(point);
      return { x: at.x * ratio, y: at.y * ratio };
    };
    const straight = moved ? inCanvas(this.straight, toCanvas) : this.placed.straight;
    this.placed = { where, rad: rounded, straight, wheels: rounded === null ? NOTHING : inCanvas(this.pathsFor(rounded), toCanvas) };
    return true;
  }

  /** All outlines, and then the lines, so that no outline covers a line; those of one kind at once. */
  strokeAll(context, thick) {
    const strokes = [...this.placed.straight.strokes, ...this.placed.wheels.strokes];
    context.lineJoin = "bevel"; // the lines bend so little that round joins look the same and take longer
    context.strokeStyle = "rgba(0,0,0,0.55)";
    for (const [kind, path] of strokes) {
      context.lineWidth = thick * (LINE_WIDTHS[kind] + OUTLINE);
      context.stroke(path);
    }
    for (const [kind, path] of strokes) {
      context.lineWidth = thick * LINE_WIDTHS[kind];
      context.strokeStyle = COLOURS[kind];
      context.stroke(path);
    }
  }
}

/**
 * @param {Line[]} guides  @param {(point: import("./projection.js").Point) => import("./projection.js").Point} toCanvas
 * @returns {InCanvas}
 */
function inCanvas(guides, toCanvas) {
  const lines = guides.map((guide) => ({ ...guide, pieces: guide.pieces.map((piece) => piece.map(toCanvas)) }));
  const kinds = new Set(lines.map(({ kind }) => kind));
  return { lines, strokes: new Map([...kinds].map((kind) => [kind, pathOf(lines.filter((line) => line.kind === kind))])) };
}

/** @param {Line[]} lines */
function pathOf(lines) {
  const path = new Path2D();
  for (const { pieces } of lines)
    for (const piece of pieces) for (const [i, { x, y }] of withoutStraight(piece).entries()) i ? path.lineTo(x, y) : path.moveTo(x, y);
  return path;
}

/** A line without the points on its straight parts: each joint takes time to draw. @param {import("./projection.js").Point[]} points */
export function withoutStraight(points) {
  const kept = points.slice(0, 1);
  for (let i = 1, from = 0; i < points.length; i++) {
    const isLast = i === points.length - 1;
    if (!isLast && areNear(points, from, i + 1)) continue;
    kept.push(points[i]);
    from = i;
  }
  return kept;
}

/** Whether the points between two others are near the line through these, or near both if they coincide. */
function areNear(points, from, to) {
  const [a, b] = [points[from], points[to]];
  const [across, down] = [b.x - a.x, b.y - a.y];
  const squared = across * across + down * down; // without roots: this runs for each picture while the vehicle steers
  for (let i = from + 1; i < to; i++) {
    const [x, y] = [points[i].x - a.x, points[i].y - a.y];
    const product = x * down - y * across;
    if (squared ? product * product >= STRAIGHT_PX ** 2 * squared : x * x + y * y >= STRAIGHT_PX ** 2) return false;
  }
  return true;
}

/** @typedef {{left: number, top: number, right: number, bottom: number}} Sides */

/**
 * The part of a picture that is on the screen.
 * @param {import("./framing.js").Rectangle} whole in its box  @param {import("./framing.js").Size} box
 * @param {number} ratio px per unit of both
 * @returns {Sides}
 */
function inside({ x, y, width, height }, box, ratio) {
  const [left, top] = [Math.max(0, x), Math.max(0, y)];
  const [right, bottom] = [Math.min(box.width, x + width), Math.min(box.height, y + height)];
  return { left: left * ratio, top: top * ratio, right: right * ratio, bottom: bottom * ratio };
}

/** Write the distances next to the right ends of their lines, where there is room. @param {Sides} visible */
function labelDistances(context, lines, visible, css) {
  const size = fontSize(visible, 0.028, css);
  context.font = `600 ${size}px system-ui, "DejaVu Sans", sans-serif`;
  context.textAlign = "start";
  context.textBaseline = "middle";
  const { left, top, right, bottom } = visible;
  /** @type {{x: number, y: number}[]} */
  const labelled = [];
  for (const { metres, pieces } of lines.filter((line) => line.kind === "distance")) {
    const words = `${metres} m`;
    const ends = pieces.flatMap((piece) => [piece[0], piece[piece.length - 1]]).sort((a, b) => b.x - a.x);
    const wide = context.measureText(words).width + size;
    const at = ends.find(({ x, y }) => x >= left && x + wide <= right && y >= top + size && y <= bottom - size);
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
 * A label in the lower left corner of the visible part.
 * @param {OffscreenCanvasRenderingContext2D} context  @param {string} words
 * @param {{left: number, top: number, bottom: number}} visible  @param {number} css units of the drawing per CSS px
 */
export function labelPicture(context, words, { left, top, bottom }, css = 1) {
  const size = fontSize({ top, bottom }, 0.035, css);
  context.font = `700 ${size}px system-ui, "DejaVu Sans", sans-serif`;
  context.textAlign = "start";
  context.textBaseline = "middle";
  const wide = context.measureText(words).width + size;
  context.fillStyle = "#ffb000";
  context.fillRect(left, bottom - 1.5 * size, wide, 1.5 * size);
  context.fillStyle = "#000";
  context.fillText(words, left + size / 2, bottom - 0.75 * size);
}

const fontSize = ({ top, bottom }, share, css) => Math.round(Math.max(10 * css, share * (bottom - top)));
