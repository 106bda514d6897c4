/** Drawing by another worker: without a GPU, how often and how large. */

import assert from "node:assert/strict";
import { mock, test } from "node:test";

import { setGpu } from "../../runner/page/static/picture.js";
import { RemoteWarp } from "../../runner/page/static/remote_warp.js";

/** @type {any} */
let other;
globalThis.Worker = /** @type {any} */ (class {
  posted = [];
  constructor() {
    other = this;
  }
  postMessage(message) {
    this.posted.push(message);
  }
});

const FRAME = { x: 0, y: 0, width: 1, height: 1 };
const answer = (why = "") => other.onmessage({ data: { kind: "drawn", id: other.posted.at(-1).id, image: null, why } });

test("without a GPU a drawing has at most 0.2 megapixels, and keeps its aspect ratio; with one it has the size on the screen", () => {
  const warp = new RemoteWarp(null);
  assert.deepEqual(warp.sizeFor({ width: 1280, height: 800 }), { width: 566, height: 354 });
  assert.deepEqual(warp.sizeFor({ width: 320, height: 200 }), { width: 320, height: 200 });
  setGpu(true);
  assert.deepEqual(warp.sizeFor({ width: 1280, height: 800 }), { width: 1280, height: 800 });
  setGpu(false);
});

test("a moving picture is due 200 ms after the last one without a GPU, with one as soon as that is drawn", async () => {
  const warp = new RemoteWarp(null);
  assert.equal(warp.isDue, true);
  const drawing = warp.draw({ width: 8, height: 8 }, FRAME, []);
  assert.deepEqual([warp.isBusy, warp.isDue], [true, false]);
  answer();
  await drawing;
  assert.deepEqual([warp.isBusy, warp.isDue, warp.fps], [false, false, 5]);
  setGpu(true);
  assert.deepEqual([warp.isDue, warp.fps], [true, Infinity]);
  setGpu(false);
  warp.drawn_at -= 200;
  assert.equal(warp.isDue, true);
});

test("a drawing without an answer for 10 s has failed, and a late answer changes nothing", async () => {
  mock.timers.enable({ apis: ["setTimeout"] });
  const warp = new RemoteWarp(null);
  const drawing = warp.draw({ width: 8, height: 8 }, FRAME, []);
  mock.timers.tick(9999);
  assert.equal(warp.isBusy, true);
  mock.timers.tick(1);
  await assert.rejects(drawing, { message: "nothing was drawn for 10 s" });
  assert.equal(warp.isBusy, false);
  answer();
  mock.timers.reset();
});

test("a drawing that fails states why, as does every one after the context was lost", async () => {
  const warp = new RemoteWarp(null);
  const drawing = warp.draw({ width: 8, height: 8 }, FRAME, []);
  answer("this browser has no WebGL 2");
  await assert.rejects(drawing, { message: "this browser has no WebGL 2" });
  other.onmessage({ data: { kind: "lost", target: warp.id, why: "lost" } });
  await assert.rejects(warp.draw({ width: 8, height: 8 }, FRAME, []), { message: "lost" });
  assert.equal(warp.isBusy, false);
});
