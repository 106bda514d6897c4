/**
 * Drawing through meshes, for the video worker: warp_worker.js does it, so that video never waits for WebGL. Without a GPU
 * the CPU draws, which limits how often and how large.
 */

import { now } from "./clock.js";
import { hasGpu, setGpu } from "./picture.js";

const STARTED_MS = 3000; // after the page was opened: starting WebGL takes a while, and the first pictures do not wait for it
const ANSWER_MS = 10_000; // WebGL that does not answer for this long has failed
export const UNANSWERED = `nothing was drawn for ${ANSWER_MS / 1000} s`;
// Without a GPU a picture of a million px would occupy a processor for a fifth of a second.
const SOFTWARE = { every_ms: 200, max_px: 200_000 };

/** @typedef {import("./projection.js").Point} Point */
/** @typedef {import("./picture.js").Picture} Picture */
/** @typedef {import("./framing.js").Size} Size */
/** @typedef {ImageBitmap|ImageData} Image */

/** @type {Worker|null} */
let worker = null;
let failure = ""; // why the worker draws nothing
let lastId = 0; // of targets, layers and drawings
/** @type {Map<number, {resolve: (image: Image|null) => void, reject: (error: Error) => void}>} drawings under way */
const drawings = new Map();
/** @type {Map<number, RemoteWarp>} */
const warps = new Map();

const handlers = {
  gpu: (message) => setGpu(message.hasGpu),
  lost({ target, why }) {
    const warp = warps.get(target);
    if (warp) warp.lost = why;
  },
  drawn({ id, image, why }) {
    const drawing = drawings.get(id);
    drawings.delete(id);
    if (!drawing) image?.close?.(); // it came too late
    else if (why) drawing.reject(new Error(why));
    else drawing.resolve(image);
  },
};

/** Start the worker, which detects the GPU, once the first pictures are drawn. */
export const startWarps = () => setTimeout(start, STARTED_MS);

function start() {
  if (worker) return worker;
  worker = new Worker("/static/warp_worker.js", { type: "module" });
  worker.onmessage = ({ data }) => handlers[data.kind](data);
  worker.onerror = (event) => {
    failure = event instanceof ErrorEvent ? event.message : "a part of this page could not be loaded; reload the page";
    for (const { reject } of drawings.values()) reject(new Error(failure));
    drawings.clear();
  };
  return worker;
}

const post = (message, transferred = []) => start().postMessage(message, transferred);

/** One picture and its mesh. */
export class RemoteLayer {
  id = ++lastId;
  /** @type {Picture|null} the last one that was sent */
  sent = null;

  /** @param {number} target  @param {Point[]} places  @param {(Point|null)[]} points */
  constructor(target, places, points) {
    post({ order: "layer", target, layer: this.id, places, points });
  }

  /** @param {Float32Array} shares of the picture at each vertex  @param {Uint32Array} triangles that are drawn, as vertices */
  share(shares, triangles) {
    post({ order: "share", layer: this.id, shares, triangles });
  }

  dispose() {
    post({ order: "dispose", layer: this.id });
  }

  /** A copy of a picture for the worker; null: none, or it is there already. @param {Picture|null} picture */
  copyOf(picture) {
    if (!picture || picture === this.sent) return null;
    this.sent = picture;
    return picture.copy();
  }
}

export class RemoteWarp {
  id = ++lastId;
  lost = ""; // why the browser draws nothing any more
  count = 0; // of drawings under way
  drawn_at = -Infinity; // page time when the last one began

  /** @param {OffscreenCanvas|null} canvas on the screen; null: drawings are returned */
  constructor(canvas) {
    warps.set(this.id, this);
    post({ order: "target", target: this.id, canvas }, canvas ? [canvas] : []);
  }

  dispose() {
    warps.delete(this.id);
    post({ order: "forget", target: this.id });
  }

  /**
   * Places on the canvas, y up, and the points of the camera's full image shown there.
   * @param {Point[]} places  @param {(Point|null)[]} points
   */
  layer(places, points) {
    return new RemoteLayer(this.id, places, points);
  }

  get isBusy() {
    return this.count > 0;
  }

  /** Whether the next moving picture may be drawn. */
  get isDue() {
    return !this.isBusy && (hasGpu || now() - this.drawn_at >= SOFTWARE.every_ms);
  }

  /** How often pictures are drawn, at most, a second. */
  get fps() {
    return hasGpu ? Infinity : 1000 / SOFTWARE.every_ms;
  }

  /** The size to draw for a box of so many px of the screen. @param {Size} box */
  sizeFor({ width, height }) {
    const scale = hasGpu ? 1 : Math.min(1, Math.sqrt(SOFTWARE.max_px / (width * height)));
    return { width: Math.max(1, Math.round(width * scale)), height: Math.max(1, Math.round(height * scale)) };
  }

  /**
   * @param {Size} size of the drawing, px
   * @param {import("./warp.js").Frame} frame
   * @param {{layer: RemoteLayer, fill: number, picture: Picture|null, region: import("./framing.js").Rectangle}[]} parts
   *   picture: null unless filled with one
   * @returns {Promise<Image|null>} null: it is on the screen
   * @throws {Error} with a message for the operator
   */
  async draw(size, frame, parts) {
    if (failure || this.lost) throw new Error(failure || this.lost);
    const copies = parts.map(({ layer, picture }) => layer.copyOf(picture));
    const drawn = parts.map(({ layer, fill, region }, i) => ({ layer: layer.id, fill, region, picture: copies[i] }));
    const id = ++lastId;
    this.count++;
    this.drawn_at = now();
    post({ order: "draw", target: this.id, id, size, frame, drawn }, copies.flatMap((copy) => (copy ? [copy.transferred] : [])));
    const timer = setTimeout(() => handlers.drawn({ id, image: null, why: UNANSWERED }), ANSWER_MS);
    try {
      return await new Promise((resolve, reject) => drawings.set(id, { resolve, reject }));
    } finally {
      clearTimeout(timer);
      this.count--;
    }
  }
}
