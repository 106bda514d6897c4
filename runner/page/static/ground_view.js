/**
 * The bird's-eye view, drawn by the worker from the pictures of the cameras that look down. A second canvas above it holds
 * what does not change with every picture: the vehicle, distances, and which pictures are not live.
 */

import { apart, groundOf, groundPlacement, latticeOf, outline, sharesOf, sightOf, trianglesOf } from "./ground.js";
import { COLOURS, ESTIMATED, labelPicture, STEERING_STEP_RAD } from "./guide_lines.js";
import { pathGuides } from "./guides.js";
import { AMBER, frame, RED } from "./overlay.js";
import { ENOUGH } from "./pace.js";
import { RemoteWarp, UNANSWERED } from "./remote_warp.js";
import { resize } from "./resizing.js";
import { MOVING, STALLED } from "./status.js";

const DISTANCES_M = [5, 2, 1]; // from the vehicle, the farthest first
const LINE = 1.4; // height of a line of text, of its size
const LABEL_M = 4; // distance from a camera to the label of its status
const FONT = 'system-ui, "DejaVu Sans", sans-serif';

/** @typedef {import("./stream.js").Stream} Stream */
/** @typedef {import("./guides.js").Dimensions} Dimensions */

export class GroundView {
  shown = false;
  display = { width: 0, height: 0, ratio: 1 }; // the box on the screen, CSS px
  /** @type {{picture: string, frames: string, lines: string}} */
  drawn = { picture: "", frames: "", lines: "" }; // what the canvases show
  count = 0; // of the pictures drawn
  session = 0; // counts how often it was hidden or got other cameras: what was ordered before is not on the screen
  /** @type {string[]} */
  drawn_labels = []; // labels of the cameras when the displayed picture was drawn
  why = ""; // why it cannot be drawn any more, for the operator
  /** @type {RemoteWarp|null} */
  warp = null;
  /** @type {Stream[]} */
  streams = [];
  /** @type {import("./remote_warp.js").RemoteLayer[]} */
  layers = [];
  /** @type {import("./ground.js").Sight[]} */
  sights = [];
  /** @type {import("./ground.js").Lattice|null} */
  lattice = null;
  shared_regions = ""; // for which the shares were computed
  /** @type {OffscreenCanvas|null} */
  canvas = null;
  /** @type {OffscreenCanvasRenderingContext2D|null} */
  context = null;
  /** @type {Dimensions|null} */
  dimensions = null;

  /** @param {import("./steering.js").Steering} steering  @param {(why: string) => void} onFailed called once, for the operator */
  constructor(steering, onFailed) {
    this.steering = steering;
    this.onFailed = onFailed;
  }

  /** @param {OffscreenCanvas} picture  @param {OffscreenCanvas} lines */
  attach(picture, lines) {
    this.canvas = picture;
    this.context = lines.getContext("2d", { desynchronized: true });
  }

  /**
   * Set the vehicle's cameras that look down.
   * @param {Stream[]} streams  @param {Dimensions|null} dimensions
   */
  setCameras(streams, dimensions) {
    this.session++;
    for (const layer of this.layers) layer.dispose();
    const nothing = { layers: [], sights: [], lattice: null, shared_regions: "", drawn_labels: [] };
    const drawn = { picture: "", frames: "", lines: "" };
    Object.assign(this, { streams: dimensions ? streams : [], dimensions, drawn, ...nothing });
    this.updateStreams();
  }

  /** Show it in a box on the screen, or hide it. @param {{shown: boolean, width: number, height: number, ratio: number}} display */
  show({ shown, ...display }) {
    Object.assign(this, { shown, display, drawn_labels: [], drawn: { picture: "", frames: "", lines: "" } });
    this.updateStreams();
    if (this.isOn()) this.draw();
    else this.hide();
  }

  /** Otherwise a stale picture would appear when it is shown again. */
  hide() {
    this.session++;
    if (this.warp && !this.why) this.order({ width: 1, height: 1 }, { x: 0, y: 0, width: 1, height: 1 }, []);
    this.context?.reset();
  }

