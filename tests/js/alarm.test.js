/** When a tone is due. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { Alarm } from "../../runner/page/static/alarm.js";

/** The tones of changes of status, each [ms, status]. */
function tones(...changes) {
  const alarm = new Alarm();
  return changes.map(([now, status]) => alarm.due(status, now));
}

test("a stalled picture and a late one have different tones", () => {
  for (const status of ["lost", "frozen", "unsupported"]) assert.deepEqual(tones([0, status]), ["lost"]);
  for (const status of ["late", "damaged"]) assert.deepEqual(tones([0, status]), ["late"]);
  for (const status of ["live", "synchronising", "off", "paused"]) assert.deepEqual(tones([0, status]), [null]);
});

test("eight pictures that fail together trigger one tone, and another one when they fail later", () => {
  assert.deepEqual(tones([0, "frozen"], [5, "frozen"], [900, "lost"], [2000, "lost"]), ["lost", null, null, "lost"]);
});

test("a late picture does not mask a stalled one, but is masked by it", () => {
  assert.deepEqual(tones([0, "late"], [50, "frozen"], [100, "late"], [2100, "late"]), ["late", "lost", null, "late"]);
});
