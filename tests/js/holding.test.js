/** Control that is lost is noticed once, control that is released is not lost. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { Holding } from "../../runner/page/static/holding.js";

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
