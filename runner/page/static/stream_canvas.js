/** The canvas of one camera in the worker: its picture, what is written over it, and the lines on the ground. */

import { placement, visible, WHOLE } from "./framing.js";
import { ESTIMATED, GuideLines, labelPicture } from "./guide_lines.js";
import { drawNote, drawOverlay, drawUnsent, readably } from "./overlay.js";
import { enlarges, paintImage } from "./picture.js";
import { resize } from "./resizing.js";
import { STALLED } from "./status.js";
import { straightOptics } from "./straight.js";

/**
 * @typedef {object} Seen
 * @property {import("./stream.js").Shown|null} shown
 * @property {boolean} isStraight whether the picture is to be straightened
 * @property {Place|null} place of the picture in what the canvas shows; null: all of it
 * @property {string} status
 * @property {string} text of the alarm, "" for none
 * @property {string} note
 * @property {{region: import("./framing.js").Rectangle, rad: number|null}|null} steered of the guides
 * @typedef {{region: import("./framing.js").Rectangle, frame: import("./framing.js").Rectangle}} Place
 * regions of the full image: of the picture, and of the canvas
 */

export class StreamCanvas {
  /** @type {OffscreenCanvas|null} */
  canvas = null;
  /** @type {OffscreenCanvasRenderingContext2D|null} */
  context = null;
  isFresh = true; // whether nothing was painted into the canvas yet
  isPictureResizeDue = false; // whether the canvas keeps an old size for now
  display = { width: 0, height: 0, ratio: 1, view: WHOLE, covered: false };
  /** @type {string|null} */
  painted_text = ""; // text in the canvas, "" for the plain picture; null: to be painted again

  /** @param {any} camera as in hello  @param {any} dimensions of the vehicle */
  constructor(camera, dimensions) {
    this.camera = camera;
    this.guides = camera.pose && dimensions ? new GuideLines(camera, dimensions) : null;
  }

  /** @param {OffscreenCanvas} canvas  @param {OffscreenCanvas} lines above it */
  attach(canvas, lines) {
    this.canvas = canvas;
    this.isFresh = true;
    this.context = canvas.getContext("2d", { alpha: false, desynchronized: true });
    this.guides?.attach(lines);
    this.painted_text = null;
  }

  /** Whether it is shown. */
  get isShown() {
    return this.display.width > 0;
  }

  /** Whether a canvas waits for its new size. */
  get isResizeDue() {
    return this.isPictureResizeDue || Boolean(this.guides?.isResizeDue);
  }

  setStraight(on) {
    this.guides?.setOptics(on ? straightOptics(this.camera) : this.camera);
  }

  /** @param {Seen} seen  @returns {boolean} whether there is a canvas */
  paint({ shown, isStraight, place, status, text, note, steered }) {
    const { canvas, context } = this;
    if (!canvas || !context) return false;
    const laid = isStraight ? null : place;
    this.resize(canvas, shown, isStraight, laid, STALLED.includes(status));
    if (shown && !["off", "refused", "unsupported"].includes(status)) paintPicture(context, shown, isStraight, laid);
    else blank(context);
    this.guides?.draw(steered && { ...steered, picture: canvas, display: this.display });
    if (isStraight && shown?.image && !this.camera.calibrated && !this.guides?.shown) this.labelEstimate(context, canvas);
    const { mirrored } = this.display.view;
    if (note) drawNote(context, this.visibleArea(canvas), mirrored, note);
    if (text) drawOverlay(context, this.visibleArea(canvas), mirrored, status, text, this.perCssPx(canvas));
    this.painted_text = textOf(text, note);
    return true;
  }

  /** Whether it shows other texts than these. */
  isOutdated(text, note) {
    return this.context !== null && this.painted_text !== textOf(text, note);
  }

  /** Px of the canvas in a CSS px of the screen. */
  perCssPx(canvas) {
    return (canvas.width * this.display.ratio) / (this.widthOnScreen(canvas) || canvas.width);
  }

  /** For tests: the guides that are drawn, in CSS px of the picture's box. */
  guideLines() {
    const { ratio } = this.display;
    const inBox = ({ x, y }) => ({ x: x / ratio, y: y / ratio });
    return this.guides?.drawn.map((line) => ({ ...line, pieces: line.pieces.map((piece) => piece.map(inBox)) }));
  }

