/** One camera in the worker: its pictures from the decoder to the screen, and their status. */

import { now } from "./clock.js";
import { CATCH_UP, Decoding } from "./decoding.js";
import { described, DrawnPictures } from "./drawn_pictures.js";
import { Liveness } from "./liveness.js";
import { Pace } from "./pace.js";
import { pictureOf } from "./picture.js";
import { seenInBox } from "./seen.js";
import { sameRegion, ShownRegion } from "./shown_region.js";
import { frozenAfter, STALLED } from "./status.js";
import { StraightView } from "./straight_view.js";
import { StreamCanvas } from "./stream_canvas.js";
import { FILLS } from "./warp.js";

const NEW_REGION = "NEW REGION"; // while it is unknown which part of the image a picture shows
const NOT_SENT = "PART NOT SENT"; // of what the screen shows of the image

/** @typedef {import("./picture.js").Picture} Picture */
/**
 * @typedef {{picture: Picture, meta: any, image?: import("./remote_warp.js").Image|null}} Shown
 * image: the picture straightened; null: its region is unknown
 */

export class Stream {
  /** @type {Shown|null} */
  waiting = null; // newest decoded picture, not drawn yet
  /** @type {Shown|null} */
  shown = null; // picture last drawn, kept for alarms and for tests
  counts = { received: 0, due: 0, drawn: 0 };
  /** @type {unknown} */
  first = null; // for tests, the first picture drawn
  why = ""; // why there is no picture, in words; "" if there is one, or for another reason
  reported = "synchronising "; // status, and why
  mark = ""; // that the canvas shows
  /** @type {StraightView|null} */
  straight = null; // shows the picture straightened
  isInBirdseye = false; // whether the bird's-eye view uses the picture, too
  composed_at = -Infinity; // when the picture in it was decoded; -Infinity: it has not been drawn since it was shown
  composed_fps = Infinity; // how often it is drawn, at most

  /**
   * @param {object} camera as in hello
   * @param {object} station what all streams share: clock, limits, connected, online, resync(name), onMark(name, mark),
   *   wake() requests a redraw, onStraightenFailed(stream, error)
   */
  constructor(camera, station) {
    this.camera = camera;
    this.name = camera.name;
    this.station = station;
    this.decoding = new Decoding(camera, station, {
      hasDrawn: () => this.live.drawn,
      // The picture is at least that late when it is drawn; until then the one before would count as live.
      onUnit: (unit, received) => {
        if (this.live.drawn && !(unit.flags & CATCH_UP) && !this.isOnlyInBirdseye) this.live.checkAge(unit, received);
      },
      onFrame: (frame, meta) => this.queuePicture(frame, meta),
      onClosed: () => this.dropWaiting(),
      onRestart: () => this.live.onRestart(),
    });
    this.live = new Liveness(camera, station);
    this.full = { x: 0, y: 0, width: camera.width, height: camera.height };
    this.region = new ShownRegion(station, this.full);
    this.canvas = new StreamCanvas(camera, station.dimensions);
    this.drawn = new DrawnPictures(camera, station);
    this.pace = new Pace(camera.fps);
  }

  get status() {
    return this.live.status;
  }

  /** The stream starts or restarts: silence counts from now. */
  resetTimes() {
    this.live.reset();
    this.composed_at = -Infinity;
  }

  /** The vehicle's decision about this camera; undefined: the vehicle does not have it. */
  onDecision(decision) {
    if (this.live.onDecision(decision)) this.resetTimes();
    this.pace.fps = this.live.fps;
    const { frame } = this.region;
    if (decision) this.region.update(decision);
    if (this.region.stated(this.shown) && !sameRegion(frame, this.region.frame)) this.canvas.painted_text = null; // laid out anew
  }

  /** @param {import("./decoding.js").Unit} unit from the station */
  receive(unit) {
    const received = now();
    const isLatest = !(unit.flags & CATCH_UP); // those before it are older, however recent the newest picture is
    this.counts.received++;
    this.live.onUnit(unit, received, isLatest);
    if (isLatest) this.counts.due++; // also if it cannot be drawn
    this.decoding.receive(unit, received);
  }

  dropWaiting() {
    this.waiting?.picture.close();
    this.waiting = null;
  }

  async queuePicture(frame, meta) {
    const { decoder } = this.decoding;
    const size = { width: frame.displayWidth, height: frame.displayHeight };
    const wide = this.isInBirdseye || this.straight ? Infinity : widthOnScreen(this, size, meta);
    const picture = await pictureOf(frame, wide).catch(() => null);
    if (!picture) return void this.decoding.counts.errors++;
    const isOld = meta.timestamp < (this.waiting?.meta.timestamp ?? 0);
    if (decoder !== this.decoding.decoder || isOld) return picture.close();
    this.dropWaiting();
    this.waiting = { picture, meta };
    this.live.ready_at = now();
    if (this.countsDecoded) this.live.decoded = this.live.ready_at;
    this.station.wake();
  }

