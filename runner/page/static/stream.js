/** One camera in the worker: its decoder, its canvas, its status. */

import { codecOf, isKnown, nameOf, spsOf, USUAL } from "./codec.js";
import { now } from "./clock.js";
import { imageToBox, placement, visible, WHOLE } from "./framing.js";
import { elapsed, read } from "./counter.js";
import { Pace } from "./pace.js";
import { hasGpu, paintImage, pictureOf } from "./picture.js";
import { ESTIMATED, GuideLines, labelPicture } from "./guide_lines.js";
import { resize } from "./resizing.js";
import { alarmText, frozenAfter, INTERVALS, judge, MOVING, slowText, STALLED } from "./status.js";
import { drawNote, drawOverlay, readably } from "./overlay.js";
import { straightOptics } from "./straight.js";
import { StraightView } from "./straight_view.js";
import { FILLS } from "./warp.js";

export const KEY = 1;
export const CATCH_UP = 2;
export const RESTART = 4;
export const DAMAGED = 8;

const QUEUE = 40; // units waiting in the decoder: beyond this, restarting from a burst is faster
const LAG_MS = 2000; // extra delay: as long as the burst that would replace it
const RESYNC_MIN_MS = 2000; // doubled each time it does not help: a burst costs more than the fault it repairs
const RESYNC_MAX_MS = 16000;
const SETTLE_MS = 2000; // after a restart the decoder may take this long for the burst
const REFUSED_RETRY_MS = 5000; // between two checks whether the browser can decode a refused stream
const LATE_HOLD_MS = 500; // how long one late picture is indicated, at least until it counts as frozen
const STAGES = 1200;
const WAITING = ["synchronising", "frozen"];
const NEW_REGION = "NEW REGION"; // while it is unknown which part of the image a picture shows
const NO_VIDEO = "This browser has no WebCodecs.";
const UNTIMED_MS = 1000; // longest transit of a picture without a capture time
// Not every encoder signals the colour space that the vehicle uses (ITU-R BT.709); for small pictures browsers assume BT.601.
/** @type {VideoColorSpaceInit} */
const BT709 = { primaries: "bt709", transfer: "bt709", matrix: "bt709", fullRange: false };

/** @typedef {import("./picture.js").Picture} Picture */
/** @typedef {{picture: Picture, meta: any, image?: import("./remote_warp.js").Image|null}} Shown image: the picture straightened; null: its region is unknown */

export class Stream {
  arrived = now(); // page times of the newest unit and of the newest picture to draw, or of the start of the stream
  decoded = this.arrived;
  ready_at = this.arrived; // page time when the newest picture was decoded
  drawn = false;
  waits_since = this.arrived; // since when pictures arrive and none is drawn
  /** @type {number|null} */
  stood_since = null; // when the last picture before a restart of the decoder was drawn; null: none was since the stream started
  damaged = false; // the picture drawn shows that packets were lost
  late_until = 0;

