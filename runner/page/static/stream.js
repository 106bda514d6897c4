/** One camera in the worker: its decoder, its canvas, its status. */

import { codecOf, isKnown, nameOf, spsOf } from "./codec.js";
import { now } from "./clock.js";
import { placed, visible, WHOLE } from "./framing.js";
import { elapsed, read } from "./counter.js";
import { Pace } from "./pace.js";
import { pictureOf } from "./picture.js";
import { GuideLayer } from "./guide_layer.js";
import { judge, MOVING, STANDING, words } from "./status.js";
import { drawOverlay } from "./overlay.js";
import { straightOptics } from "./straight.js";
import { StraightView } from "./straight_view.js";
import { FILLS } from "./warp.js";

export const KEY = 1;
export const CATCH_UP = 2;
export const RESTART = 4;
export const DAMAGED = 8;

const QUEUE = 40; // units waiting in the decoder: beyond this, restarting from a burst is faster
const LAG_MS = 2000; // delay beyond the usual one: as long as the burst that would come instead
const RESYNC_EVERY_MS = 2000; // doubled each time it did not help: a burst costs more than the fault it repairs
const RESYNC_SELDOM_MS = 16000;
const SETTLE_MS = 2000; // after a restart the decoder may take this long for the burst
const REFUSED_MS = 5000; // between two questions whether the browser decodes a stream now
const LATE_HOLD_MS = 500; // how long one late picture is indicated
const STAGES = 1200;
const NEW_REGION = "NEW REGION"; // which part of the image a picture shows is not known for a moment
const UNTIMED_MS = 1000; // a picture without a capture time has been on its way for less
// Not every encoder states what the vehicle pins (ITU-R BT.709); browsers would take BT.601 for small pictures.
/** @type {VideoColorSpaceInit} */
const BT709 = { primaries: "bt709", transfer: "bt709", matrix: "bt709", fullRange: false };

/** @typedef {import("./picture.js").Picture} Picture */
/** @typedef {{picture: Picture, meta: any}} Shown */

export class Stream {
  arrived = now(); // page times of the newest unit and of the newest picture to draw, or of the start of the stream
  decoded = this.arrived;
  drawn = false;
  damaged = false; // the picture drawn shows that packets were lost
  late_until = 0;

  /**
   * @param {object} camera as in hello
   * @param {object} station what all streams share: clock, limits, connected, online, resync(name), marked(name, mark), wake() requests a redraw,
   *   crooked(stream, error): its picture cannot be straightened
   */
  constructor(camera, station) {
    this.camera = camera;
    this.name = camera.name;
    this.station = station;
    /** @type {OffscreenCanvas|null} */
    this.canvas = null;
    /** @type {OffscreenCanvasRenderingContext2D|null} */
    this.context = null;
    /** @type {VideoDecoder|null} */
    this.decoder = null;
    this.sps = this.codec = null;
    this.display = { width: 0, height: 0, ratio: 1, view: WHOLE };
    /** @type {Shown|null} */
    this.waiting = null; // newest decoded picture, not drawn yet
    /** @type {Shown|null} */
    this.shown = null; // picture last drawn, kept for alarms and for tests
    this.meta = new Map(); // by timestamp: metadata of a unit in the decoder
    this.timestamp = 0;
    this.pace = new Pace();
    this.counts = { received: 0, due: 0, decoded: 0, drawn: 0, errors: 0, resyncs: 0 };
    this.error = ""; // of the decoder, the last one
    this.refused = isKnown(camera.codec) ? "" : `This page cannot show ${nameOf(camera.codec)}.`; // why there is no picture
    this.asked = now(); // when the browser last stated that it has no decoder
    this.stages = [];
    this.first_drawn = null;
    this.first = null; // for tests, the first picture drawn
    this.last_resync = this.restarted = -Infinity;
    this.patience = RESYNC_EVERY_MS;
    this.transit = null; // usual time from the station to here
    this.on = this.sending = null;
    /** @type {number|null} */
    this.failed_at = null; // since when the source has a fault: it may repeat a picture as new
    this.status = this.reported = "synchronising";
    /** @type {string|null} */
    this.painted = ""; // text of the overlay in the canvas, "" for the plain picture
    this.marked = ""; // what that says of the picture
    this.last_drawn = 0; // page time
    this.late_age = NaN; // of the last late picture
    this.guides = camera.pose && station.dimensions ? new GuideLayer(camera, station.dimensions) : null;
    this.full = { x: 0, y: 0, width: camera.width, height: camera.height };
    /** @type {import("./framing.js").Rectangle|null} */
    this.region = null; // of the full image that pictures show; null: unknown, or about to change
    /** @type {import("./framing.js").Size|null} */
    this.expected = null; // size of these pictures; null likewise
    this.region_since = Infinity; // capture times from then on are those of pictures that show it
    this.size_since = Infinity;
    /** @type {StraightView|null} */
    this.straight = null; // shows the picture straightened
    this.above = false; // whether the bird's-eye view shows the picture, too
    this.started();
  }

