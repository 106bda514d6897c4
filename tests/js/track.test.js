/** The drive on a flat map. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { colourOfRate, headingText, metres, rangeOf } from "../../runner/page/static/track.js";

test("positions are metres from the first one; unknown ones are left out", () => {
  const found = metres({ lat: [null, 48, 48.001, 48], lon: [null, 11, 11, 11.001], actual_kbps: [1, 2, null, 4] });
  assert.deepEqual(found.kbps, [2, null, 4]);
  assert.deepEqual(found.x.map(Math.round), [0, 0, 74]); // at 48 degrees north
  assert.deepEqual(found.y.map(Math.round), [0, 111, 0]);
  assert.equal(metres({ lat: [null], lon: [null], actual_kbps: [1] }), null);
});

test("colours range from the smallest to the largest rate", () => {
  const range = rangeOf([null, 500, 4500]);
  assert.deepEqual(range, [500, 4500]);
  assert.deepEqual([500, 2500, 4500].map((rate) => colourOfRate(rate, range)), ["rgb(68,1,84)", "rgb(33,145,140)", "rgb(253,231,37)"]);
  assert.equal(colourOfRate(500, [500, 500]), "rgb(253,231,37)");
  assert.equal(rangeOf([null]), null);
});

test("a heading has a point of the compass", () => {
  assert.deepEqual([0, 44, 180, 337, 338, 359.7].map(headingText), ["N 0°", "NE 44°", "S 180°", "NW 337°", "N 338°", "N 0°"]);
});
