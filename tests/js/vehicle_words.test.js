/** What a list of vehicles says of each. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { alarmsOf, driverOf, figuresOf, isHeldHere, pictureOf, stateOf, toWatcher } from "../../runner/page/static/vehicle_words.js";

const ONLINE = {
  online: true, fault: null, mode: "automatic", control: "free", holder: null, held_s: 0, offered: null, requested: [], is_own: false,
  speed_mps: null, latency_ms: null, bound_ms: null, allocated_kbps: 900, actual_kbps: 0, believed_kbps: null, alarms: [],
  cameras: ["rear", "front_left", "front_center"], received: [],
};
const row = (summary, rest = {}) => ({ name: "courier-1", fault: null, answer: "", summary: summary && { ...ONLINE, ...summary }, ...rest });

test("a vehicle is online, or a reason is given", () => {
  assert.deepEqual(stateOf(row({})), { level: "fine", text: "● online" });
  assert.deepEqual(stateOf(row({ online: false })), { level: "unknown", text: "○ offline" });
  assert.deepEqual(stateOf(row({ online: false, fault: "no control link: refused" })), { level: "late", text: "✕ no control link: refused" });
  assert.deepEqual(stateOf(row(null, { fault: "its station ended (status 1)" })), { level: "late", text: "✕ its station ended (status 1)" });
  assert.deepEqual(stateOf(row(null)), { level: "unknown", text: "its station is starting" });
});

test("who drives is the vehicle's word", () => {
  const text = (summary) => driverOf(row(summary)).text;
  assert.equal(text({}), "Nobody drives");
  assert.equal(text({ control: "held", holder: "alice", held_s: 59.9 }), "alice drives, for 59 s");
  assert.equal(text({ control: "held", holder: "alice", held_s: 125, requested: ["bob", "eve"] }), "alice drives, for 2 min; bob would like to; eve would like to");
  assert.equal(text({ control: "held", holder: "me", is_own: true, held_s: 7200, offered: "bob" }), "You drive, for 2 h; offered to bob");
  assert.equal(text({ control: "lost", holder: "alice", held_s: 3 }), "✕ alice was in control: LOST for 3 s");
  assert.equal(driverOf(row({ control: "lost", holder: "me", is_own: true })).level, "late");
  assert.equal(text({ online: false }), "–");
  assert.equal(driverOf(toWatcher(row({ control: "held", holder: "alice", is_own: true, held_s: 3 }))).text, "alice drives, for 3 s");
  assert.deepEqual([row({ control: "held", is_own: true }), row({ control: "lost", is_own: true }), row({ control: "held" })].map(isHeldHere), [true, false, false]);
});

test("figures are of what is known now", () => {
  assert.deepEqual(figuresOf(row({})), { speed: "–", latency: "– ms", link: "900 kbit/s" });
  const known = { speed_mps: 2.5, latency_ms: 48.4, bound_ms: 1.2, received: ["front"], actual_kbps: 800.6, believed_kbps: 1500 };
  assert.deepEqual(figuresOf(row(known)), { speed: "9 km/h", latency: "48 ± 2 ms", link: "801 of 900 kbit/s, can carry 1500" });
  assert.deepEqual(figuresOf(row({ ...known, online: false })), { speed: "–", latency: "–", link: "–" });
});

test("an answer of the vehicle is an alarm, too", () => {
  assert.deepEqual(alarmsOf(row({ alarms: ["front: dark"] }, { answer: "it moves" })), ["front: dark", "control was not released: it moves"]);
  assert.deepEqual(alarmsOf(row(null)), []);
});

test("the small picture looks ahead", () => {
  assert.equal(pictureOf(row({})), "front_center");
  assert.equal(pictureOf(row({ cameras: ["rear", "front_left"] })), "front_left");
  assert.equal(pictureOf(row({ cameras: ["rear"] })), "rear");
  assert.equal(pictureOf(row({ online: false })), null);
  assert.equal(pictureOf(row(null)), null);
});
