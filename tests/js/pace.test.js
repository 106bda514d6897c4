/** A page that draws too few pictures says so, whatever the rate of the cameras. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { Pace } from "../../runner/page/static/pace.js";

/** After so many seconds in which pictures came and were drawn at these rates, reported four times a second. */
function after(seconds, due, drawn, pace = new Pace(), from = 0) {
  const before = pace.counts.at(-1) ?? { due: 0, drawn: 0 };
  for (let t = 0.25; t <= seconds; t += 0.25) pace.add(1000 * (from + t), before.due + due * t, before.drawn + drawn * t);
  return pace;
}

const TABLE = [
  ["all of 30 a second are drawn", 30, 30, false],
  ["every third of 30", 30, 10, false],
  ["fewer than ten of 30", 30, 9.5, true],
  ["none of 30", 30, 0, true],
  ["all of a camera of 5 a second", 5, 5, false],
  ["one of 5 misses the count", 5, 4, false],
  ["fewer than 80 % of 5", 5, 3.9, true],
  ["none come", 0, 0, false],
];
for (const [what, due, drawn, slow] of TABLE) test(`${what}: ${slow ? "slow" : "fine"}`, () => assert.equal(after(3, due, drawn).slow, slow));

test("a page that has just been opened is not judged", () => {
  assert.equal(new Pace().slow, false);
  assert.equal(after(2, 30, 0).slow, false, "less than two seconds between the first count and the last");
  assert.equal(after(2.25, 30, 0).slow, true);
});

test("two seconds count: a page that stops drawing is noticed in them, and recovers in them", () => {
  const pace = after(10, 30, 30);
  after(1.25, 30, 0, pace, 10);
  assert.equal(pace.slow, false);
  after(0.5, 30, 0, pace, 11.25);
  assert.equal(pace.slow, true);
  after(2, 30, 30, pace, 11.75);
  assert.equal(pace.slow, false);
});