  /** The stream starts or restarts: silence counts from now. */
  started() {
    this.arrived = this.decoded = now();
    this.drawn = this.damaged = false;
    this.late_until = 0;
  }

  /** The vehicle's decision about this camera. */
  decide(decision) {
    const { on, sending, fault } = decision;
    const begins = on && sending && (this.on === false || this.sending === false);
    Object.assign(this, { on, sending });
    this.failed_at = fault ? (this.failed_at ?? now()) : null;
    if (begins) this.started();
    this.regard(decision);
  }

  /** Which part of the full image pictures show, once that was read back. */
  regard({ roi, width, height, applied }) {
    const { x, y, width: wide, height: high } = applied.roi ?? roi;
    const size = applied.size ?? { width, height };
    const isCut = x === roi.x && y === roi.y && wide === roi.width && high === roi.height;
    const region = isCut ? { x, y, width: wide, height: high } : null;
    const expected = isCut && size.width === width && size.height === height ? size : null;
    const since = this.station.clock.server(now());
    if (JSON.stringify(region) !== JSON.stringify(this.region)) Object.assign(this, { region, region_since: since });
    if (JSON.stringify(expected) !== JSON.stringify(this.expected)) Object.assign(this, { expected, size_since: since });
  }

  /** The region that the picture on show is known to show. */
  seenRegion() {
    const { shown, region } = this;
    return shown && region && this.taken() >= this.region_since && isOfShape(shown.picture, region) ? region : null;
  }

  /** When the picture on show was captured, or at least on its way. */
  taken() {
    const { captured = NaN, arrived = NaN } = this.shown?.meta ?? {};
    return Number.isFinite(captured) ? captured : arrived - UNTIMED_MS;
  }

  attach(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d", { alpha: false, desynchronized: true });
    this.painted = null;
    this.station.wake();
  }

  // --- from the station into the decoder ------------------------------------------------------------------------------

  /** @param {{flags: number, sequence: number, captured: number, arrived: number, data: Uint8Array}} unit */
  receive(unit) {
    const received = now();
    this.counts.received++;
    // The first units may have reached the station long ago: those of a camera that sends no longer.
    const came = unit.arrived - this.station.clock.offset + this.station.clock.bound;
    this.arrived = this.drawn || !Number.isFinite(came) ? received : Math.min(received, came);
    if (this.refused && unit.flags & KEY && isKnown(this.camera.codec)) this.reconsider(unit.data);
    if (!this.station.video || this.refused) return void Object.assign(this, { decoded: received, drawn: true }); // judged by arrival alone
    if (unit.flags & RESTART) this.restart();
    if (unit.flags & KEY) this.configure(unit.data);
    if (!this.decoder || this.decoder.state !== "configured") return this.resync();
    if (this.lags(unit, received)) this.resync();
    this.decode(unit, received);
  }

  restart() {
    this.close();
    this.drawn = false;
    this.transit = null;
    this.restarted = now();
  }

  /** A key unit sets the decoder up, and again if its parameters change. */
  configure(data) {
    const sps = spsOf(data, this.camera.codec);
    if (!sps || (this.decoder && String(sps) === this.sps)) return;
    this.close();
    this.sps = String(sps);
    const codec = codecOf(sps, this.camera.codec);
    const decoder = new VideoDecoder({
      output: (frame) => (decoder === this.decoder ? this.output(frame) : frame.close()),
      error: (error) => decoder === this.decoder && this.failed(error),
    });
    this.decoder = decoder;
    this.codec = codec;
    decoder.configure({ codec, optimizeForLatency: true, colorSpace: BT709 });
  }

  /** Why the browser does not decode this stream, "" if it can. Browsers name the error differently. */
  async refusal(codec) {
    const { supported } = await VideoDecoder.isConfigSupported({ codec }).catch(() => ({ supported: false }));
    const name = nameOf(this.camera.codec);
    return supported ? "" : `This browser has no decoder for ${name} (${codec}). Use an H.264 graph or another browser.`;
  }

