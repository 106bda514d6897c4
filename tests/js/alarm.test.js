/** When a tone is due. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { Alarm, worstKind } from "../../runner/page/static/alarm.js";

/** The tones of changes of status, each [ms, status, camera]. */
function tones(...changes) {
  const alarm = new Alarm();
  return changes.map(([now, status, camera = "front"]) => alarm.due(camera, status, now));
}

test("a stalled picture and a late one have different tones", () => {
  for (const status of ["lost", "frozen", "unsupported"]) assert.deepEqual(tones([0, status]), ["lost"]);
  for (const status of ["late", "damaged"]) assert.deepEqual(tones([0, status]), ["late"]);
  for (const status of ["live", "synchronising", "off", "ended"]) assert.deepEqual(tones([0, status]), [null]);
});

test("a picture that fails again within two seconds triggers one tone", () => {
  assert.deepEqual(tones([0, "frozen"], [5, "frozen"], [900, "lost"], [2000, "lost"]), ["lost", null, null, "lost"]);
});

test("pictures that fail together trigger one tone, even as they get worse", () => {
  const together = [[0, "frozen", "front"], [5, "frozen", "rear"], [900, "frozen", "left"]];
  const worse = [[1500, "lost", "front"], [1500, "lost", "rear"], [1500, "lost", "left"]];
  assert.deepEqual(tones(...together, ...worse), ["lost", null, null, null, null, null]);
});

test("a picture that fails a second after another one triggers a tone", () => {
  assert.deepEqual(tones([0, "frozen", "front"], [300, "live", "front"], [1000, "lost", "rear"]), ["lost", null, "lost"]);
});

test("a picture that recovers and fails again for good sounds once two seconds are over", () => {
  const alarm = new Alarm();
  for (const [now, status, tone] of [[0, "frozen", "lost"], [200, "live", null], [420, "frozen", null], [1300, "lost", null]]) assert.equal(alarm.due("front", status, now), tone);
  assert.deepEqual([1999, 2000, 2250, 9000].map((now) => alarm.overdue(now)), [null, "lost", null, null]);
});

test("a picture that moves again damaged or late, and stalls again for good, sounds once two seconds are over", () => {
  for (const status of ["damaged", "late"]) {
    const alarm = new Alarm();
    assert.equal(alarm.due("front", "frozen", 0), "lost");
    assert.equal(alarm.due("front", status, 300), null);
    assert.equal(alarm.due("front", "frozen", 600), null);
    assert.equal(alarm.due("front", "lost", 1500), null);
    assert.deepEqual([alarm.overdue(1900), alarm.overdue(2000), alarm.overdue(4500)], [null, "lost", null]);
  }
});

test("a pause sounds like a stalled picture once it has lasted a second", () => {
  const alarm = new Alarm();
  assert.equal(alarm.due("front", "paused", 0), null);
  assert.deepEqual([999, 1000, 5000].map((now) => alarm.overdue(now)), [null, "lost", null]);
  assert.equal(alarm.due("front", "live", 6000), null);
  assert.equal(alarm.due("front", "paused", 9000), null);
  assert.equal(alarm.due("front", "live", 9900), null);
  assert.equal(alarm.overdue(20_000), null);
});

test("a picture that recovers again, or never did, sounds no more", () => {
  for (const changes of [[[200, "live"], [420, "frozen"], [900, "live"]], [[900, "lost"]]]) {
    const alarm = new Alarm();
    alarm.due("front", "frozen", 0);
    for (const [now, status] of changes) alarm.due("front", status, now);
    assert.equal(alarm.overdue(5000), null);
  }
});

test("of several pictures that failed again, one tone sounds, the worst", () => {
  const alarm = new Alarm();
  for (const [camera, status] of [["front", "frozen"], ["rear", "late"], ["left", "frozen"]]) alarm.due(camera, status, 0);
  for (const camera of ["front", "rear", "left"]) alarm.due(camera, "live", 300);
  for (const [camera, status] of [["rear", "late"], ["front", "frozen"], ["left", "lost"]]) alarm.due(camera, status, 600);
  assert.deepEqual([alarm.overdue(2100), alarm.overdue(2400)], ["lost", null]);
});

test("a late picture does not mask a stalled one, but is masked by it", () => {
  assert.deepEqual(tones([0, "late"], [50, "frozen"], [100, "late"], [2100, "late"]), ["late", "lost", null, "late"]);
});

test("a driver who takes control hears of the worst picture", () => {
  assert.deepEqual([["live", "late"], ["late", "frozen"], ["unsupported"], ["late", "paused"], ["live", "off"], []].map(worstKind), ["late", "lost", "lost", "lost", null, null]);
});
