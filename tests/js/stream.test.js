/** When the picture of a camera of 40 Hz counts as frozen, as the bird's-eye view and straightening begin and end without a GPU. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { Clock, now } from "../../runner/page/static/clock.js";
import { GroundView } from "../../runner/page/static/ground_view.js";
import { Stream } from "../../runner/page/static/stream.js";
import { WHOLE } from "../../runner/page/static/framing.js";

const FPS = 40;
const SLOW = 5; // pictures a second, of WebGL without a GPU
const CAMERA = { name: "top", index: 0, width: 640, height: 360, fps: FPS, codec: "h264", pose: null, wave_s: 1.5 };
const LIMITS = { late_ms: 200, frozen_ms: 120 };
const BOX = { width: 640, height: 360, ratio: 1, view: WHOLE };
const HIDDEN = { ...BOX, width: 0, height: 0 };
const straight = () => /** @type {any} */ ({ dispose() {}, warp: { fps: SLOW, isDue: false } });

/** A stream whose picture was last drawn, by the bird's-eye view or straightened, 230 ms ago. */
function slowStream({ display, ...more }, decoded_ms = 20) {
  const stream = new Stream(CAMERA, { clock: new Clock(), limits: LIMITS, connected: true, online: true, bound: NaN, video: true, dimensions: null, onMark() {}, wake() {} });
  Object.assign(stream, { composed_at: now() - 250, composed_fps: SLOW, ...more });
  Object.assign(stream.canvas, { display });
  const newest = now() - decoded_ms;
  stream.live.beginning.isOver = true;
  Object.assign(stream.live, { on: true, sending: true, drawn: true, arrived: newest, decoded: now() - 230, ready_at: newest });
  return stream;
}
function statusOf(stream) {
  stream.live.judge(stream.drawing(), now());
  return stream.status;
}

test("a picture that moves is live before and after its camera leaves the bird's-eye view", () => {
  const stream = slowStream({ isInBirdseye: true, display: HIDDEN });
  assert.equal(statusOf(stream), "live");
  stream.setInBirdseye(false);
  assert.equal(statusOf(stream), "live");
});

test("or its tile is shown beside it", () => {
  const stream = slowStream({ isInBirdseye: true, display: HIDDEN });
  stream.setDisplay(BOX);
  assert.equal(statusOf(stream), "live");
});

test("or it is no longer straightened", () => {
  const stream = slowStream({ straight: straight(), display: BOX });
  assert.equal(statusOf(stream), "live");
  stream.straighten(false);
  assert.equal(statusOf(stream), "live");
});

test("a picture that stands still is frozen at once", () => {
  const stream = slowStream({ isInBirdseye: true, display: HIDDEN }, 200);
  stream.setInBirdseye(false);
  assert.equal(statusOf(stream), "frozen");
});

/** A bird's-eye view of one camera whose drawing ends later: it, the pictures that were composed, and the drawing's end. */
function composing() {
  const view = new GroundView(/** @type {any} */ ({ angleAt: () => null }), assert.fail);
  const composed = [];
  let resolve = () => {};
  const drawing = new Promise((done) => (resolve = () => done(null)));
  view.warp = /** @type {any} */ ({ fps: SLOW, draw: () => drawing });
  view.streams = /** @type {any} */ ([{ setInBirdseye() {}, onComposed: (one) => composed.push(one) }]);
  view.show({ shown: true, width: 400, height: 300, ratio: 1 });
  const ordered = view.order({ width: 400, height: 300 }, {}, [{ newest: "picture", picture: null, label: "" }]);
  return { view, composed, end: () => (resolve(), ordered) };
}

test("a composition under way counts although the box changes, but not once the view was hidden or has other cameras", async () => {
  const changes = {
    box: (view) => view.show({ shown: true, width: 800, height: 600, ratio: 1 }),
    hidden: (view) => {
      view.warp.draw = () => new Promise(() => {});
      view.show({ shown: false, width: 0, height: 0, ratio: 1 });
      view.show({ shown: true, width: 400, height: 300, ratio: 1 });
    },
    cameras: (view) => view.setCameras([], null),
  };
  const counted = {};
  for (const [name, change] of Object.entries(changes)) {
    const { view, composed, end } = composing();
    change(view);
    await end();
    counted[name] = composed.length;
  }
  assert.deepEqual(counted, { box: 1, hidden: 0, cameras: 0 });
});

test("a picture is late as soon as it arrives too late, before it is drawn: the one before must not look live meanwhile", () => {
  const clock = Object.assign(new Clock(), { offset: 0, bound: 5 });
  const stream = slowStream({ display: BOX }, 0);
  Object.assign(stream.station, { clock, bound: 10 });
  const unit = (age_ms) => ({ flags: 0, sequence: 1, captured: now() - age_ms, arrived: now(), data: null });
  stream.live.decoded = now();
  stream.decoding.decode(unit(180), now());
  assert.equal(statusOf(stream), "live");
  stream.decoding.decode(unit(190), now());
  assert.equal(statusOf(stream), "late");
});

test("a browser that plays no H.265 says so although the stream states no parameter sets", async () => {
  const CRA = 21 << 1; // the first byte of its header
  const decoders = { configured: 0 };
  Object.assign(globalThis, { VideoDecoder: class { constructor() { decoders.configured++; } static isConfigSupported = async () => ({ supported: false }); } });
  const station = /** @type {any} */ ({ clock: new Clock(), limits: LIMITS, connected: true, online: true, bound: NaN, video: true, dimensions: null, resync() {} });
  const stream = new Stream({ ...CAMERA, codec: "h265" }, station);
  stream.receive({ flags: 1, sequence: 0, captured: 0, arrived: 0, data: Uint8Array.of(0, 0, 0, 1, CRA, 1, 0x55) });
  await new Promise((done) => setTimeout(done));
  assert.equal(stream.decoding.refused, "This browser has no decoder for H.265 (hev1.1.6.L93.B0). Use an H.264 graph or another browser.");
  assert.equal(decoders.configured, 0);
});