  /** Whether there is a picture to draw. */
  get isWaiting() {
    return this.waiting !== null && this.canvas.context !== null && (!this.straight || this.straight.warp.isDue);
  }

  /** Draw the newest frame; called in the worker's animation frame. */
  draw() {
    const { waiting } = this;
    if (!waiting || !this.canvas.context) return;
    this.waiting = null;
    if (this.straight) this.drawStraightened(waiting);
    else this.show(waiting);
  }

  /** Draw a picture once it is straightened, unless it is no longer wanted then. @param {Shown} next */
  async drawStraightened(next) {
    const { straight } = this;
    const { decoder } = this.decoding;
    const isStraightened = await this.straightenPicture(next);
    if (!isStraightened || straight !== this.straight || decoder !== this.decoding.decoder) return closeShown(next);
    if (!this.isOnlyInBirdseye) this.live.decoded = now();
    this.show(next);
  }

  /** Straighten a picture; returns whether that succeeded. @param {Shown} one */
  async straightenPicture(one) {
    const { straight } = this;
    const region = this.region.of(one);
    try {
      const size = this.canvas.straightSize();
      const image = region && straight ? await straight.straightened(one.picture, region, size) : null;
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
    this.live.onDrawn(next.meta);
    this.counts.drawn++;
    if (!this.isOnlyInBirdseye) this.live.checkAge(next.meta, now());
    this.live.judge(this.drawing(), now());
    this.paint(now());
    if (!this.isOnlyInBirdseye) this.drawn.record(next, now());
    if (this.station.keep) this.first ??= described(next);
    if (this.station.counted === this.name) this.drawn.readCounter(next);
  }

  /** Show or hide the guides of this camera. */
  showGuides(shown) {
    const { guides } = this.canvas;
    if (!guides || guides.shown === shown) return;
    guides.shown = shown;
    if (this.shown) this.paint(now());
  }

  /** Show the picture straightened, or the original. */
  async straighten(on) {
    if (on === Boolean(this.straight)) return;
    this.straight?.dispose();
    this.changeView(() => (this.straight = on ? new StraightView(this.camera) : null));
    this.canvas.setStraight(on);
    if (on && this.shown) await this.straightenPicture(this.shown); // a stalled picture has no successor
    this.canvas.painted_text = null; // repaint at the next tick
  }

  /** The input of the bird's-eye view from this camera. */
  fromAbove() {
    const { shown, status } = this;
    const region = this.region.of(shown);
    const picture = this.live.moves && region ? (shown?.picture ?? null) : null;
    const fill = picture ? FILLS.picture : STALLED.includes(status) ? FILLS.alarm : FILLS.none;
    const { captured = NaN } = (picture && shown?.meta) ?? {};
    const label = this.overlayText(now()) || (this.live.isNew ? this.live.noteText() : region ? "" : NEW_REGION);
    const frame = this.region.stated(shown) ? this.region.frame : (this.region.region ?? this.full);
    return { picture, fill, captured, newest: shown, region: region ?? frame, frame, status, label };
  }

  /** Whether the bird's-eye view alone shows the picture. */
  get isOnlyInBirdseye() {
    return this.isInBirdseye && !this.canvas.isShown;
  }

  /**
   * Whether a picture counts once it is decoded; otherwise only once it is straightened or composed: one that cannot be
   * drawn leaves the display frozen.
   */
  get countsDecoded() {
    return !this.straight && !this.isOnlyInBirdseye;
  }

  /**
   * Change what shows the pictures. Those that count once they are decoded again do so from the newest one on: the last
   * drawing may be older.
   * @param {() => void} change
   */
  changeView(change) {
    const before = this.countsDecoded;
    change();
    if (this.countsDecoded && !before) this.live.decoded = Math.max(this.live.decoded, this.live.ready_at);
  }

  /** Start or end being a part of the bird's-eye view. @param {boolean} shown */
  setInBirdseye(shown) {
    if (shown && !this.isInBirdseye) this.composed_at = -Infinity;
    this.changeView(() => (this.isInBirdseye = shown));
  }

  /** Show the picture in a box of another size; 0: it is hidden. */
  setDisplay(display) {
    this.changeView(() => (this.canvas.display = display));
    this.canvas.painted_text = null;
  }

  /**
   * The bird's-eye view was drawn.
   * @param {Shown|null} one the picture that was the newest when drawing began
   * @param {boolean} isPart whether it was drawn
   * @param {number} fps
   */
  onComposed(one, isPart, fps) {
    const { live, composed_at } = this;
    this.composed_fps = fps;
    if (!this.isOnlyInBirdseye || !live.drawn || !one || one.meta.decoded <= composed_at) return;
    const isOld = now() - one.meta.decoded > frozenAfter(this.station.limits, live.fps);
    live.decoded = composed_at === -Infinity && isOld ? one.meta.decoded : now(); // to show an old picture makes it no newer
    this.composed_at = one.meta.decoded;
    if (!isPart) return;
    live.checkAge(one.meta, now());
    this.drawn.record(one, now());
  }

  /** What `Liveness` does not know: whether the pictures can be decoded, and how they are drawn. */
  drawing() {
    const isAbove = this.isOnlyInBirdseye;
    return {
      refused: this.decoding.refused,
      drawn: !isAbove || this.composed_at > -Infinity,
      fps: Math.min(this.straight?.warp.fps ?? Infinity, isAbove ? this.composed_fps : Infinity),
    };
  }

  /** Whether too few pictures are drawn, not counting those of a stream that starts; to be called a few times a second. */
  isSlow() {
    if (this.status === "synchronising") this.pace.restart();
    this.pace.add(now(), this.counts.due, this.counts.drawn, this.live.moves);
    return this.pace.isSlow;
  }

  /** Update the status; returns whether it has changed. Called by a timer. */
  updateStatus() {
    const time = now();
    this.live.judge(this.drawing(), time);
    this.live.noteWaiting(time);
    if (this.canvas.isOutdated(this.overlayText(time), noteOf(this))) this.paint(time);
    this.why = this.live.declined || this.decoding.refused;
    const reported = `${this.status} ${this.why}`;
    const changed = reported !== this.reported;
    this.reported = reported;
    return changed;
  }

  /** Draw what waits for a canvas of another size. */
  drawResized() {
    if (this.canvas.isResizeDue) this.paint(now());
  }

  overlayText(time) {
    if (this.live.isNew) return ""; // its note says so
    if (this.status === "live") return this.straight && !this.shown?.image ? NEW_REGION : "";
    return this.live.alarmText(time);
  }

  paint(time) {
    if (this.isOnlyInBirdseye) return;
    const { shown, status } = this;
    const region = this.live.moves && this.canvas.isShown ? this.drawnRegion() : null;
    const steered = shown && region && { region, rad: this.station.steering.angleAt(shown.meta.captured) };
    const [isStraight, text, note] = [this.straight !== null, this.overlayText(time), noteOf(this)];
    const place = this.region.placeOf(shown);
    if (!this.canvas.paint({ shown, isStraight, place, status, text, note, steered })) return;
    const mark = this.live.isLateToo(time) ? "damaged late" : status;
    if (mark !== this.mark) this.station.onMark(this.name, mark);
    this.mark = mark;
  }

  /** The region in the canvas, of the image that the guides are made for; null: unknown. */
  drawnRegion() {
    if (!this.straight) return this.region.stated(this.shown) ? this.region.frame : this.region.ofSized(this.shown);
    return this.region.of(this.shown) && this.shown?.image ? this.full : null;
  }

  // --- for tests and benchmarks ---------------------------------------------------------------------------------------

  measure(origin) {
    const { canvas, painted_text } = this.canvas;
    const { first_at } = this.drawn;
    const picture = this.shown?.picture;
    return {
      status: this.status,
      note: noteOf(this),
      region: this.region.stated(this.shown),
      ...this.counts,
      ...this.decoding.counts,
      error: this.decoding.error,
      straight: Boolean(this.straight && this.shown?.image && painted_text !== null),
      width: picture?.width ?? 0,
      height: picture?.height ?? 0,
      drawn_size: { width: canvas?.width ?? 0, height: canvas?.height ?? 0 },
      first_drawn_ms: first_at === null ? null : first_at - origin,
    };
  }

  dispose() {
    this.decoding.close();
    this.straight?.dispose();
    closeShown(this.shown);
    this.shown = null;
  }
}

/** Width of a picture of this size on the screen, px. @param {Stream} stream */
function widthOnScreen({ canvas, region }, size, meta) {
  const [own, { frame }] = [region.statedIn(meta), region];
  return own ? (canvas.widthOnScreen(frame) * own.width) / frame.width : canvas.widthOnScreen(size);
}

/** What is no alarm, but must not look like a whole picture. @param {Stream} stream */
function noteOf({ live, straight, region, shown, canvas }) {
  const place = straight ? null : region.placeOf(shown);
  const isCut = place && canvas.isShown && !includes(place.region, seenInBox(place.frame, canvas.display));
  return live.noteText() || (isCut && live.moves ? NOT_SENT : "");
}

const NEAR_PX = 1; // a smaller part cannot be seen

/** Whether a region includes all of a part, to within a px. */
function includes(region, part) {
  const isWithin = (from, length, low, long) => from >= low - NEAR_PX && from + length <= low + long + NEAR_PX;
  return isWithin(part.x, part.width, region.x, region.width) && isWithin(part.y, part.height, region.y, region.height);
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