  /**
   * @param {object} camera as in hello
   * @param {object} station what all streams share: clock, limits, connected, online, resync(name), onMark(name, mark), wake() requests a redraw,
   *   onStraightenFailed(stream, error)
   */
  constructor(camera, station) {
    this.camera = camera;
    this.name = camera.name;
    this.station = station;
    /** @type {OffscreenCanvas|null} */
    this.canvas = null;
    /** @type {OffscreenCanvasRenderingContext2D|null} */
    this.context = null;
    this.isFresh = true; // whether nothing was painted into the canvas yet
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
    this.pace = new Pace(camera.fps);
    this.counts = { received: 0, due: 0, decoded: 0, drawn: 0, errors: 0, resyncs: 0 };
    this.error = ""; // the decoder's last one
    this.lasting = !station.video ? NO_VIDEO : isKnown(camera.codec) ? "" : `This page cannot show ${nameOf(camera.codec)}.`; // why there will never be a picture
    this.refused = this.lasting; // why there is none
    this.refused_at = now(); // when the browser last reported that it has no decoder
    this.stages = [];
    this.first_drawn = null;
    this.first = null; // for tests, the first picture drawn
    this.last_resync = this.restarted = -Infinity;
    this.resync_interval = RESYNC_MIN_MS;
    this.transit = null; // usual time from the station to this page
    this.on = this.sending = null;
    this.unopened = false; // whether the vehicle cannot open the source
    /** @type {number|null} */
    this.slow_fps = null; // what the camera delivers, if well below its rate
    /** @type {number|null} */
    this.failed_at = null; // when the source failed: it may repeat old pictures as new
    this.status = this.reported = "synchronising";
    this.isResizeDue = false; // whether the canvas keeps an old size for now
    /** @type {string|null} */
    this.painted_text = ""; // overlay text in the canvas, "" for the plain picture; null: to be painted again
    this.mark = ""; // the mark that the canvas shows
    this.last_drawn = 0; // page time
    this.late_age = NaN; // of the last late picture
    this.guides = camera.pose && station.dimensions ? new GuideLines(camera, station.dimensions) : null;
    this.full = { x: 0, y: 0, width: camera.width, height: camera.height };
    /** @type {import("./framing.js").Rectangle|null} */
    this.region = null; // the part of the full image that pictures show; null: unknown, or about to change
    /** @type {import("./framing.js").Size|null} */
    this.expected = null; // size of these pictures; null: likewise
    this.region_since = Infinity; // page time: pictures captured from this time on show the region
    this.size_since = Infinity;
    /** @type {StraightView|null} */
    this.straight = null; // shows the picture straightened
    this.isInBirdseye = false; // whether the bird's-eye view uses the picture, too
    this.composed_at = -Infinity; // when the picture in it was decoded; -Infinity: it has not been drawn since it was shown
    this.composed_fps = Infinity; // how often it is drawn, at most
    this.resetTimes();
  }

  /** The stream starts or restarts: silence counts from now. */
  resetTimes() {
    this.arrived = this.decoded = this.waits_since = now();
    this.drawn = this.damaged = false;
    this.stood_since = null;
    this.composed_at = -Infinity;
    this.late_until = 0;
  }

  /** The vehicle's decision about this camera; undefined: the vehicle does not have it. */
  onDecision(decision) {
    const { on = null, sending = null, scaling, fault, slow_fps = null } = decision ?? {};
    const begins = on && sending && (this.on === false || this.sending === false);
    Object.assign(this, { on, sending, slow_fps, unopened: on === true && scaling === null });
    this.failed_at = fault ? (this.failed_at ?? now()) : null;
    if (begins) this.resetTimes();
    if (decision) this.updateRegion(decision);
  }

  /** Track which part of the full image the pictures show, once it has been read back. */
  updateRegion({ roi, width, height, applied }) {
    const { x, y, width: wide, height: high } = applied.roi ?? roi;
    const size = applied.size ?? { width, height };
    const isApplied = x === roi.x && y === roi.y && wide === roi.width && high === roi.height;
    const region = isApplied ? { x, y, width: wide, height: high } : null;
    const expected = isApplied && size.width === width && size.height === height ? size : null;
    const since = now(); // the station's clock may be unknown yet, or be set
    if (JSON.stringify(region) !== JSON.stringify(this.region)) Object.assign(this, { region, region_since: since });
    if (JSON.stringify(expected) !== JSON.stringify(this.expected)) Object.assign(this, { expected, size_since: since });
  }

  /** The region that the displayed picture is known to show. */
  shownRegion() {
    return this.shown && this.regionOf(this.shown);
  }

  /** The region that a picture is known to show. @param {Shown} one */
  regionOf({ picture, meta }) {
    const { region } = this;
    return region && this.capturedAt(meta) >= this.region_since && hasAspectOf(picture, region) ? region : null;
  }

  /** Page time at which a picture was captured; if unknown, the earliest possible time. */
  capturedAt({ captured = NaN, arrived = NaN }) {
    return (Number.isFinite(captured) ? captured : arrived - UNTIMED_MS) - this.station.clock.offset;
  }

  attach(canvas) {
    this.canvas = canvas;
    this.isFresh = true;
    this.context = canvas.getContext("2d", { alpha: false, desynchronized: true });
    this.painted_text = null;
    this.station.wake();
  }

  // --- from the station into the decoder ------------------------------------------------------------------------------