  /** A different stream may have a profile that the browser decodes, and a decoder may be missing for a moment only. */
  async reconsider(data) {
    const sps = spsOf(data, this.camera.codec);
    if (!sps) return;
    if (String(sps) !== this.sps) return void (this.refused = "");
    if (now() - this.asked < REFUSED_MS) return;
    this.asked = now();
    if (!(await this.refusal(this.codec))) this.refused = "";
  }

  decode(unit, received) {
    this.timestamp += 1000;
    this.meta.set(this.timestamp, { ...unit, data: null, timestamp: this.timestamp, received });
    if (!(unit.flags & CATCH_UP)) this.counts.due++;
    const type = unit.flags & KEY ? "key" : "delta";
    try {
      this.decoder?.decode(new EncodedVideoChunk({ type, timestamp: this.timestamp, data: unit.data }));
    } catch (error) {
      this.failed(error); // a delta unit when the decoder expects a key unit
    }
  }

  lags(unit, received) {
    if (unit.flags & CATCH_UP || this.settling()) return false;
    if (this.queued() > QUEUE) return true;
    const transit = this.station.clock.server(received) - unit.arrived;
    if (!Number.isFinite(transit)) return false;
    this.transit = this.transit === null ? transit : Math.min(transit, this.transit + 0.5);
    return transit > this.transit + LAG_MS;
  }

  /** Whether the decoder is still busy with the initial burst. */
  settling() {
    return !this.drawn && now() - this.restarted < SETTLE_MS;
  }

  /** Units in the decoder. */
  queued() {
    return this.decoder?.decodeQueueSize ?? 0;
  }

  async failed(error) {
    this.close();
    const { codec } = this;
    const why = await this.refusal(codec);
    if (why && codec === this.codec) return void Object.assign(this, { refused: why, asked: now() }); // another burst would not help
    this.counts.errors++;
    this.error = String(error);
    this.resync();
  }

  resync() {
    const since = now() - this.last_resync;
    if (since < this.patience) return;
    this.patience = since > 2 * this.patience ? RESYNC_EVERY_MS : Math.min(RESYNC_SELDOM_MS, 2 * this.patience);
    this.last_resync = now();
    this.counts.resyncs++;
    this.station.resync(this.name);
  }

  close() {
    if (this.decoder && this.decoder.state !== "closed") this.decoder.close();
    this.decoder = null;
    this.waiting?.picture.close();
    this.waiting = null;
    this.meta.clear();
  }

  // --- from the decoder to the eye ------------------------------------------------------------------------------------

  output(frame) {
    const meta = this.meta.get(frame.timestamp);
    for (const key of this.meta.keys()) if (key <= frame.timestamp) this.meta.delete(key);
    this.counts.decoded++;
    const behind = this.settling() && this.queued() > 1; // there is already a newer one
    if (!meta || meta.flags & CATCH_UP || behind) return frame.close();
    this.wait(frame, { ...meta, decoded: now() }, this.decoder);
  }

  async wait(frame, meta, decoder) {
    const size = { width: frame.displayWidth, height: frame.displayHeight };
    const picture = await pictureOf(frame, this.above || this.straight ? Infinity : this.widthOnScreen(size)).catch(() => null);
    if (!picture) return void this.counts.errors++;
    if (decoder !== this.decoder || meta.timestamp < (this.waiting?.meta.timestamp ?? 0)) return picture.close();
    this.waiting?.picture.close();
    this.waiting = { picture, meta };
    this.decoded = now(); // what is decoded and never drawn leaves the picture standing still
    this.station.wake();
  }

  /** Whether there is a picture to draw. */
  get waits() {
    return this.waiting !== null && this.context !== null;
  }

  /** Draw the newest frame; called in the worker's animation frame. */
  draw() {
    if (!this.waiting || !this.context) return;
    this.shown?.picture.close();
    this.shown = this.waiting;
    this.waiting = null;
    this.drawn = true;
    this.last_drawn = now();
    this.damaged = Boolean(this.shown.meta.flags & DAMAGED);
    this.age(this.shown.meta, now());
    this.status = judge(this.times(), this.station.limits, now());
    this.paint(now());
    this.drawGuides();
    this.note(this.shown.meta, now());
    if (this.station.keep) this.first ??= this.picture();
    if (this.station.counted === this.name) this.readCounter(this.shown);
  }

  /** Show the guides of this camera, or none. */
  guide(shown) {
    if (!this.guides) return;
    this.guides.shown = shown;
    this.drawGuides();
  }

