/** Alarms of other vehicles sound if this station drives or watches them, as often as those of its own pictures. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { OtherAlarms } from "../../runner/page/static/other_alarms.js";

const SUMMARY = { online: true, fault: null, is_own: false, control: "held", holder: "alice", received: [], alarms: [] };
/** @returns {any} */
const row = (name, summary = {}) => ({ name, fault: null, answer: "", summary: { ...SUMMARY, ...summary } });

/** What is told of each list, [rows, ms]: the tone, and what is new. */
function told(...lists) {
  const alarms = new OtherAlarms();
  return lists.map(([rows, now]) => {
    const { tone, news } = alarms.update(rows, "here", now);
    return [tone, ...news.map(({ name, text }) => `${name}: ${text}`)];
  });
}

test("an alarm sounds once, and again after it has ended, but not each time it flickers", () => {
  const fine = row("b", { is_own: true });
  const paused = row("b", { is_own: true, alarms: ["front: paused"] });
  const found = told([[fine], 0], [[paused], 1000], [[paused], 9000], [[fine], 10000], [[paused], 10100], [[fine], 10200], [[paused], 10300]);
  assert.deepEqual(found.map(([tone]) => tone), [null, "lost", null, null, "lost", null, null]);
  assert.deepEqual(found[1], ["lost", "b: front: paused"]);
});

test("vehicles that this station neither drives nor watches, and that of the page itself, are silent", () => {
  const alarms = ["front: paused"];
  assert.deepEqual(told([[row("b", { alarms }), row("here", { is_own: true, alarms })], 0]), [[null]]);
  assert.deepEqual(told([[row("b", { received: ["front"], alarms })], 0]), [["lost", "b: front: paused"]]);
});

test("a vehicle that this station drove or watched until it went offline sounds", () => {
  const watched = row("b", { received: ["front"] });
  const gone = row("b", { online: false, control: null });
  assert.deepEqual(told([[watched], 0], [[gone], 5000], [[gone], 9000]), [[null], ["lost", "b: offline"], [null]]);
  assert.deepEqual(told([[gone], 0]), [[null]]);
  assert.deepEqual(told([[watched], 0], [[row("b", { received: ["front"], control: "lost" })], 9])[1], ["lost", "b: alice was in control and is lost"]);
});
