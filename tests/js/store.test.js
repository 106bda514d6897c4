/** The page's state from the station's messages, and the listeners it notifies. */

import assert from "node:assert/strict";
import { beforeEach, test } from "node:test";

import { alertStatus, camera, decisionOf, dropOldSample, enlarge, inControl, listen, mode, note, onlyWatches, onStationMessage, remind, select, store } from "../../runner/page/static/store.js";

const HELLO = { kind: "hello", operator: "anna", vehicle: "robot", cameras: [{ name: "front" }, { name: "rear" }] };
const heldBy = (holder) => ({ driving: { state: "held", holder, present: {} } });
const STATE = { kind: "state", online: true, mode: "single", cameras: { front: { kbps: 500 } }, ...heldBy("anna") };
const published = [];
listen("hello state sample note control history selected enlarged", (payload) => published.push(payload));

function sample(time, more = {}) {
  const front = { kbps: 10 * time, allocated_kbps: 7, scaling: 0.5 };
  return { kind: "sample", time, predicted_kbps: 3, allocated_kbps: 2, actual_kbps: 1, position: null, cameras: { front }, ...more };
}

beforeEach(() => {
  Object.assign(store, { hello: null, state: null, driving: null, sample: null, selected: null, enlarged: null, connected: true, holder: "nobody" });
  onStationMessage(HELLO);
  published.length = 0;
});

test("before the vehicle's first state there is no decision and no mode", () => {
  assert.equal(decisionOf("front"), undefined);
  assert.equal(mode(), null);
});

test("the state is the vehicle's while it is online", () => {
  onStationMessage(STATE);
  assert.equal(decisionOf("front"), STATE.cameras.front);
  assert.equal(mode(), "single");
  onStationMessage({ kind: "state", online: false });
  assert.equal(decisionOf("front"), undefined);
  assert.equal(mode(), null);
});

test("a local selection is published to the page's other windows, a selection from there is not", () => {
  const chosen = [];
  listen("chosen", (name) => chosen.push(name));
  select("rear");
  onStationMessage({ kind: "selection", camera: "front" });
  assert.equal(store.selected, "front");
  onStationMessage({ kind: "selection", camera: "elsewhere" }); // a camera that a monitor does not show
  assert.equal(store.selected, "elsewhere");
  assert.deepEqual(chosen, ["rear"]);
});

test("a window that opens adopts the selection of another window", () => {
  onStationMessage({ ...HELLO, selected: "rear" });
  assert.equal(store.selected, "rear");
  assert.deepEqual([published[0].kind, published[1]], ["hello", "rear"], "edited numbers belong to the camera before");
  published.length = 0;
  onStationMessage({ ...HELLO, selected: null });
  assert.equal(store.selected, "rear");
  assert.equal(published.length, 1);
});

test("a monitor selects nothing by itself", () => {
  Object.assign(store, { selected: null, view: "monitor" });
  onStationMessage({ ...HELLO, selected: null });
  assert.equal(store.selected, null);
  store.view = "configure";
});

test("every message reaches the listeners of its kind", () => {
  onStationMessage(STATE);
  onStationMessage({ kind: "control", holder: "you" });
  assert.deepEqual(published.map(({ kind }) => kind), ["state", "control"]);
});

test("a pause alerts the driver unless nobody drives, or the camera has no weight", () => {
  const paused = { on: true, sending: false, weight: 1 };
  const state = (chosen) => ({ ...STATE, mode: chosen, cameras: { front: paused, rear: { ...paused, weight: 0 } } });
  const alerts = () => ["front", "rear"].map((name) => alertStatus(name, "paused"));
  onStationMessage(state("automatic"));
  assert.deepEqual(alerts(), ["off", "off"]);
  onStationMessage({ kind: "control", holder: "another" });
  assert.deepEqual(alerts(), ["paused", "off"]);
  onStationMessage(state("single"));
  assert.deepEqual(alerts(), ["paused", "paused"]);
  assert.equal(alertStatus("front", "lost"), "lost");
});

test("refused pictures alert whoever has control of the vehicle, and nobody else", () => {
  onStationMessage({ ...HELLO, visitor: { name: "anna", may_drive: true } });
  onStationMessage(STATE);
  assert.equal(alertStatus("front", "refused"), "off"); // this page has no control
  store.connected = true;
  onStationMessage({ kind: "control", holder: "you" });
  assert.equal(alertStatus("front", "refused"), "refused");
  onStationMessage({ ...STATE, ...heldBy("bob") });
  assert.equal(alertStatus("front", "refused"), "off");
});

test("a visitor who may only watch is known by the hello", () => {
  onStationMessage({ ...HELLO, visitor: { name: "bob", may_drive: false } });
  assert.ok(onlyWatches());
  onStationMessage({ ...HELLO, visitor: { name: "", may_drive: true } });
  assert.ok(!onlyWatches());
});

