/** Whether the pictures of one camera are live: the times that `judge` needs, the status, and the words of an alarm. */

import { Beginning } from "./beginning.js";
import { now } from "./clock.js";
import { DAMAGED } from "./decoding.js";
import { INTERVALS, MOVING, alarmText, frozenAfter, judge, keyText, slowText } from "./status.js";

const LATE_HOLD_MS = 500; // how long one late picture is indicated, at least until it counts as frozen
const WAITING = ["synchronising", "frozen"];

export class Liveness {
  arrived = now(); // page times of the newest unit and of the newest picture to draw, or of the start of the stream
  decoded = this.arrived;
  ready_at = this.arrived; // page time when the newest picture was decoded
  drawn = false;
  drawn_at = 0;
  waits_since = this.arrived; // since when pictures arrive and none is drawn
  /** @type {number|null} */
  stood_since = null; // when the last picture before a restart of the decoder was drawn; null: none was since the stream started
  damaged = false; // the picture drawn shows that packets were lost
  late_until = 0;
  late_age = NaN; // of the last late picture
  /** @type {boolean|null} */
  on = null;
  /** @type {boolean|null} */
  sending = null;
  unopened = false; // whether the vehicle cannot open the source
  declined = ""; // why the vehicle refuses the station its pictures; "": it does not
  /** @type {number|null} */
  slow_fps = null; // what the camera delivers, if well below the rate at which its pictures are sent
  /** @type {number|null} */
  failed_at = null; // when the source failed: it may repeat old pictures as new
  status = "synchronising";
  beginning = new Beginning();
  frozen_ms = 0; // limit in force

  /** @param {{fps: number, wave_s: number|null, passed?: boolean}} camera  @param {any} station see `Stream` */
  constructor(camera, station) {
    this.camera = camera;
    this.fps = camera.fps; // at which its pictures are sent
    this.station = station;
  }

  /** The stream starts or restarts: silence counts from now. */
  reset() {
    this.arrived = this.decoded = this.waits_since = now();
    this.drawn = this.damaged = false;
    this.stood_since = null;
    this.late_until = 0;
  }

  /** The vehicle's decision about this camera; undefined: the vehicle does not have it. Returns whether its pictures begin. */
  onDecision(decision) {
    const { on = null, sending = null, scaling, fault, slow_fps = null, fps = this.camera.fps } = decision ?? {};
    const begins = on && sending && (this.on === false || this.sending === false);
    if (begins && !this.unopened) this.beginning = new Beginning();
    Object.assign(this, { on, sending, slow_fps, fps, unopened: on === true && scaling === null });
    this.failed_at = fault ? (this.failed_at ?? now()) : null;
    return begins;
  }

  onUnit({ arrived }, received, isLatest) {
    // The first units may have reached the station long ago, if the camera has stopped sending.
    const reached = arrived - this.station.clock.offset + this.station.clock.bound;
    this.arrived = this.drawn || !isLatest || !Number.isFinite(reached) ? received : Math.min(received, reached);
  }

  /** The decoder restarts. */
  onRestart() {
    if (this.drawn) this.stood_since = this.drawn_at;
    this.drawn = false;
  }

  onDrawn({ flags }) {
    this.drawn = true;
    this.stood_since = null;
    this.drawn_at = now();
    this.damaged = Boolean(flags & DAMAGED);
  }

  checkAge({ captured, arrived }, time) {
    const { clock, limits, bound } = this.station;
    const upper = clock.toStation(time) - captured + bound + clock.bound; // not finite if a clock is unknown
    const age = Number.isFinite(upper) ? upper : clock.toStation(time) - arrived - clock.bound; // at least
    if (!Number.isFinite(age) || age <= limits.late_ms) return;
    this.late_until = time + Math.max(LATE_HOLD_MS, (1000 * INTERVALS) / this.fps);
    this.late_age = age;
  }

  /** @param {{refused: string, fps?: number, drawn?: boolean}} more fps: of the drawing, at most; drawn: whether the newest counts */
  times({ refused, fps = Infinity, drawn = true }) {
    const { connected, ended, online } = this.station;
    const { on, sending, unopened, stood_since, waits_since, damaged, arrived, decoded, late_until } = this;
    const { wave_s } = this.camera;
    const known = { connected, ended, online, on, sending, unopened, refused, stood_since, waits_since, wave_s, damaged };
    const faulty = this.failed_at !== null;
    const least = Math.min(this.slow_fps ?? this.fps, fps);
    const begins = !this.beginning.isOver;
    const stands = { begins, faulty, declined: this.declined !== "" };
    return { ...known, ...stands, arrived, decoded, late_until, drawn: this.drawn && drawn, fps: least };
  }

  judge(more, time) {
    const times = this.times(more);
    const { limits } = this.station;
    this.frozen_ms = frozenAfter(limits, times.fps);
    this.status = this.beginning.shown(judge(times, limits, time), this.hasDrawn, time);
  }

  /** To be called by a timer, after `judge`. */
  noteWaiting(time) {
    if (!WAITING.includes(this.status)) this.waits_since = time;
  }

  /** Whether a picture was drawn since the stream started. */
  get hasDrawn() {
    return this.drawn || this.stood_since !== null;
  }

  /** Whether the picture is in its first second. */
  get isNew() {
    return this.status === "synchronising" && this.hasDrawn;
  }

  get moves() {
    return MOVING.includes(this.status);
  }

  /**
   * What is no alarm: that a picture is in its first second, or that a moving one has fewer frames than the camera should
   * deliver, although nothing is wrong with the stream.
   */
  noteText() {
    if (this.isNew) return alarmText(this.status, 0, NaN);
    return this.slow_fps && this.moves ? slowText(this.slow_fps, this.fps) : "";
  }

  alarmText(time) {
    const late = this.isLateToo(time) ? `, ${alarmText("late", 0, this.late_age)}` : "";
    const { stood_since, waits_since } = this;
    if (this.status === "synchronising" && this.camera.passed) return keyText(time - (waits_since ?? time));
    // Units may still arrive.
    const stood = this.status === "frozen" ? (this.drawn ? this.decoded : (stood_since ?? waits_since)) : Infinity;
    const since = Math.min(this.arrived, stood, this.failed_at ?? Infinity);
    // A source that repeats its picture has done so for a while when it is found out.
    return alarmText(this.status, Math.max(time - since, this.frozen_ms), this.late_age) + late;
  }

  /** Whether a damaged picture is late as well. */
  isLateToo(time) {
    return this.status === "damaged" && time < this.late_until;
  }
}