  /** @param {{flags: number, sequence: number, captured: number, arrived: number, data: Uint8Array}} unit */
  receive(unit) {
    const received = now();
    this.counts.received++;
    // The first units may have reached the station long ago, if the camera has stopped sending.
    const reached = unit.arrived - this.station.clock.offset + this.station.clock.bound;
    const isLatest = !(unit.flags & CATCH_UP); // those before it are older, however recent the newest picture is
    this.arrived = this.drawn || !isLatest || !Number.isFinite(reached) ? received : Math.min(received, reached);
    if (!(unit.flags & CATCH_UP)) this.counts.due++; // also if it cannot be drawn
    if (this.refused && !this.lasting && unit.flags & KEY) this.retryRefused(unit.data);
    if (this.refused) return;
    if (unit.flags & RESTART) this.restart();
    if (unit.flags & KEY) this.configure(unit.data);
    if (!this.decoder || this.decoder.state !== "configured") return this.resync();
    if (this.isLagging(unit, received)) this.resync();
    this.decode(unit, received);
  }

  restart() {
    this.close();
    if (this.drawn) this.stood_since = this.last_drawn;
    this.drawn = false;
    this.transit = null;
    this.restarted = now();
  }

  /** A key unit sets the decoder up, and again if its parameters change. */
  configure(data) {
    const sps = spsOf(data, this.camera.codec);
    if (!sps && !this.decoder) return this.checkUsual();
    if (!sps || (this.decoder && String(sps) === this.sps)) return;
    this.close();
    this.sps = String(sps);
    const codec = codecOf(sps, this.camera.codec);
    const decoder = new VideoDecoder({
      output: (frame) => (decoder === this.decoder ? this.onFrame(frame) : frame.close()),
      error: (error) => decoder === this.decoder && this.onError(error),
    });
    this.decoder = decoder;
    this.codec = codec;
    decoder.configure({ codec, optimizeForLatency: true, colorSpace: BT709 });
  }

  /** Without parameter sets nothing can be decoded, but whether it ever could is known from the codec. */
  async checkUsual() {
    const why = await this.refusal(USUAL[this.camera.codec]);
    if (why && !this.decoder && this.sps === null) Object.assign(this, { refused: why, refused_at: now() });
  }

  /** Why the browser does not decode this stream, "" if it can. Browsers name the error differently. */
  async refusal(codec) {
    const { supported } = await VideoDecoder.isConfigSupported({ codec }).catch(() => ({ supported: false }));
    const name = nameOf(this.camera.codec);
    return supported ? "" : `This browser has no decoder for ${name} (${codec}). Use an H.264 graph or another browser.`;
  }

  /** A different stream may have a profile that the browser decodes, and a decoder may be missing only temporarily. */
  async retryRefused(data) {
    const sps = spsOf(data, this.camera.codec);
    if (!sps) return;
    if (String(sps) !== this.sps) return void (this.refused = "");
    if (now() - this.refused_at < REFUSED_RETRY_MS) return;
    this.refused_at = now();
    if (!(await this.refusal(this.codec))) this.refused = "";
  }

  decode(unit, received) {
    this.timestamp += 1000;
    this.meta.set(this.timestamp, { ...unit, data: null, timestamp: this.timestamp, received });
    // The picture is at least that late when it is drawn; until then the one before would count as live.
    if (this.drawn && !(unit.flags & CATCH_UP) && !this.isOnlyInBirdseye) this.checkAge(unit, received);
    const type = unit.flags & KEY ? "key" : "delta";
    try {
      this.decoder?.decode(new EncodedVideoChunk({ type, timestamp: this.timestamp, data: unit.data }));
    } catch (error) {
      this.onError(error); // a delta unit when the decoder expects a key unit
    }
  }

  isLagging(unit, received) {
    if (unit.flags & CATCH_UP || this.isSettling()) return false;
    if (this.queueLength() > QUEUE) return true;
    const transit = this.station.clock.toStation(received) - unit.arrived;
    if (!Number.isFinite(transit)) return false;
    this.transit = this.transit === null ? transit : Math.min(transit, this.transit + 0.5);
    return transit > this.transit + LAG_MS;
  }

  /** Whether the decoder is still busy with the initial burst. */
  isSettling() {
    return !this.drawn && now() - this.restarted < SETTLE_MS;
  }

