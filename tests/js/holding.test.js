/** What a page notices of its control: that it has gained, passed on or lost it. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { Holding } from "../../runner/page/static/holding.js";

/** What is noticed of who drives, each [who, given, ms], and whether control counts as lost then. */
function noticed(...changes) {
  const holding = new Holding();
  return changes.map(([who, given = null, now = 9000]) => [holding.update(who, given, now), holding.isLost]);
}

test("control taken by another page or a supervisor is lost until it is back", () => {
  for (const other of ["another", "operator"]) {
    const found = noticed(["you"], [other], [other], ["nobody"], ["you"], [other]);
    assert.deepEqual(found, [[null, false], ["lost", true], [null, true], [null, true], ["gained", false], ["lost", true]]);
  }
});

test("control that has been accepted from this page, or released, is not lost", () => {
  assert.deepEqual(noticed(["you"], ["operator", "offered"]), [[null, false], ["passed", false]]);
  assert.deepEqual(noticed(["you"], ["free", "released"], ["operator"]), [[null, false], [null, false], [null, false]]);
  assert.deepEqual(noticed(["you"], ["operator", "released"]), [[null, false], ["passed", false]], "to whoever asked for it");
});

test("a page that opens and is in control has not gained it, one that waits for it has", () => {
  assert.deepEqual(noticed(["unknown"], ["you"]), [[null, false], [null, false]]);
  assert.deepEqual(noticed(["unknown"], ["free"], ["you"]), [[null, false], [null, false], ["gained", false]]);
});

test("a vehicle that comes online has two seconds to hear of its operator", () => {
  const back = noticed(["you"], ["unknown", null, 0], ["unheard", null, 100], ["you", null, 400], ["unheard", null, 500]);
  assert.deepEqual(back, [[null, false], [null, false], [null, false], [null, false], ["lost", true]]);
  const gone = noticed(["you"], ["unknown", null, 0], ["free", null, 100], ["free", null, 2000], ["free", null, 2100]);
  assert.deepEqual(gone.at(-2), [null, false]);
  assert.deepEqual(gone.at(-1), ["lost", true]);
});
