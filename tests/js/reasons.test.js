/** Why a camera is sent as it is, in words. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { cropWords, limitWords, percent, reasonWords, regionWords, setterWords, sizeWords } from "../../runner/page/static/reasons.js";
import { rate } from "../../runner/page/static/format.js";

const FULL = { width: 1920, height: 1040 };
const CAMERA = /** @type {any} */ ({
  on: true, sending: true, demand_kbps: 6000, kbps: 1181, scaling: 0.5, roi: { x: 0, y: 0, ...FULL }, width: 960, height: 520,
  reason: "1181 of 6000 kbit/s, range [950, ...) -> 0.5", weight: 1, applied: {}, fault: null,
});
const STATE = /** @type {any} */ ({ mode: "automatic", total_kbps: 6500, asked_kbps: 6500, cameras: { front: CAMERA } });
const OLD = "no prediction for 3.2 s, limit 2 s";
const FADED = `${CAMERA.reason}; total 9000 -> 6500: ${OLD}`;
const LINK = `${FADED}; total 6500 -> 6500: capacity of the link, believed to be 6500`;

test("a factor is a size", () => {
  const words = [1, 0.5, 0.25, 0.125, 0.375, 0.75, 0.3].map(sizeWords);
  assert.deepEqual(words, ["full size", "half size", "quarter size", "1/8 size", "3/8 size", "3/4 size", "0.3 of full size"]);
});

test("every bitrate has the same unit", () => {
  assert.equal(rate(1000, 6000), "1000 of 6000 kbit/s");
  assert.deepEqual([12_345.6, 0.4, null].map((kbps) => rate(kbps)), ["12346 kbit/s", "0 kbit/s", "– kbit/s"]);
});

test("a region of one page costs nothing", () => {
  const words = "This page alone shows 25 % of the image, which is sent and recorded whole. Full image (f) ends this.";
  assert.equal(cropWords({ x: 0, y: 0, width: 960, height: 520 }, FULL, "Full image (f)"), words);
});

test("a part of the image is never none of it", () => assert.deepEqual([0.25, 0.001].map(percent), ["25 %", "less than 1 %"]));

const SHARE = "Half size: 1181 of 6000 kbit/s, its share of the 6500";
const TABLE = [
  [{}, {}, `${SHARE} predicted.`],
  [{}, { predicted: false }, `${SHARE} at the start.`],
  [{}, { asked_kbps: 9000 }, `${SHARE} the link carries.`],
  [{}, { asked_kbps: 3000 }, `${SHARE} the link carries.`], // more than was predicted
  [{ reason: LINK }, { asked_kbps: 9000 }, `${SHARE} the link carries.`],
  [{ reason: FADED }, { asked_kbps: 9000 }, `${SHARE} left: ${OLD}.`], // not the link
  [{ reason: FADED }, { mode: "single", asked_kbps: 9000 }, `Half size: 1181 of 6000 kbit/s, less than was set: ${OLD}.`],
  [{ slow_fps: 10 }, {}, `${SHARE} predicted. Only 10 Hz: the camera is slow or the vehicle too busy, not the link.`],
  [{}, { mode: "collective" }, `${SHARE} set.`],
  [{}, { mode: "collective", asked_kbps: 9000 }, `${SHARE} the link carries.`],
  [{}, { mode: "single" }, "Half size: 1181 of 6000 kbit/s."],
  [{}, { mode: "single", asked_kbps: 9000 }, "Half size: 1181 of 6000 kbit/s, less than was set: the link carries no more."],
  [
    { kbps: 900, demand_kbps: 900, scaling: 1, reason: "900 of 900 kbit/s, as the camera encodes it" }, {},
    "Full size: 900 of 900 kbit/s, as the camera encodes it.",
  ],
  [
    { kbps: 1800, demand_kbps: 1800, scaling: 1, reason: "1800 of 1800 kbit/s, as the camera encodes it, more than its b_full of 1500" }, {},
    "Full size: 1800 of 1800 kbit/s, as the camera encodes it, more than its b_full of 1500.",
  ],
  [
    { kbps: 900, demand_kbps: 4000, scaling: 1, reason: "900 of 4000 kbit/s, as the camera is asked to encode it, but it sends 2100" }, {},
    "Full size: 900 of 4000 kbit/s, its share of the 6500 predicted, but it sends 2100 kbit/s.",
  ],
  [{ kbps: 6000, scaling: 1 }, {}, "Full size: 6000 of 6000 kbit/s, all that it can use."],
  [{ kbps: 7000 }, { mode: "single" }, "Half size: 7000 of 7000 kbit/s."],
  [{ roi: { x: 0, y: 0, width: 960, height: 520 }, demand_kbps: 1500, kbps: 300, scaling: 0.25 }, {}, "Quarter size of 25 % of the image: 300 of 1500 kbit/s, its share of the 6500 predicted."],
  [{ on: false, sending: false, scaling: null, reason: "switched off" }, {}, "Switched off."],
  [{ sending: false, scaling: null, reason: "lost: no /dev/video0" }, {}, "No picture: no /dev/video0."],
  [{ sending: false, reason: "0 of 6000 kbit/s; not sending: operator gone for 3.2 s" }, {}, "Paused: operator gone for 3.2 s."],
  [{ sending: false, weight: 0, reason: "0 of 6000 kbit/s, below 1 kbit/s: not sending" }, {}, "Paused: its weight is 0."],
  [{ sending: false, reason: "0 of 6000 kbit/s, below 1 kbit/s: not sending" }, {}, "Paused: nothing of the total is left for it."],
];
for (const [camera, { predicted = true, ...state }, words] of /** @type {any[]} */ (TABLE))
  test(words, () => assert.equal(reasonWords({ ...CAMERA, ...camera }, { ...STATE, ...state }, FULL, predicted), words));

test("what sets the total in mode A is the link where that limits, or raises, what was predicted", () => {
  assert.equal(setterWords(STATE, true), "Set by the prediction");
  assert.equal(setterWords(STATE, false), "Set by the mode, without a prediction");
  for (const asked_kbps of [3000, 9000]) assert.equal(setterWords({ ...STATE, asked_kbps }, true), "Set by what the link carries");
  assert.equal(setterWords({ ...STATE, asked_kbps: 9000, cameras: { front: { ...CAMERA, reason: FADED } } }, true), "Limited by a rule");
});

test("nothing is said of a vehicle that is offline", () => assert.equal(reasonWords(undefined, null, FULL, false), "–"));

test("a region of interest says what it costs", () => {
  const camera = { ...CAMERA, roi: { x: 0, y: 0, width: 960, height: 520 } };
  const begin = "Only 25 % of the image is sent, nobody sees the rest.";
  assert.equal(regionWords(camera, true, FULL, "Full image (f)"), `${begin} Its bitrate stays as it is. Full image (f) ends this.`);
  const automatic = `${begin} It gets no sharper: the camera asks for 25 % of its bitrate. Full image (f) ends this.`;
  assert.equal(regionWords(camera, false, FULL, "Full image (f)"), automatic);
});

test("what limits the total is said without the totals, and with a unit", () => {
  assert.equal(limitWords("total 3000 -> 1690: capacity of the link, believed to be 1690"), "capacity of the link, believed to be 1690 kbit/s");
  assert.equal(limitWords("total 3000 -> 1500: nothing has arrived for 2.1 s"), "nothing has arrived for 2.1 s");
});
