/**
 * A decoded picture that can be painted, in one of two ways. With a GPU the VideoFrame itself is drawn. Without one,
 * Chromium's drawImage(VideoFrame) in a worker waits for the page's main thread, so that a busy page would stop all
 * video and its alarms. So the planes are copied out of the frame and converted to pixels here, without waiting.
 */

import { Enlarger } from "./enlarger.js";
import { scaled, toRgba } from "./yuv.js";

/** @typedef {"I420"|"NV12"} Format */
const FORMATS = ["I420", "NV12"];
const MAX_SPARES = 16;

/** @typedef {{bytes: Uint8Array, image: ImageData}} Memory */
/** @type {Memory[]} */
const spare = []; // memory of closed pictures, for reuse

/** A frame, unchanged; closed when the next one is shown. */
class FramePicture {
  /** @param {VideoFrame} frame */
  constructor(frame) {
    this.frame = frame;
    this.width = frame.displayWidth;
    this.height = frame.displayHeight;
    this.painted = { width: this.width, height: this.height };
  }

  /** @param {import("./framing.js").Rectangle} place in the canvas */
  paint(context, place) {
    if (place.width > this.width && enlarges()) return void enlarger?.paint(context, this, place);
    context.drawImage(this.frame, place.x, place.y, place.width, place.height);
  }

  /** Upload to the bound texture. @param {WebGL2RenderingContext} gl */
  upload(gl) {
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, this.frame);
  }

  /** Planes of the frame, as they were decoded: {width, height, format, bytes, planes}. */
  async decoded() {
    const bytes = new Uint8Array(this.frame.allocationSize());
    const planes = await this.frame.copyTo(bytes);
    return { width: this.width, height: this.height, format: this.frame.format, bytes, planes };
  }

  /** A copy for another worker, see `receivedPicture`. */
  copy() {
    const frame = this.frame.clone();
    return { frame, transferred: frame };
  }

  close() {
    this.frame.close();
  }
}

/** The planes of a frame; converted to pixels when first drawn, since not every decoded picture is. */
class PlanePicture {
  converted = false;

  /**
   * @param {Memory} memory
   * @param {PlaneLayout[]} planes
   * @param {{format: Format, colorSpace: VideoColorSpaceInit, width: number, height: number}} shape of the frame
   */
  constructor(memory, planes, { format, colorSpace, width, height }) {
    this.memory = memory;
    this.planes = planes;
    this.format = format;
    this.colorSpace = colorSpace;
    this.width = width;
    this.height = height;
    this.painted = { width: memory.image.width, height: memory.image.height };
  }

  pixels() {
    const { bytes, image } = this.memory;
    if (!this.converted) toRgba(bytes, this.planes, this.format, this.colorSpace, image, this.width);
    this.converted = true;
    return image;
  }

  /** @param {import("./framing.js").Rectangle} place in the canvas */
  paint(context, place) {
    paintImage(context, this.pixels(), place);
  }

  /** Upload to the bound texture. @param {WebGL2RenderingContext} gl */
  upload(gl) {
    const { width, height, data } = this.pixels();
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, width, height, 0, gl.RGBA, gl.UNSIGNED_BYTE, data);
  }

  async decoded() {
    const { width, height, format, planes } = this;
    return { width, height, format, bytes: this.memory.bytes.slice(), planes };
  }

  copy() {
    const { planes, format, colorSpace, width, height, painted } = this;
    const bytes = this.memory.bytes.slice();
    return { bytes, planes, painted, shape: { format, colorSpace, width, height }, transferred: bytes.buffer };
  }

  close() {
    spare.push(this.memory);
    if (spare.length > MAX_SPARES) spare.shift(); // the oldest, most likely of another size
  }
}

/** Whether this browser draws with a GPU. The check takes a while: the first pictures are drawn without it. */
export let hasGpu = false;

/** @type {Enlarger|null} */
let enlarger = null;

/** @param {boolean} found */
export function setGpu(found) {
  hasGpu = found;
  try {
    enlarger = found ? new Enlarger() : null;
  } catch {
    enlarger = null; // the worker of warp.js has WebGL, this one has not: pictures are enlarged linearly
  }
}

/** Whether pictures are enlarged with a cubic kernel in a canvas that is larger than they are. */
export const enlarges = () => enlarger !== null && !enlarger.isLost;

function memoryFor(width, height, size) {
  const fits = ({ bytes, image }) => bytes.length === size && image.width === width && image.height === height;
  const found = spare.findIndex(fits);
  return found < 0 ? { bytes: new Uint8Array(size), image: new ImageData(width, height) } : spare.splice(found, 1)[0];
}

/** Paint an image into a place of a canvas. @param {ImageData|ImageBitmap} image  @param {import("./framing.js").Rectangle} place */
export function paintImage(context, image, place) {
  const { x, y, width, height } = place;
  if (image instanceof ImageBitmap) return context.drawImage(image, x, y, width, height);
  const [wide, high] = [width, height].map((length) => Math.max(1, Math.round(length)));
  // Scaled here, since a second canvas would wait for the page's main thread, as drawImage(VideoFrame) does.
  const fitting = wide === image.width && high === image.height ? image : scaled(image, new ImageData(wide, high));
  context.putImageData(fitting, Math.round(x), Math.round(y));
}

/**
 * The picture that another worker has copied.
 * @returns {Picture}
 */
export function receivedPicture({ frame, bytes, planes, painted, shape }) {
  if (frame) return new FramePicture(frame);
  const memory = { ...memoryFor(painted.width, painted.height, bytes.length), bytes };
  return new PlanePicture(memory, planes, shape);
}

/** Whether a frame has square pixels in a known format, so that it can be converted here. */
function isPlain({ displayWidth, displayHeight, visibleRect, format }) {
  return FORMATS.includes(format) && visibleRect.width === displayWidth && visibleRect.height === displayHeight;
}

/**
 * The picture of a frame, which is closed here or with the picture. If it is shown at half its width or less and
 * converted to pixels here, every fourth pixel is enough.
 * @param {VideoFrame} frame  @param {number} shown width on the screen, px
 * @typedef {FramePicture|PlanePicture} Picture
 * @returns {Promise<Picture>}
 */
export async function pictureOf(frame, shown) {
  if (hasGpu || !isPlain(frame)) return new FramePicture(frame);
  try {
    const { displayWidth: width, displayHeight: height } = frame;
    const colorSpace = frame.colorSpace.toJSON();
    const format = /** @type {Format} */ (frame.format); // isPlain has checked it
    const step = shown > 0 && 2 * shown <= width ? 2 : 1;
    const memory = memoryFor(width / step, height / step, frame.allocationSize());
    const planes = await frame.copyTo(memory.bytes);
    return new PlanePicture(memory, planes, { format, colorSpace, width, height });
  } finally {
    frame.close();
  }
}