  /** Set whether the streams' full-size pictures are needed. */
  updateStreams() {
    for (const stream of this.streams) stream.setInBirdseye(this.isOn() && !this.why);
  }

  isOn() {
    return this.shown && this.streams.length > 0 && this.display.width > 0 && this.display.height > 0;
  }

  /** Whether it is on the screen. */
  isDrawing() {
    return this.isOn() && this.canvas !== null && this.context !== null && !this.why;
  }

  /** Draw what has changed: pictures or their status. */
  draw() {
    if (!this.isDrawing()) return;
    const seen = this.streams.map((stream) => stream.fromAbove());
    this.prepare();
    this.drawPictures(seen);
    this.drawLines(seen);
  }

  /** Slow initialisation, done when first needed. */
  prepare() {
    this.warp ??= new RemoteWarp(/** @type {OffscreenCanvas} */ (this.canvas));
    if (this.layers.length || !this.dimensions) return;
    const { warp, dimensions, streams } = this;
    const lattice = (this.lattice = latticeOf(groundOf(dimensions).extent));
    const fromAbove = lattice.places.map(({ x, y }) => ({ x: -y, y: x }));
    this.sights = streams.map(({ camera }) => sightOf(camera, dimensions, lattice.places));
    this.layers = this.sights.map(({ points }) => warp.layer(fromAbove, points));
  }

  drawPictures(seen) {
    const { warp, layers, dimensions, display, drawn } = this;
    if (!warp || !dimensions) return;
    if (warp.lost) return this.fail(`${warp.lost}; reload the page`);
    const size = warp.sizeFor({ width: display.width * display.ratio, height: display.height * display.ratio });
    const picture = JSON.stringify([size, seen.map(({ fill, region }) => [fill, region])]);
    // Of stalled ones, too: drawing shows that they move again.
    const frames = JSON.stringify(seen.map(({ newest }) => newest?.meta.timestamp ?? null));
    if (warp.isBusy || (picture === drawn.picture && (frames === drawn.frames || !warp.isDue))) return;
    Object.assign(drawn, { picture, frames });
    this.share(seen.map((each) => each.frame));
    const { px_per_m } = groundPlacement(size, dimensions);
    const { extent } = groundOf(dimensions);
    const middle = { x: -(extent.left + extent.right) / 2, y: (extent.front + extent.rear) / 2 };
    const extents = { ...middle, width: size.width / px_per_m, height: size.height / px_per_m };
    this.order(size, extents, seen.map((each, i) => ({ ...each, layer: layers[i] })));
  }

  /** Have a picture drawn, and tell its cameras once it is on the screen, perhaps in a box that has changed meanwhile. */
  async order(size, extents, parts) {
    const { drawn, session, warp, streams } = this;
    try {
      await warp?.draw(size, extents, parts);
      this.count++;
      if (session !== this.session) return;
      if (drawn === this.drawn) this.drawn_labels = parts.map(({ label }) => label);
      for (const [i, { newest, picture }] of parts.entries()) streams[i].onComposed(newest, picture !== null, warp?.fps ?? Infinity);
    } catch (error) {
      const why = error instanceof Error ? error.message : String(error);
      this.fail(why === UNANSWERED ? `${why}; reload the page` : why);
    }
  }

  /** There will be no more pictures. @param {string} why */
  fail(why) {
    if (this.why) return;
    this.why = why;
    this.updateStreams();
    this.onFailed(why);
  }

  /** Set which camera shows which part of the ground. @param {import("./framing.js").Rectangle[]} regions that the pictures show */
  share(regions) {
    const { lattice, sights, layers } = this;
    if (!lattice || JSON.stringify(regions) === this.shared_regions) return;
    this.shared_regions = JSON.stringify(regions);
    for (const [i, shares] of sharesOf(sights, regions).entries()) {
      layers[i].share(shares, trianglesOf(lattice.columns, lattice.rows, sights[i].points, shares));
    }
  }

  // --- what does not change with every picture ------------------------------------------------------------------------

