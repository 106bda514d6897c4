/** Which part of the image a picture shows: what it says itself, otherwise what the vehicle has applied for long enough. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { ShownRegion } from "../../runner/page/static/shown_region.js";

const FULL = { x: 0, y: 0, width: 640, height: 360 };
const LEFT = { x: 0, y: 0, width: 320, height: 360 };
const MIDDLE = { x: 160, y: 90, width: 320, height: 180 };
const station = { clock: { offset: 0 } };
const decision = (roi, more = {}) => ({ roi, width: 320, height: 180, applied: { roi, size: { width: 320, height: 180 } }, ...more });
const shown = (region, captured = Infinity) => /** @type {any} */ ({ picture: { width: 320, height: 180 }, meta: { region, captured, arrived: captured } });

test("a picture that says what it shows is believed, whatever has been decided since", () => {
  const region = new ShownRegion(station, FULL);
  assert.deepEqual(region.of(shown(MIDDLE)), MIDDLE);
  region.update(decision(LEFT, { placed: true }));
  assert.deepEqual([region.of(shown(MIDDLE)), region.placeOf(shown(MIDDLE))], [MIDDLE, { region: MIDDLE, frame: LEFT }]);
  region.update(decision(MIDDLE, { placed: true }));
  assert.deepEqual([region.of(shown(MIDDLE)), region.placeOf(shown(MIDDLE))], [MIDDLE, null]);
});

test("a picture whose pixels are not square is laid out by what it shows, also if that is the whole frame", () => {
  const region = new ShownRegion(station, FULL);
  region.update(decision(LEFT, { placed: true }));
  assert.deepEqual(region.placeOf(shown(LEFT)), { region: LEFT, frame: LEFT });
});

test("where pictures say what they show, one that says nothing shows the full image", () => {
  const region = new ShownRegion(station, FULL);
  region.update(decision(MIDDLE, { placed: true }));
  assert.deepEqual([region.of(shown(null)), region.placeOf(shown(null))], [FULL, { region: FULL, frame: MIDDLE }]);
  assert.equal(region.of(null), null);
});

test("the region that the operator has chosen is laid out, and a smaller one that is sent has its place in it", () => {
  const region = new ShownRegion(station, FULL);
  region.update(decision(MIDDLE, { placed: true, chosen: FULL }));
  assert.deepEqual([region.frame, region.placeOf(shown(MIDDLE))], [FULL, { region: MIDDLE, frame: FULL }]);
  region.update(decision(MIDDLE, { placed: true }));
  assert.deepEqual([region.frame, region.placeOf(shown(MIDDLE))], [MIDDLE, null]);
});

test("other streams' pictures show what was applied when they were captured, or it is not known", () => {
  const region = new ShownRegion(station, FULL);
  region.update(decision(FULL));
  const [before, after] = [shown(null, -1e9), shown(null)];
  assert.deepEqual([region.of(before), region.of(after), region.placeOf(after)], [null, FULL, null]);
  region.update({ ...decision(MIDDLE), applied: { roi: FULL } });
  assert.equal(region.of(after), null);
});
