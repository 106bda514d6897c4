/** Control that is lost is noticed once, control that is released is not lost; a vehicle that hears no operator is noticed. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { Hearing, Holding } from "../../runner/page/static/holding.js";

const updated = (holding, ...holders) => holders.map((holder) => [holding.update(holder), holding.isLost]);

test("control taken by another page is lost until it is back", () => {
  const found = updated(new Holding(), "nobody", "you", "you", "another", "another", "nobody", "you", "another");
  assert.deepEqual(found, [[false, false], [false, false], [false, false], [true, true], [false, true], [false, true], [false, false], [true, true]]);
});

test("a release that the station has not received is neither forgotten nor taken for a loss", () => {
  const holding = new Holding();
  updated(holding, "you");
  holding.onRelease();
  assert.deepEqual([updated(holding, "you"), holding.isReleasing], [[[false, false]], true]);
  assert.deepEqual([updated(holding, "nobody"), holding.isReleasing], [[[false, false]], false]);
  holding.onRelease();
  holding.onTake();
  assert.deepEqual([updated(holding, "you", "another"), holding.isReleasing], [[[false, false], [true, true]], false]);
});

test("control that a page releases, or never had, is not lost", () => {
  const holding = new Holding();
  updated(holding, "you");
  holding.onRelease();
  assert.deepEqual(updated(holding, "nobody", "another"), [[false, false], [false, false]]);
  assert.deepEqual(updated(new Holding(), "another"), [[false, false]]);
});

const named = { online: true, operator: "anna" };
const unnamed = { online: true };
const heard = (...states) => {
  const hearing = new Hearing();
  return states.map(([now, state]) => [hearing.update(state, now), hearing.isLost]);
};

test("a vehicle that no longer names an operator receives nothing, until it names one again", () => {
  const found = heard([0, named], [100, unnamed], [200, unnamed], [300, named], [400, unnamed]);
  assert.deepEqual(found, [[false, false], [true, true], [false, true], [false, false], [true, true]]);
});

test("a vehicle that comes online has two seconds to hear of its operator", () => {
  const found = heard([0, named], [100, { online: false }], [200, unnamed], [2100, unnamed], [2200, unnamed]);
  assert.deepEqual(found, [[false, false], [false, false], [false, false], [false, false], [true, true]]);
});

test("a vehicle that is offline, or has never named an operator, has lost none", () => {
  assert.deepEqual(heard([0, unnamed], [9000, unnamed], [9100, null]), [[false, false], [false, false], [false, false]]);
  assert.deepEqual(heard([0, named], [10, null], [9000, { online: false }]), [[false, false], [false, false], [false, false]]);
});