  drawLines(seen) {
    const { context, display, dimensions } = this;
    if (!context || !dimensions) return;
    const states = seen.map(({ label, status }) => [label, status]);
    const rad = this.steering.angleAt(Math.max(...seen.map(({ captured }) => captured).filter(Number.isFinite)));
    const words = this.words();
    const described = JSON.stringify([display, words, states, rad && Math.round(rad / STEERING_STEP_RAD)]);
    if (described === this.drawn.lines) return;
    if (!clearTo(context, display)) return;
    this.drawn.lines = described;
    context.scale(display.ratio, display.ratio);
    const side = Math.min(display.width, display.height);
    // On large screens the page's text grows, too.
    const size = Math.round(Math.max(10, Math.min(0.045 * side, Math.max(22, 0.026 * side))));
    const laid = groundPlacement(display, dimensions);
    drawDistances(context, dimensions, laid, size);
    if (rad !== null) drawPaths(context, pathGuides(dimensions, rad), laid);
    drawVehicle(context, dimensions, laid);
    drawScale(context, display, laid, size);
    if (words) labelPicture(context, words, { left: 0, top: 0, bottom: display.height });
    this.drawStates(context, laid, size, seen);
  }

  /** What a driver must know of the whole view: poses may be estimated, and without a GPU it moves in steps. */
  words() {
    const fps = this.warp?.fps ?? Infinity;
    const isEstimated = this.streams.some(({ camera }) => !camera.calibrated);
    return [isEstimated && ESTIMATED, fps < ENOUGH && `${fps} PICTURES/S`].filter(Boolean).join(" · ");
  }

  drawStates(context, laid, size, seen) {
    const { width, height } = this.display;
    context.font = `700 ${size}px ${FONT}`;
    const labelled = seen.map((each, i) => ({ ...each, camera: this.streams[i].camera })).filter(({ label }) => label);
    /** @type {ReturnType<GroundView["labelOf"]>[]} */
    const labels = labelled.map(({ camera, label, status }) => this.labelOf(context, camera, label, status, laid, size));
    for (const label of apart(labels, height)) drawLabel(context, label, size);
    const thick = 0.4 * size;
    if (seen.some(({ status }) => STALLED.includes(status))) frame(context, width, height, thick, RED, []);
    else if (seen.some(({ label, status }) => label && MOVING.includes(status))) {
      frame(context, width, height, thick, AMBER, [2 * size, size]);
    }
  }

  /** The label of a camera's status, inside the box. */
  labelOf(context, { pose, name }, label, status, laid, size) {
    const yaw = (pose.yaw_deg * Math.PI) / 180;
    const at = toBox({ x: pose.x_m + LABEL_M * Math.cos(yaw), y: pose.y_m + LABEL_M * Math.sin(yaw) }, laid);
    const [back, fore] = STALLED.includes(status) ? [RED, "#fff"] : MOVING.includes(status) ? [AMBER, "#000"] : ["#2b333c", "#e6ebf0"];
    const text = `${label} ${name.replaceAll("_", " ")}`;
    const width = Math.min(this.display.width, context.measureText(text).width + size);
    const x = Math.min(this.display.width - width, Math.max(0, at.x - width / 2));
    return { x, y: at.y - 0.8 * size, width, height: 1.6 * size, text, back, fore };
  }

  /** For tests: its placement in its box, CSS px; the cameras' labels now, and when the picture was drawn. */
  measure() {
    const laid = this.dimensions && groundPlacement(this.display, this.dimensions);
    const states = this.streams.map((stream) => stream.fromAbove().label);
    return { ...laid, on: this.isOn(), count: this.count, why: this.why, states, drawn: this.drawn_labels };
  }
}

/** A place on the ground in px of the box: x is up, y to the left. */
const toBox = ({ x, y }, laid) => ({ x: laid.x - y * laid.px_per_m, y: laid.y - x * laid.px_per_m });