  /** Units in the decoder. */
  queueLength() {
    return this.decoder?.decodeQueueSize ?? 0;
  }

  async onError(error) {
    this.close();
    const { codec } = this;
    const why = await this.refusal(codec);
    if (why && codec === this.codec) return void Object.assign(this, { refused: why, refused_at: now() }); // another burst would not help
    this.counts.errors++;
    this.error = String(error);
    this.resync();
  }

  resync() {
    const since = now() - this.last_resync;
    if (since < this.resync_interval) return;
    this.resync_interval = since > 2 * this.resync_interval ? RESYNC_MIN_MS : Math.min(RESYNC_MAX_MS, 2 * this.resync_interval);
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

  // --- from the decoder to the screen ---------------------------------------------------------------------------------

  onFrame(frame) {
    const meta = this.meta.get(frame.timestamp);
    for (const key of this.meta.keys()) if (key <= frame.timestamp) this.meta.delete(key);
    this.counts.decoded++;
    const hasNewer = this.isSettling() && this.queueLength() > 1;
    if (!meta || meta.flags & CATCH_UP || hasNewer) return frame.close();
    this.queuePicture(frame, { ...meta, decoded: now() }, this.decoder);
  }

  async queuePicture(frame, meta, decoder) {
    const size = { width: frame.displayWidth, height: frame.displayHeight };
    const picture = await pictureOf(frame, this.isInBirdseye || this.straight ? Infinity : this.widthOnScreen(size)).catch(() => null);
    if (!picture) return void this.counts.errors++;
    if (decoder !== this.decoder || meta.timestamp < (this.waiting?.meta.timestamp ?? 0)) return picture.close();
    this.waiting?.picture.close();
    this.waiting = { picture, meta };
    this.ready_at = now();
    if (this.countsDecoded) this.decoded = this.ready_at;
    this.station.wake();
  }

  /** Whether there is a picture to draw. */
  get isWaiting() {
    return this.waiting !== null && this.context !== null && (!this.straight || this.straight.warp.isDue);
  }

  /** Draw the newest frame; called in the worker's animation frame. */
  draw() {
    const { waiting } = this;
    if (!waiting || !this.context) return;
    this.waiting = null;
    if (this.straight) this.drawStraightened(waiting);
    else this.show(waiting);
  }

  /** Draw a picture once it is straightened, unless it is no longer wanted then. @param {Shown} next */
  async drawStraightened(next) {
    const { straight, decoder } = this;
    const isStraightened = await this.straightenPicture(next);
    if (!isStraightened || straight !== this.straight || decoder !== this.decoder) return closeShown(next);
    if (!this.isOnlyInBirdseye) this.decoded = now();
    this.show(next);
  }

  /** Straighten a picture; returns whether that succeeded. @param {Shown} one */
  async straightenPicture(one) {
    const { straight } = this;
    const region = this.regionOf(one);
    try {
      const image = region && straight ? await straight.straightened(one.picture, region, this.straightSize()) : null;
      closeImage(one);
      one.image = image;
      return true;
    } catch (error) {
      if (straight === this.straight) this.station.onStraightenFailed(this, error);
      return false;
    }
  }

  /** @param {Shown} next */
  show(next) {
    closeShown(this.shown);
    this.shown = next;
    this.drawn = true;
    this.stood_since = null;
    this.last_drawn = now();
    this.damaged = Boolean(next.meta.flags & DAMAGED);
    this.counts.drawn++;
    if (!this.isOnlyInBirdseye) this.checkAge(next.meta, now());
    this.status = judge(this.times(), this.station.limits, now());
    this.paint(now());
    if (!this.isOnlyInBirdseye) this.recordStages(next.meta, now());
    if (this.station.keep) this.first ??= this.picture();
    if (this.station.counted === this.name) this.readCounter(next);
  }

  /** Show or hide the guides of this camera. */
  showGuides(shown) {
    if (!this.guides) return;
    if (this.guides.shown === shown) return;
    this.guides.shown = shown;
    if (this.shown) this.paint(now());
  }

  /** Draw the guides over the picture in the canvas; none over a stalled one, since nobody may steer by it. */
  drawGuides(context, canvas) {
    const { guides, shown } = this;
    const region = MOVING.includes(this.status) && this.display.width ? this.drawnRegion() : null;
    const area = this.visibleArea(canvas);
    const css = (canvas.width * this.display.ratio) / (this.widthOnScreen(canvas) || canvas.width);
    const { mirrored } = this.display.view;
    guides?.draw(context, shown && region && { region, rad: this.station.steering.angleAt(shown.meta.captured), area, css, mirrored });
  }

  /** The region in the canvas, of the image that the guides are made for; null: unknown. */
  drawnRegion() {
    const { shown, expected } = this;
    const region = this.shownRegion();
    if (!shown || !region) return null;
    if (this.straight) return shown.image ? this.full : null;
    const { width, height } = shown.picture;
    const fits = expected && width === expected.width && height === expected.height && this.capturedAt(shown.meta) >= this.size_since;
    return fits ? region : null;
  }

  /** For tests: the guides that are drawn, in CSS px of the picture's box. */
  guideLines() {
    const { canvas, guides, display } = this;
    if (!canvas || !guides) return undefined;
    const toBox = imageToBox(display, canvas, display.view, { x: 0, y: 0, width: canvas.width, height: canvas.height });
    return guides.drawn.map((line) => ({ ...line, pieces: line.pieces.map((piece) => piece.map(toBox)) }));
  }

  /** Show the picture straightened, or the original. */
  async straighten(on) {
    if (on === Boolean(this.straight)) return;
    this.straight?.dispose();
    this.changeView(() => (this.straight = on ? new StraightView(this.camera) : null));
    this.guides?.setOptics(on ? straightOptics(this.camera) : this.camera);
    if (on && this.shown) await this.straightenPicture(this.shown); // a stalled picture has no successor
    this.painted_text = null; // repaint at the next tick
  }

  /** The input of the bird's-eye view from this camera. */
  fromAbove() {
    const region = this.shownRegion();
    const moves = MOVING.includes(this.status);
    const picture = moves && region ? (this.shown?.picture ?? null) : null;
    const fill = picture ? FILLS.picture : STALLED.includes(this.status) ? FILLS.alarm : FILLS.none;
    const { captured = NaN } = (picture && this.shown?.meta) ?? {};
    return { picture, fill, captured, newest: this.shown, region: this.region ?? this.full, status: this.status, label: this.overlayText(now()) || (region ? "" : NEW_REGION) };
  }

  /** Whether the bird's-eye view alone shows the picture. */
  get isOnlyInBirdseye() {
    return this.isInBirdseye && !this.display.width;
  }

  /** Whether a picture counts once it is decoded; otherwise only once it is straightened or composed: one that cannot be drawn leaves the display frozen. */
  get countsDecoded() {
    return !this.straight && !this.isOnlyInBirdseye;
  }

  /** Change what shows the pictures. Those that count once they are decoded again do so from the newest one on: the last drawing may be older. @param {() => void} change */
  changeView(change) {
    const before = this.countsDecoded;
    change();
    if (this.countsDecoded && !before) this.decoded = Math.max(this.decoded, this.ready_at);
  }

  /** Start or end being a part of the bird's-eye view. @param {boolean} shown */
  setInBirdseye(shown) {
    if (shown && !this.isInBirdseye) this.composed_at = -Infinity;
    this.changeView(() => (this.isInBirdseye = shown));
  }

  /** Show the picture in a box of another size; 0: it is hidden. */
  setDisplay(display) {
    this.changeView(() => (this.display = display));
    this.painted_text = null;
  }

  /**
   * The bird's-eye view was drawn.
   * @param {Shown|null} one the picture that was the newest when drawing began  @param {boolean} isPart whether it was drawn  @param {number} fps
   */
  onComposed(one, isPart, fps) {
    this.composed_fps = fps;
    if (!this.isOnlyInBirdseye || !this.drawn || !one || one.meta.decoded <= this.composed_at) return;
    const isOld = now() - one.meta.decoded > frozenAfter(this.station.limits, this.camera.fps);
    this.decoded = this.composed_at === -Infinity && isOld ? one.meta.decoded : now(); // to show an old picture makes it no newer
    this.composed_at = one.meta.decoded;
    if (!isPart) return;
    this.checkAge(one.meta, now());
    this.recordStages(one.meta, now());
  }

  checkAge({ captured, arrived }, time) {
    const { clock, limits, bound } = this.station;
    const upper = clock.toStation(time) - captured + bound + clock.bound; // not finite if a clock is unknown
    const age = Number.isFinite(upper) ? upper : clock.toStation(time) - arrived - clock.bound; // at least
    if (Number.isFinite(age) && age > limits.late_ms) Object.assign(this, { late_until: time + Math.max(LATE_HOLD_MS, (1000 * INTERVALS) / this.camera.fps), late_age: age });
  }

  recordStages(meta, drawn) {
    this.first_drawn ??= drawn;
    const page = [meta.received, meta.decoded, drawn].map((time) => this.station.clock.toStation(time));
    this.stages.push([meta.captured, meta.arrived, ...page]);
    if (this.stages.length > STAGES) this.stages.shift();
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
      camera: this.name,
      elapsed_ms: counter === null ? null : elapsed(counter, drawn),
      age_ms: finite(clock.toStation(drawn) - captured),
      bound_ms: finite(bound + clock.bound),
    });
  }

  times() {
    const { connected, online } = this.station;
    const { on, sending, unopened, refused, stood_since, waits_since, damaged, arrived, decoded, late_until } = this;
    const [faulty, isAbove] = [this.failed_at !== null, this.isOnlyInBirdseye];
    const drawn = this.drawn && (!isAbove || this.composed_at > -Infinity);
    const fps = Math.min(this.slow_fps ?? this.camera.fps, this.straight?.warp.fps ?? Infinity, isAbove ? this.composed_fps : Infinity);
    const { wave_s } = this.camera;
    return { connected, online, on, sending, unopened, refused, drawn, stood_since, waits_since, wave_s, damaged, faulty, arrived, decoded, late_until, fps };
  }

  /** Whether too few pictures are drawn; to be called a few times a second. */
  isSlow() {
    this.pace.add(now(), this.counts.due, this.counts.drawn, MOVING.includes(this.status));
    return this.pace.isSlow;
  }

  /** Update the status; returns whether it has changed. Called by a timer. */
  updateStatus() {
    const time = now();
    this.status = judge(this.times(), this.station.limits, time);
    if (!WAITING.includes(this.status)) this.waits_since = time;
    if (this.context && this.textsOver(time) !== this.painted_text) this.paint(time);
    const changed = this.status !== this.reported;
    this.reported = this.status;
    return changed;
  }

  /** Draw what waits for a canvas of another size. */
  drawResized() {
    if (this.isResizeDue) this.paint(now());
  }

  /** All that is written over the picture. */
  textsOver(time) {
    return [this.overlayText(time), this.slowText()].filter(Boolean).join("\n");
  }

  /** That a moving picture has fewer frames than the camera should deliver: nothing is wrong with the stream. */
  slowText() {
    return this.slow_fps && MOVING.includes(this.status) ? slowText(this.slow_fps, this.camera.fps) : "";
  }

  overlayText(time) {
    if (this.status === "live") return this.straight && !this.shown?.image ? NEW_REGION : "";
    const late = this.isLateToo(time) ? `, ${alarmText("late", 0, this.late_age)}` : "";
    const stood = this.status === "frozen" ? (this.drawn ? this.decoded : (this.stood_since ?? this.waits_since)) : null; // units may still arrive
    return alarmText(this.status, time - Math.min(this.arrived, stood ?? Infinity, this.failed_at ?? Infinity), this.late_age) + late;
  }

  /** Whether a damaged picture is late as well. */
  isLateToo(time) {
    return this.status === "damaged" && time < this.late_until;
  }

  paint(time) {
    const { canvas, context } = this;
    if (!canvas || !context || this.isOnlyInBirdseye) return;
    const text = this.overlayText(time);
    this.resizeCanvas(canvas, STALLED.includes(this.status));
    if (this.shown && this.status !== "off" && this.status !== "unsupported") this.paintPicture(context, this.shown);
    else blank(context);
    this.drawGuides(context, canvas);
    this.labelEstimate(context, canvas);
    if (this.slowText()) drawNote(context, this.visibleArea(canvas), this.display.view.mirrored, this.slowText());
    if (text) drawOverlay(context, this.visibleArea(canvas), this.display.view.mirrored, this.status, text);
    this.painted_text = this.textsOver(time);
    this.reportMark(this.isLateToo(time) ? "damaged late" : this.status);
  }

  /** A picture straightened by optics that nobody has measured says so, as lines on the ground do. */
  labelEstimate(context, canvas) {
    if (!this.straight || !this.shown?.image || this.camera.calibrated || this.guides?.shown) return;
    const area = this.visibleArea(canvas);
    readably(context, area, this.display.view.mirrored, () => labelPicture(context, ESTIMATED, { left: 0, top: 0, bottom: area.height }));
  }

  /** Report the mark that the canvas shows from now on. */
  reportMark(mark) {
    if (mark === this.mark) return;
    this.mark = mark;
    this.station.onMark(this.name, mark);
  }

  /** @param {OffscreenCanvasRenderingContext2D} context  @param {Shown} shown */
  paintPicture(context, { picture, image = null }) {
    const { width, height } = context.canvas;
    if (!this.straight) picture.paint(context, width, height);
    else if (image) paintImage(context, image, width, height);
    else blank(context);
  }

  /**
   * The canvas has the picture's size. For a lasting alarm it is an integer multiple of it, close to the size on the
   * screen, so that words are sharp while the aspect ratio, and with it the page's layout, stays the same; for guides, too, if
   * the browser scales pictures with a GPU.
   */
  resizeCanvas(canvas, sharp) {
    const { width: wide, height: high, ratio } = this.display;
    const box = { width: Math.round(wide * ratio) || 480, height: Math.round(high * ratio) || 270 };
    const own = this.straight ? (this.shown?.image ?? this.straightSize()) : (this.shown?.picture.painted ?? box);
    const scale = this.widthOnScreen(own) / own.width;
    const times = Math.min(6, Math.max(1, sharp ? Math.ceil(scale) : this.guides?.shown && hasGpu ? Math.round(scale) : 1));
    const width = own.width * times;
    const height = own.height * times;
    if (this.isFresh) Object.assign(canvas, { width, height }); // nothing is shown yet
    this.isResizeDue = !resize(canvas, { width, height });
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
  visibleArea(canvas) {
    const { display } = this;
    return display.width && display.height ? visible(display, canvas, display.view) : { x: 0, y: 0, width: canvas.width, height: canvas.height };
  }

  // --- for tests and benchmarks ---------------------------------------------------------------------------------------

  measure(origin) {
    const picture = this.shown?.picture;
    return {
      status: this.status,
      note: this.slowText(),
      ...this.counts,
      error: this.error,
      straight: Boolean(this.straight && this.shown?.image && this.painted_text !== null),
      width: picture?.width ?? 0,
      height: picture?.height ?? 0,
      drawn_size: { width: this.canvas?.width ?? 0, height: this.canvas?.height ?? 0 },
      first_drawn_ms: this.first_drawn === null ? null : this.first_drawn - origin,
    };
  }

  /** The picture last drawn, as decoded: its luma and its capture time. */
  async picture() {
    return this.shown && describePicture(await this.shown.picture.decoded(), this.shown.meta);
  }

  dispose() {
    this.close();
    this.straight?.dispose();
    closeShown(this.shown);
    this.shown = null;
  }
}

/** Free a picture at once: garbage collection may be late. @param {Shown|null} shown */
function closeShown(shown) {
  if (!shown) return;
  closeImage(shown);
  shown.picture.close();
}

/** @param {Shown} shown */
function closeImage(shown) {
  /** @type {any} */ (shown.image)?.close?.();
  shown.image = null;
}

/** Whether a picture has a region's aspect ratio, to within rounding to even numbers of px. */
function hasAspectOf(picture, { width, height }) {
  return Math.abs(picture.width * height - picture.height * width) <= width + height;
}

/** JSON cannot represent NaN or Infinity. */
const finite = (ms) => (Number.isFinite(ms) ? ms : null);

function blank(context) {
  context.fillStyle = "#0b0e11";
  context.fillRect(0, 0, context.canvas.width, context.canvas.height);
}

function describePicture({ width, height, bytes, planes }, { sequence, captured }) {
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