  /** A picture straightened by optics that nobody has measured says so, as lines on the ground do. */
  labelEstimate(context, canvas) {
    const area = this.visibleArea(canvas);
    const box = { left: 0, top: 0, bottom: area.height };
    readably(context, area, this.display.view.mirrored, () => labelPicture(context, ESTIMATED, box));
  }

  /**
   * The canvas has the picture's size. For a lasting alarm, and with a GPU, it is an integer multiple of it, close to the
   * size on the screen, so that words are sharp and small pictures are enlarged with a better kernel than the browser's,
   * while the aspect ratio, and with it the page's layout, stays the same.
   */
  resize(canvas, shown, isStraight, place, sharp) {
    const { width: wide, height: high, ratio } = this.display;
    const box = { width: Math.round(wide * ratio) || 480, height: Math.round(high * ratio) || 270 };
    const painted = shown && place ? sizeWith(shown.picture.painted, place, this.camera) : shown?.picture.painted;
    const own = isStraight ? (shown?.image ?? this.straightSize()) : (painted ?? box);
    const times = sharp || (enlarges() && !isStraight) ? Math.min(6, Math.max(1, Math.ceil(this.widthOnScreen(own) / own.width))) : 1;
    const size = { width: own.width * times, height: own.height * times };
    if (this.isFresh) Object.assign(canvas, size); // nothing is shown yet
    this.isPictureResizeDue = !resize(canvas, size);
    this.isFresh = false;
  }

  /** A straightened image has the resolution of the screen, but at most the camera's. */
  straightSize() {
    const { width, height } = this.camera;
    const wide = Math.round(Math.min(width, this.widthOnScreen(this.camera) || width));
    return { width: wide, height: Math.round((wide * height) / width) };
  }

  /** Width of a picture on the screen, including cropped parts, in px of the screen; 0: not known yet. */
  widthOnScreen(picture) {
    const { ratio, view } = this.display;
    return placement(this.display, picture, view).width * ratio;
  }

  /** The part of the canvas that is on the screen. */
  visibleArea({ width, height }) {
    const { display } = this;
    const isPlaced = display.width && display.height;
    return isPlaced ? visible(display, { width, height }, display.view) : { x: 0, y: 0, width, height };
  }
}

const textOf = (...texts) => texts.filter(Boolean).join("\n");

/**
 * Size of a canvas with the aspect ratio of the frame, in which no side of a picture is smaller than its own; at most the camera's.
 * @param {import("./framing.js").Size} painted  @param {Place} place  @param {import("./framing.js").Size} camera
 */
function sizeWith(painted, { region, frame }, camera) {
  const scale = Math.max(painted.width / region.width, painted.height / region.height);
  const times = Math.min(scale, camera.width / frame.width, camera.height / frame.height);
  const sideOf = (length) => Math.max(1, Math.round(length * times));
  return { width: sideOf(frame.width), height: sideOf(frame.height) };
}

/**
 * @param {OffscreenCanvasRenderingContext2D} context  @param {import("./stream.js").Shown} shown  @param {boolean} isStraight
 * @param {Place|null} place
 */
function paintPicture(context, { picture, image = null }, isStraight, place) {
  const { width, height } = context.canvas;
  const all = { x: 0, y: 0, width, height };
  if (place) drawUnsent(context, width, height);
  if (!isStraight) picture.paint(context, place ? boxOf(place, all) : all);
  else if (image) paintImage(context, image, all);
  else blank(context);
}

/** Where in a canvas a picture is. @param {Place} place  @param {import("./framing.js").Size} canvas */
function boxOf({ region, frame }, { width, height }) {
  const [across, down] = [width / frame.width, height / frame.height];
  const [x, y] = [(region.x - frame.x) * across, (region.y - frame.y) * down];
  return { x, y, width: region.width * across, height: region.height * down };
}

function blank(context) {
  context.fillStyle = "#0b0e11";
  context.fillRect(0, 0, context.canvas.width, context.canvas.height);
}