/** Lines at equal distances from the vehicle. */
function drawDistances(context, dimensions, laid, size) {
  context.font = `600 ${size}px ${FONT}`;
  context.textBaseline = "middle";
  context.textAlign = "center";
  let above = -Infinity; // height of the last label
  for (const metres of DISTANCES_M) {
    const [box, { px_per_m }] = [boxOf(outline(dimensions, metres), laid), laid];
    for (const [thick, colour] of /** @type {[number, string][]} */ ([[2.5, "rgba(0,0,0,0.45)"], [1, "rgba(255,255,255,0.8)"]])) {
      context.lineWidth = thick;
      context.strokeStyle = colour;
      context.beginPath();
      context.roundRect(box.x, box.y, box.width, box.height, metres * px_per_m);
      context.stroke();
    }
    if (box.y - above < LINE * size) continue; // no room below the label of a farther line
    above = box.y;
    context.lineWidth = size / 4;
    context.strokeStyle = "rgba(0,0,0,0.7)";
    context.strokeText(`${metres} m`, box.x + box.width / 2, box.y);
    context.fillStyle = "#fff";
    context.fillText(`${metres} m`, box.x + box.width / 2, box.y);
  }
}

/** The paths of the wheels. */
function drawPaths(context, paths, laid) {
  context.lineWidth = 2;
  context.strokeStyle = COLOURS.path;
  for (const { places } of paths) {
    context.beginPath();
    for (const { x, y } of places.map((place) => toBox(place, laid))) context.lineTo(x, y);
    context.stroke();
  }
}

/** The vehicle from above, with a wedge that points ahead. */
function drawVehicle(context, dimensions, laid) {
  const { x, y, width, height } = boxOf(outline(dimensions), laid);
  context.fillStyle = "#39434d";
  context.strokeStyle = "#fff";
  context.lineWidth = 1.5;
  context.beginPath();
  context.rect(x, y, width, height);
  context.fill();
  context.stroke();
  context.fillStyle = "#c9d3dc";
  context.beginPath();
  context.moveTo(x + width / 2, y + 0.08 * height);
  context.lineTo(x + 0.8 * width, y + 0.25 * height);
  context.lineTo(x + 0.2 * width, y + 0.25 * height);
  context.fill();
}

/** A scale bar of 5 m, and the px per metre. */
function drawScale(context, { width, height }, { px_per_m }, size) {
  const [right, bottom, long] = [width - size, height - size, 5 * px_per_m];
  context.font = `600 ${size}px ${FONT}`;
  context.textAlign = "right";
  context.textBaseline = "bottom";
  const label = "5 m";
  for (const [thick, colour] of /** @type {[number, string][]} */ ([[size / 4 + 3, "#000"], [size / 4, "#fff"]])) {
    context.strokeStyle = colour;
    context.lineWidth = thick;
    context.beginPath();
    context.moveTo(right - long, bottom);
    context.lineTo(right, bottom);
    context.stroke();
  }
  context.strokeStyle = "rgba(0,0,0,0.7)";
  context.lineWidth = size / 4;
  context.strokeText(label, right, bottom - size / 3);
  context.fillStyle = "#fff";
  context.fillText(label, right, bottom - size / 3);
}

function drawLabel(context, { x, y, width, height, text, back, fore }, size) {
  context.textAlign = "center";
  context.textBaseline = "middle";
  context.fillStyle = back;
  context.fillRect(x, y, width, height);
  context.fillStyle = fore;
  context.fillText(text, x + width / 2, y + 0.8 * size, width);
}

function boxOf({ rear, front, right, left }, laid) {
  const [a, b] = [toBox({ x: front, y: left }, laid), toBox({ x: rear, y: right }, laid)];
  return { x: a.x, y: a.y, width: b.x - a.x, height: b.y - a.y };
}

/**
 * Clear a canvas that has the size of its box.
 * @param {OffscreenCanvasRenderingContext2D} context  @param {{width: number, height: number, ratio: number}} display
 * @returns {boolean} whether it has; if not, it will be drawn later
 */
function clearTo(context, { width, height, ratio }) {
  const isResized = resize(context.canvas, { width: Math.round(width * ratio), height: Math.round(height * ratio) });
  if (isResized) context.reset();
  return isResized;
}
