/** One total, wherever the page shows it. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { copiesWords, ofWords, sliderValue, totalsOf } from "../../runner/page/static/totals.js";

/** @returns {any} */
const state = (total_kbps, asked_kbps, more = {}) => ({ online: true, total_kbps, asked_kbps, cameras: { front: { kbps: 6000 }, rear: { kbps: 3000 } }, ...more });
const shown = (now, mode) => {
  const totals = totalsOf(now);
  return [totals?.total, ofWords(totals), copiesWords(totals), sliderValue(totals, mode)];
};

test("without a prediction the link's total is the total and the slider's, not what the mode starts with", () => {
  assert.deepEqual(shown(state(9000, 3000), "automatic"), [9000, "", "", 9000]);
});

test("three viewers share it", () => {
  const copies = { front: 3, rear: 3 };
  assert.deepEqual(shown(state(27_000, 3000, { copies }), "automatic"), [27_000, "", " for 3 copies, 9000 each", 27_000]);
  assert.deepEqual(shown(state(27_000, 27_000, { copies }), "single"), [27_000, "", " for 3 copies, 9000 each", 27_000]);
});

test("the slider of mode C is what was set, of which the link may leave less", () => {
  assert.deepEqual(shown(state(1800, 3000), "collective"), [1800, " of 3000", "", 3000]);
  assert.deepEqual(shown(state(1800, 3000), "automatic"), [1800, " of 3000", "", 1800]);
});

test("of a vehicle that is offline it is unknown", () => {
  for (const now of [null, { ...state(9000, 9000), online: false }]) assert.deepEqual(shown(now, null), [undefined, "", "", undefined]);
});
