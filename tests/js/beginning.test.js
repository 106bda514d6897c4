/** A picture's first second is calm; what fails later, or does not recover from it, is an alarm at once. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { Beginning } from "../../runner/page/static/beginning.js";
import { Clock, now } from "../../runner/page/static/clock.js";
import { Liveness } from "../../runner/page/static/liveness.js";
import { MOVING, STALLED } from "../../runner/page/static/status.js";

/** What is shown of judged statuses, each [ms, status]. */
function shown(...judged) {
  const beginning = new Beginning();
  return judged.map(([time, status, drawn = true]) => beginning.shown(status, drawn, time));
}

test("a picture is live once it was so for a second", () => {
  assert.deepEqual(shown([0, "live"], [999, "live"], [1000, "live"], [1001, "late"]), ["synchronising", "synchronising", "live", "late"]);
});

test("while it is late, damaged or stands the second has not begun", () => {
  const start = [[0, "late"], [300, "frozen"], [600, "damaged"], [900, "live"], [1100, "late"], [1200, "live"]];
  assert.deepEqual(shown(...start, [2199, "live"], [2200, "live"]), [...Array(7).fill("synchronising"), "live"]);
});

test("three seconds after the first picture an alarm is no start any more", () => {
  for (const status of ["late", "damaged", "frozen"]) assert.deepEqual(shown([500, status], [3499, status], [3500, status]), ["synchronising", "synchronising", status]);
});

test("without any picture the status is as it is judged", () => {
  for (const status of ["synchronising", "frozen", "lost", "refused", "off"]) assert.deepEqual(shown([0, status, false], [9000, status, false]), [status, status]);
});

test("a picture that was lost and returns hides no alarm", () => {
  assert.deepEqual(shown([0, "live"], [500, "lost"], [600, "late"]), ["synchronising", "lost", "late"]);
});

const FPS = 40;
const DECISION = { on: true, sending: true, scaling: 0.5 };
const DRAWING = { refused: "" };

/** A camera that sends since the page was opened, and the times of its newest unit and picture, ms before now. */
function camera() {
  const station = { clock: new Clock(), limits: { late_ms: 200, frozen_ms: 120 }, connected: true, online: true, bound: NaN };
  const live = new Liveness({ fps: FPS, wave_s: 1.5 }, station);
  live.onDecision(DECISION);
  const draw = (time, ago = 20) => {
    live.onDrawn({ flags: 0 });
    Object.assign(live, { arrived: time - ago, decoded: time - ago });
    live.judge(DRAWING, time);
    return live.status;
  };
  return { live, station, draw };
}

test("the page opens: no alarm and no FROZEN until the first second is over, then both at once", () => {
  const { live, draw } = camera();
  const begun = now();
  assert.deepEqual([0, 500, 990].map((t) => draw(begun + t)), Array(3).fill("synchronising"));
  assert.equal(live.noteText(), "SYNCHRONISING");
  assert.equal(draw(begun + 1000), "live");
  assert.equal(live.noteText(), "");
  assert.equal(draw(begun + 1500, 121), "frozen");
  assert.equal(live.alarmText(begun + 1500), "FROZEN 0.1 s");
});

test("a camera that is switched on begins anew, one whose source failed or whose vehicle was offline does not", () => {
  for (const [before, status] of [[{ ...DECISION, on: false, sending: false }, "synchronising"], [{ ...DECISION, sending: false }, "synchronising"], [{ ...DECISION, sending: false, scaling: null }, "live"]]) {
    const { live, draw } = camera();
    const begun = now();
    for (const t of [0, 1000]) draw(begun + t);
    live.onDecision(before);
    live.onDecision(DECISION);
    assert.equal(draw(begun + 2000), status, JSON.stringify(before));
  }
  const { live, station, draw } = camera();
  const begun = now();
  for (const t of [0, 1000]) draw(begun + t);
  station.online = false;
  live.judge(DRAWING, begun + 1500);
  assert.equal(live.status, "lost");
  station.online = true;
  live.reset();
  assert.equal(draw(begun + 2000, 130), "frozen");
});

test("a camera that shows nothing is lost after three seconds", () => {
  const { live } = camera();
  const at = (ms) => (live.judge(DRAWING, live.arrived + ms), live.status);
  assert.deepEqual([900, 2900, 3001].map(at), ["synchronising", "synchronising", "lost"]);
});

test("a picture in its first second neither moves nor stalls, for a driver", () => {
  assert.ok(![...MOVING, ...STALLED].includes("synchronising"));
});

test("a source that repeats its picture is frozen for at least the limit", () => {
  const { live, draw } = camera();
  const begun = now();
  for (const t of [0, 1000]) draw(begun + t);
  live.onDecision({ ...DECISION, fault: "repeats its picture" });
  const failed = live.failed_at ?? NaN;
  live.judge(DRAWING, failed);
  assert.equal(live.alarmText(failed), "FROZEN 0.1 s");
});

test("a picture counts as frozen by the rate at which the vehicle sends, not by the camera's", () => {
  const { live, draw } = camera();
  const begun = now();
  for (const t of [0, 1000]) draw(begun + t);
  live.onDecision({ ...DECISION, fps: 5 });
  assert.equal(draw(begun + 1500, 250), "live");
  assert.equal(draw(begun + 1600, 270), "frozen");
  live.onDecision(DECISION);
  assert.equal(draw(begun + 1700, 250), "frozen");
});
