/**
 * The video worker's own worker: it draws with WebGL. Creating a WebGL context waits for the page's main thread, and without
 * a GPU drawing waits for the CPU; neither may delay video. remote_warp.js sends its orders.
 */

import { receivedPicture } from "./picture.js";
import { Warp } from "./warp.js";

const SOFTWARE = /swiftshader|llvmpipe|software|basic render/i;
const LOST = "the browser dropped the WebGL context";

/** @type {Map<number, {warp: Warp|null, why: string, isShown: boolean, gone: AbortController}>} by ID; why: there is no WebGL */
const targets = new Map();
/** @type {Map<number, import("./warp.js").Layer>} */
const layers = new Map();
/** @type {Warp|null} of all targets without a canvas: Chromium drops the oldest of more than four contexts in a worker */
let shared = null;

/** Whether this browser draws with a GPU. */
function detectGpu() {
  const context = new OffscreenCanvas(1, 1).getContext("webgl");
  if (!context) return false;
  const info = context.getExtension("WEBGL_debug_renderer_info");
  const name = context.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : context.RENDERER);
  context.getExtension("WEBGL_lose_context")?.loseContext();
  return !SOFTWARE.test(name);
}

/** @param {OffscreenCanvas|null} canvas */
function warpFor(canvas) {
  if (canvas) return new Warp(canvas);
  if (!shared || shared.lost) shared = new Warp(new OffscreenCanvas(1, 1));
  return shared;
}

const orders = {
  target({ target, canvas }) {
    const [isShown, gone] = [canvas !== null, new AbortController()];
    try {
      const warp = warpFor(canvas);
      warp.canvas.addEventListener("webglcontextlost", () => postMessage({ kind: "lost", target, why: LOST }), { signal: gone.signal });
      targets.set(target, { warp, why: "", isShown, gone });
    } catch (error) {
      targets.set(target, { warp: null, why: error instanceof Error ? error.message : String(error), isShown, gone });
    }
  },
  layer({ target, layer, places, points }) {
    const made = targets.get(target)?.warp?.layer(places, points);
    if (made) layers.set(layer, made);
  },
  share: ({ layer, shares, triangles }) => layers.get(layer)?.share(shares, triangles),
  dispose({ layer }) {
    layers.get(layer)?.dispose();
    layers.delete(layer);
  },
  forget({ target }) {
    targets.get(target)?.gone.abort();
    targets.delete(target);
  },
  draw({ target, id, size, frame, drawn }) {
    const parts = drawn.map(({ layer, picture, ...fill }) =>
      ({ ...fill, layer: layers.get(layer), picture: picture && receivedPicture(picture) }));
    const { warp, why, isShown } = targets.get(target) ?? { warp: null, why: LOST, isShown: true };
    if (!warp || warp.lost) postMessage({ kind: "drawn", id, image: null, why: why || LOST });
    else if (isShown) {
      warp.draw(size, frame, parts);
      warp.wait();
      postMessage({ kind: "drawn", id, image: null, why: "" });
    } else sendImage(id, warp, size, frame, parts);
    for (const { picture } of parts) picture?.close();
  },
};

/** Without a GPU only pixels cross to another worker without waiting for the page's main thread. */
function sendImage(id, warp, size, frame, parts) {
  warp.draw(size, hasGpu ? frame : { ...frame, height: -frame.height }, parts); // pixels are read upwards
  const image = hasGpu ? warp.canvas.transferToImageBitmap() : warp.pixels();
  postMessage({ kind: "drawn", id, image, why: "" }, { transfer: [hasGpu ? image : image.data.buffer] });
}

const hasGpu = detectGpu();
postMessage({ kind: "gpu", hasGpu });
onmessage = ({ data }) => orders[data.order](data);
