/** What is measured of one camera's pictures as they are drawn: their ages, a counter that the camera films. */

import { now } from "./clock.js";
import { elapsed, read } from "./counter.js";

const STAGES = 1200;

export class DrawnPictures {
  stages = []; // captured, arrived at the station, received here, decoded, drawn; ms on the station's clock
  shown = []; // of the same pictures: captured, drawn, what it says that it shows, width, height
  first_at = null; // page time

  /** @param {any} camera as in hello  @param {any} station see `Stream` */
  constructor(camera, station) {
    this.camera = camera;
    this.station = station;
  }

  record({ meta, picture }, drawn) {
    this.first_at ??= drawn;
    const page = [meta.received, meta.decoded, drawn].map((time) => this.station.clock.toStation(time));
    this.stages.push([meta.captured, meta.arrived, ...page]);
    this.shown.push([meta.captured, page[2], meta.region, picture.width, picture.height]);
    if (this.stages.length <= STAGES) return;
    this.stages.shift();
    this.shown.shift();
  }

  /** Report how long ago the screen showed the counter in the picture just drawn. */
  async readCounter({ picture, meta: { captured } }) {
    const { clock, bound } = this.station;
    const drawn = now();
    const shape = await picture.decoded().catch(() => null); // it may be closed by now
    const [{ offset, stride }] = shape?.planes ?? [{}];
    const isLuma = ["I420", "NV12"].includes(shape?.format);
    const counter = isLuma ? read(shape.bytes.subarray(offset), shape.width, shape.height, stride) : null;
    this.station.count({
      camera: this.camera.name,
      elapsed_ms: counter === null ? null : elapsed(counter, drawn),
      age_ms: finite(clock.toStation(drawn) - captured),
      bound_ms: finite(bound + clock.bound),
    });
  }
}

/** JSON cannot represent NaN or Infinity. */
const finite = (ms) => (Number.isFinite(ms) ? ms : null);

/** For tests: a picture as decoded, its luma and its capture time. @param {import("./stream.js").Shown|null|undefined} shown */
export async function described(shown) {
  if (!shown) return shown;
  const { sequence, captured, region } = shown.meta;
  const { width, height, bytes, planes } = /** @type {any} */ (await shown.picture.decoded());
  const [{ offset, stride }] = planes;
  const luma = new Uint8Array(width * height);
  for (let row = 0; row < height; row++) {
    const from = offset + row * stride;
    luma.set(bytes.subarray(from, from + width), row * width);
  }
  return { width, height, sequence, captured, region, luma: base64(luma) };
}

function base64(bytes) {
  let text = "";
  for (let i = 0; i < bytes.length; i += 0x8000) text += String.fromCharCode(...bytes.subarray(i, i + 0x8000));
  return btoa(text);
}
