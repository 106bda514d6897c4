/** A page that draws too few pictures is detected, whatever the cameras' frame rates. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { Pace } from "../../runner/page/static/pace.js";

/** The pace after so many seconds with these rates of due and drawn pictures, reported four times a second. */
function after(seconds, due, drawn, pace = new Pace(30), from = 0, moves = true) {
  const before = pace.counts.at(-1) ?? { due: 0, drawn: 0 };
  for (let t = 0.25; t <= seconds; t += 0.25) pace.add(1000 * (from + t), before.due + due * t, before.drawn + drawn * t, moves);
  return pace;
}

const TABLE = [
  ["all of 30 a second are drawn", 30, 30, false],
  ["every third of 30", 30, 10, false],
  ["fewer than ten of 30", 30, 9.5, true],
  ["none of 30", 30, 0, true],
  ["all of a camera of 5 a second", 5, 5, false],
  ["four of 5 a second", 5, 4, false],
  ["fewer than 80 % of 5", 5, 3.9, true],
  ["none are due", 0, 0, false],
];
for (const [what, due, drawn, slow] of TABLE) test(`${what}: ${slow ? "slow" : "fine"}`, () => assert.equal(after(3, due, drawn, new Pace(due)).isSlow, slow));

test("fewer than ten a second are slow although no more arrive, unless the camera was paused meanwhile", () => {
  assert.equal(after(3, 9, 9, new Pace(30)).isSlow, true);
  assert.equal(after(3, 9, 9, new Pace(10)).isSlow, false);
  const pace = after(3, 30, 30);
  after(1, 0, 0, pace, 3, false);
  after(1, 9, 9, pace, 4);
  assert.equal(pace.isSlow, false);
});

test("a page that has just been opened is not judged", () => {
  assert.equal(new Pace(30).isSlow, false);
  assert.equal(after(2, 30, 0).isSlow, false, "less than two seconds between the first count and the last");
  assert.equal(after(2.25, 30, 0).isSlow, true);
});

test("a page that stops drawing is detected within two seconds, and recovers within two seconds", () => {
  const pace = after(10, 30, 30);
  after(1.25, 30, 0, pace, 10);
  assert.equal(pace.isSlow, false);
  after(0.5, 30, 0, pace, 11.25);
  assert.equal(pace.isSlow, true);
  after(2, 30, 30, pace, 11.75);
  assert.equal(pace.isSlow, false);
});

test("a stream that starts is not slow: what was not drawn before it had its first second does not count", () => {
  const pace = after(3, 30, 3);
  assert.equal(pace.isSlow, true);
  pace.restart();
  assert.equal(after(1.75, 30, 3, pace, 3).isSlow, false);
});