  /** The guides of the picture on show; none over one that stands still, since nobody may steer by it. */
  drawGuides() {
    const { guides, shown } = this;
    if (!guides) return;
    const drawn = MOVING.includes(this.status) ? this.drawnRegion() : null;
    guides.draw(this.display, shown && drawn && { ...drawn, rad: this.station.steering.when(shown.meta.captured) });
  }

  /** Which region of the image that the guides are made for is in the canvas, and how large; null: unknown. */
  drawnRegion() {
    const { shown, expected, canvas } = this;
    const region = this.seenRegion();
    if (!shown || !region) return null;
    if (this.straight) return canvas && { picture: { width: canvas.width, height: canvas.height }, region: this.full };
    const { width, height } = shown.picture;
    const fits = expected && width === expected.width && height === expected.height && this.taken() >= this.size_since;
    return fits ? { picture: { width, height }, region } : null;
  }

  /**
   * Show the picture straightened, or as it comes.
   * @throws {Error} for people to read: there is no straight view
   */
  straighten(on) {
    if (on === Boolean(this.straight)) return;
    this.straight = on ? new StraightView(this.camera) : null;
    this.guides?.look(on ? straightOptics(this.camera) : this.camera);
    this.painted = null; // it is painted again at the next tick
  }

  /** What the bird's-eye view shows of this camera. */
  fromAbove() {
    const region = this.seenRegion();
    const moves = MOVING.includes(this.status);
    const picture = moves && region ? (this.shown?.picture ?? null) : null;
    const fill = picture ? FILLS.picture : STANDING.includes(this.status) ? FILLS.alarm : FILLS.none;
    const { timestamp = null, captured = NaN } = (picture && this.shown?.meta) ?? {};
    return { picture, fill, timestamp, captured, region: this.region ?? this.full, status: this.status, words: this.overlay(now()) || (region ? "" : NEW_REGION) };
  }

  age({ captured }, time) {
    const { clock, limits, bound } = this.station;
    const age = clock.server(time) - captured + bound + clock.bound; // at most; not finite if a clock is unknown
    if (Number.isFinite(age) && age > limits.late_ms) Object.assign(this, { late_until: time + LATE_HOLD_MS, late_age: age });
  }

  note(meta, drawn) {
    this.counts.drawn++;
    this.first_drawn ??= drawn;
    const page = [meta.received, meta.decoded, drawn].map((time) => this.station.clock.server(time));
    this.stages.push([meta.captured, meta.arrived, ...page]);
    if (this.stages.length > STAGES) this.stages.shift();
  }

  /** Tell the station how long ago the counter in a picture that was just drawn had been on the screen. */
  async readCounter({ picture, meta: { captured } }) {
    const { clock, bound } = this.station;
    const drawn = now();
    const shape = await picture.decoded().catch(() => null); // it may be closed by now
    const [{ offset, stride }] = shape?.planes ?? [{}];
    const isLuma = ["I420", "NV12"].includes(shape?.format);
    const counter = isLuma ? read(shape.bytes.subarray(offset), shape.width, shape.height, stride) : null;
    this.station.count({
      camera: this.name,
      elapsed_ms: counter === null ? null : elapsed(counter, drawn),
      age_ms: finite(clock.server(drawn) - captured),
      bound_ms: finite(bound + clock.bound),
    });
  }

  times() {
    const { connected, online } = this.station;
    const { on, sending, refused, drawn, damaged, arrived, decoded, late_until } = this;
    const faulty = this.failed_at !== null;
    return { connected, online, on, sending, refused, drawn, damaged, faulty, arrived, decoded, late_until, fps: this.camera.fps };
  }

  /** Whether too few of the pictures that come are drawn; to be called a few times a second. */
  isSlow() {
    this.pace.add(now(), this.counts.due, this.counts.drawn);
    return this.pace.slow;
  }

  /** Judge the status; returns whether it has changed. Called by a timer. */
  watch() {
    const time = now();
    this.status = judge(this.times(), this.station.limits, time);
    const text = this.overlay(time);
    if (this.context && text !== this.painted) this.paint(time);
    if (!MOVING.includes(this.status)) this.drawGuides();
    const changed = this.status !== this.reported;
    this.reported = this.status;
    return changed;
  }

  overlay(time) {
    if (this.status === "live") return this.straight && !this.seenRegion() ? NEW_REGION : "";
    const late = this.isLateToo(time) ? `, ${words("late", 0, this.late_age)}` : "";
    return words(this.status, time - Math.min(this.arrived, this.failed_at ?? Infinity), this.late_age) + late;
  }

