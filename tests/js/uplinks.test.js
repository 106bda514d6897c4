/** Several uplinks, a line for each. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { uplinkLines } from "../../runner/page/static/uplinks.js";

const decided = (total_kbps, stalled = false) => ({ total_kbps, stalled, reason: "capacity of the link, believed to be 3300" });
const measured = (kbps, more = {}) => ({ kbps, queue_ms: 12.4, loss: 0.0034, state: "clear", rtt_ms: 30, ...more });
const cameras = { front: { uplinks: ["a", "b"] }, rear_left: { uplinks: ["a"] }, mast: {} };
const state = (uplinks) => /** @type {any} */ ({ online: true, cameras, uplinks });
const texts = (...parts) => uplinkLines(...parts).map(({ text, isStalled }) => [text.replaceAll("\u00a0", " "), isStalled]);

test("a vehicle with one uplink, or none online, has no lines", () => {
  assert.deepEqual(uplinkLines(state(undefined), null), []);
  assert.deepEqual(uplinkLines(/** @type {any} */ ({ online: false }), null), []);
  assert.deepEqual(uplinkLines(null, null), []);
});

test("each says what it carries and may carry", () => {
  const sample = /** @type {any} */ ({ uplinks: { a: measured(2950.2) } });
  assert.deepEqual(texts(state({ a: decided(3000), b: decided(1500), c: decided(100) }), sample), [
    ["a: 2950 of 3000 kbit/s, 12 ms, 0 % lost: front, rear left", false],
    ["b: – of 1500 kbit/s, – ms, – % lost: front", false],
    ["c: – of 100 kbit/s, – ms, – % lost: no camera", false],
  ]);
});

test("all cameras are not listed", () => {
  const everywhere = { ...state({ a: decided(100) }), cameras: { front: { uplinks: ["a"] }, mast: { uplinks: ["a", "b"] } } };
  assert.deepEqual(texts(everywhere, null), [["a: – of 100 kbit/s, – ms, – % lost: all cameras", false]]);
});

test("a stall is said at once, by whichever message tells first", () => {
  const sample = /** @type {any} */ ({ uplinks: { a: measured(0, { state: "stalled" }) } });
  for (const known of [texts(state({ a: decided(50) }), sample), texts(state({ a: decided(50, true) }), null)])
    assert.deepEqual(known, [["✕ a: STALLED: front, rear left", true]]);
});