test("a driver is reminded until something is settled, or control is gone; others are not", () => {
  const reminded = () => [...store.reminders.values()];
  remind("gamepad", "gone");
  assert.deepEqual(reminded(), []);
  onStationMessage(STATE);
  onStationMessage({ kind: "control", holder: "you" });
  for (const key of ["gamepad", "monitor"]) remind(key, `${key} gone`);
  remind("gamepad", null);
  assert.deepEqual(reminded(), ["monitor gone"]);
  onStationMessage({ kind: "control", holder: "another" });
  assert.deepEqual(reminded(), []);
});

test("control requires a connection", () => {
  onStationMessage(STATE);
  onStationMessage({ kind: "control", holder: "you" });
  assert.equal(inControl(), true);
  store.connected = false;
  assert.equal(inControl(), false);
});

test("the first camera is selected, and a selection survives another hello that includes the camera", () => {
  assert.equal(store.selected, "front");
  select("rear");
  enlarge("rear");
  onStationMessage(HELLO);
  assert.deepEqual([store.selected, store.enlarged], ["rear", "rear"]);
  onStationMessage({ ...HELLO, cameras: [{ name: "front" }] });
  assert.deepEqual([store.selected, store.enlarged], ["front", null]);
});

test("only a different camera of the vehicle changes the selection", () => {
  select("front");
  select("mast");
  assert.deepEqual(published, []);
  assert.equal(camera("mast"), undefined);
});

test("notes are newest first and bounded", () => {
  for (let time = 0; time < 250; time++) note({ time, text: `${time}` });
  note({ time: 100.5, text: "late" });
  assert.equal(store.notes.length, 200);
  assert.equal(store.notes[0].text, "249");
  assert.equal(store.notes.findIndex(({ text }) => text === "late"), 149);
  assert.deepEqual(published.at(-1), { time: 100.5, text: "late", level: "note" });
});

test("a hello replaces the station's notes only, and the status of cameras that are no longer those", () => {
  Object.assign(store, { notes: [], status: {} });
  onStationMessage({ ...HELLO });
  onStationMessage({ kind: "note", time: 1, text: "of the station", level: "note" });
  note({ time: 2, text: "gamepad disconnected", level: "problem" });
  store.status.front = "lost";
  onStationMessage({ ...HELLO });
  assert.deepEqual(store.notes.map(({ text }) => text), ["gamepad disconnected"]);
  assert.deepEqual(store.status, { front: "lost" });
  onStationMessage({ ...HELLO, cameras: [{ name: "front", width_px: 1 }] });
  assert.deepEqual(store.status, {});
});

test("the series restarts when the station's clock is set back", () => {
  for (const time of [100, 101, 50, 51]) onStationMessage(sample(time));
  assert.deepEqual(store.series.time, [50, 51]);
});

test("samples become one point per second, and unknown values are null", () => {
  for (const time of [0, 0.25, 0.5, 0.75, 1, 1.25, 2]) onStationMessage(sample(time));
  assert.deepEqual(store.series.time, [0, 1, 2]);
  assert.deepEqual(store.series.cameras.front.kbps, [0, 10, 20]);
  assert.deepEqual(store.series.cameras.rear.kbps, [null, null, null]);
  assert.deepEqual(store.series.lat, [null, null, null]);
});

test("a sample that no other follows is dropped after a second", () => {
  onStationMessage(sample(1));
  published.length = 0;
  dropOldSample(performance.now() + 900);
  assert.deepEqual([store.sample?.time, published], [1, []]);
  for (const later of [1100, 1400]) dropOldSample(performance.now() + later);
  assert.deepEqual([store.sample, published], [null, [null]]);
  assert.deepEqual(store.series.time.at(-1), 1);
});

test("the series covers five minutes", () => {
  for (let time = 0; time < 310; time++) onStationMessage(sample(time, { position: { lat: time, lon: 0 } }));
  assert.equal(store.series.time.length, 300);
  assert.equal(store.series.time[0], 10);
  assert.equal(store.series.lat[0], 10);
  assert.equal(store.series.cameras.front.scaling.length, 300);
});

test("history replaces the series, and samples continue it", () => {
  onStationMessage(sample(5));
  onStationMessage({ kind: "history", time: [1, 2], predicted_kbps: [8, 9], cameras: { front: { kbps: [3, 4] }, mast: { kbps: [1] } } });
  onStationMessage(sample(3));
  assert.deepEqual(store.series.time, [1, 2, 3]);
  assert.deepEqual(store.series.predicted_kbps, [8, 9, 3]);
  assert.deepEqual(store.series.cameras.front.kbps, [3, 4, 30]);
  assert.deepEqual(Object.keys(store.series.cameras), ["front", "rear"]);
});