  /** Whether a damaged picture is late as well. */
  isLateToo(time) {
    return this.status === "damaged" && time < this.late_until;
  }

  paint(time) {
    const { canvas, context } = this;
    if (!canvas || !context || (this.above && !this.display.width)) return; // the bird's-eye view is in its place
    const text = this.overlay(time);
    this.size(canvas, STANDING.includes(this.status));
    if (this.shown && this.status !== "off" && this.status !== "unsupported") this.paintPicture(context, this.shown.picture);
    else blank(context);
    if (text) drawOverlay(context, this.area(canvas), this.display.view.mirrored, this.status, text);
    this.painted = text;
    this.tellMark(this.isLateToo(time) ? "damaged late" : this.status);
  }

  /** Tell what the canvas says of the picture from now on. */
  tellMark(mark) {
    if (mark === this.marked) return;
    this.marked = mark;
    this.station.marked(this.name, mark);
  }

  paintPicture(context, picture) {
    const region = this.seenRegion();
    if (!this.straight) return picture.paint(context, context.canvas.width, context.canvas.height);
    if (!region) return blank(context);
    try {
      this.straight.paint(context, picture, region);
    } catch (error) {
      this.station.crooked(this, error);
      picture.paint(context, context.canvas.width, context.canvas.height);
    }
  }

  /**
   * The canvas has the picture's size. For a lasting alarm it is an integer multiple of it, close to the size on the
   * screen, so that words are sharp while the aspect ratio, and with it the page's layout, stays the same.
   */
  size(canvas, sharp) {
    const { width: wide, height: high, ratio } = this.display;
    const box = { width: Math.round(wide * ratio) || 480, height: Math.round(high * ratio) || 270 };
    const own = this.straight ? this.straightSize() : (this.shown?.picture.painted ?? box);
    const times = sharp ? Math.min(6, Math.max(1, Math.ceil(this.widthOnScreen(own) / own.width))) : 1;
    const width = own.width * times;
    const height = own.height * times;
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
  }

  /** A straight image is as sharp as the screen, and no larger than the camera's. */
  straightSize() {
    const { width, height } = this.camera;
    const wide = Math.round(Math.min(width, this.widthOnScreen(this.camera) || width));
    return { width: wide, height: Math.round((wide * height) / width) };
  }

  /** Width of a picture on the screen, with what is cropped, in px of the screen; 0: not known yet. */
  widthOnScreen(picture) {
    const { ratio, view } = this.display;
    return placed(this.display, picture, view).width * ratio;
  }

  /** The part of the canvas that is on the screen. */
  area(canvas) {
    const { display } = this;
    return display.width && display.height ? visible(display, canvas, display.view) : { x: 0, y: 0, width: canvas.width, height: canvas.height };
  }

  // --- for tests and benchmarks ---------------------------------------------------------------------------------------

  measure(origin) {
    const picture = this.shown?.picture;
    return {
      status: this.status,
      ...this.counts,
      error: this.error,
      straight: this.straight !== null && this.painted !== null,
      width: picture?.width ?? 0,
      height: picture?.height ?? 0,
      drawn_size: { width: this.canvas?.width ?? 0, height: this.canvas?.height ?? 0 },
      first_drawn_ms: this.first_drawn === null ? null : this.first_drawn - origin,
    };
  }

  /** The picture last drawn, as decoded: its luma and its capture time. */
  async picture() {
    return this.shown && described(await this.shown.picture.decoded(), this.shown.meta);
  }

  end() {
    this.close();
    this.shown?.picture.close();
    this.shown = null;
  }
}

/** Whether a picture has a region's aspect ratio, as far as whole even numbers of px allow. */
function isOfShape(picture, { width, height }) {
  return Math.abs(picture.width * height - picture.height * width) <= width + height;
}

/** JSON has no other numbers. */
const finite = (ms) => (Number.isFinite(ms) ? ms : null);

function blank(context) {
  context.fillStyle = "#0b0e11";
  context.fillRect(0, 0, context.canvas.width, context.canvas.height);
}

function described({ width, height, bytes, planes }, { sequence, captured }) {
  const [{ offset, stride }] = planes;
  const luma = new Uint8Array(width * height);
  for (let row = 0; row < height; row++) {
    const from = offset + row * stride;
    luma.set(bytes.subarray(from, from + width), row * width);
  }
  return { width, height, sequence, captured, luma: base64(luma) };
}

function base64(bytes) {
  let text = "";
  for (let i = 0; i < bytes.length; i += 0x8000) text += String.fromCharCode(...bytes.subarray(i, i + 0x8000));
  return btoa(text);
}
