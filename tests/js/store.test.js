/** What the page keeps of the station's messages, and whom it tells. */

import assert from "node:assert/strict";
import { beforeEach, test } from "node:test";

import { camera, decided, enlarge, inControl, listen, mode, note, select, store, take } from "../../runner/page/static/store.js";

const HELLO = { kind: "hello", vehicle: "robot", cameras: [{ name: "front" }, { name: "rear" }] };
const STATE = { kind: "state", online: true, mode: "single", cameras: { front: { kbps: 500 } } };
const heard = [];
listen("hello state sample note control history selected enlarged", (payload) => heard.push(payload));

function sample(time, more = {}) {
  const front = { kbps: 10 * time, allocated_kbps: 7, scaling: 0.5 };
  return { kind: "sample", time, predicted_kbps: 3, allocated_kbps: 2, actual_kbps: 1, position: null, cameras: { front }, ...more };
}

beforeEach(() => {
  Object.assign(store, { hello: null, state: null, sample: null, selected: null, enlarged: null, connected: true, holder: "nobody" });
  take(HELLO);
  heard.length = 0;
});

test("before the vehicle's state nothing is decided, and there is no mode", () => {
  assert.equal(decided("front"), undefined);
  assert.equal(mode(), null);
});

test("the state is what the vehicle says, as long as it is online", () => {
  take(STATE);
  assert.equal(decided("front"), STATE.cameras.front);
  assert.equal(mode(), "single");
  take({ kind: "state", online: false });
  assert.equal(decided("front"), undefined);
  assert.equal(mode(), null);
});

test("a selection is told to the other windows of the page, and one that comes from there is not", () => {
  const chosen = [];
  listen("chosen", (name) => chosen.push(name));
  select("rear");
  take({ kind: "selection", camera: "front" });
  assert.equal(store.selected, "front");
  take({ kind: "selection", camera: "elsewhere" }); // of a camera that a monitor does not show
  assert.equal(store.selected, "elsewhere");
  assert.deepEqual(chosen, ["rear"]);
});

test("what another window has selected counts when this one opens", () => {
  take({ ...HELLO, selected: "rear" });
  assert.equal(store.selected, "rear");
  take({ ...HELLO, selected: null });
  assert.equal(store.selected, "rear");
});

test("a monitor selects nothing by itself", () => {
  Object.assign(store, { selected: null, view: "monitor" });
  take({ ...HELLO, selected: null });
  assert.equal(store.selected, null);
  store.view = "configure";
});

test("every message reaches those who listen for its kind", () => {
  take(STATE);
  take({ kind: "control", holder: "you" });
  assert.deepEqual(heard.map(({ kind }) => kind), ["state", "control"]);
});

test("control needs a connection as well", () => {
  take({ kind: "control", holder: "you" });
  assert.equal(inControl(), true);
  store.connected = false;
  assert.equal(inControl(), false);
});

test("the first camera is selected, and a choice outlives another hello that has it", () => {
  assert.equal(store.selected, "front");
  select("rear");
  enlarge("rear");
  take(HELLO);
  assert.deepEqual([store.selected, store.enlarged], ["rear", "rear"]);
  take({ ...HELLO, cameras: [{ name: "front" }] });
  assert.deepEqual([store.selected, store.enlarged], ["front", null]);
});

test("only another camera of the vehicle is a new choice", () => {
  select("front");
  select("mast");
  assert.deepEqual(heard, []);
  assert.equal(camera("mast"), undefined);
});

test("notes are newest first and bounded", () => {
  for (let time = 0; time < 250; time++) note({ time, text: `${time}` });
  note({ time: 100.5, text: "late" });
  assert.equal(store.notes.length, 200);
  assert.equal(store.notes[0].text, "249");
  assert.equal(store.notes.findIndex(({ text }) => text === "late"), 149);
  assert.deepEqual(heard.at(-1), { time: 100.5, text: "late", level: "note" });
});

test("a station's clock that is set back begins the series anew", () => {
  for (const time of [100, 101, 50, 51]) take(sample(time));
  assert.deepEqual(store.series.time, [50, 51]);
});

test("samples become a point a second, and what is not known is null", () => {
  for (const time of [0, 0.25, 0.5, 0.75, 1, 1.25, 2]) take(sample(time));
  assert.deepEqual(store.series.time, [0, 1, 2]);
  assert.deepEqual(store.series.cameras.front.kbps, [0, 10, 20]);
  assert.deepEqual(store.series.cameras.rear.kbps, [null, null, null]);
  assert.deepEqual(store.series.lat, [null, null, null]);
});

test("the series holds five minutes", () => {
  for (let time = 0; time < 310; time++) take(sample(time, { position: { lat: time, lon: 0 } }));
  assert.equal(store.series.time.length, 300);
  assert.equal(store.series.time[0], 10);
  assert.equal(store.series.lat[0], 10);
  assert.equal(store.series.cameras.front.scaling.length, 300);
});

test("history replaces what there was, and samples go on from it", () => {
  take(sample(5));
  take({ kind: "history", time: [1, 2], predicted_kbps: [8, 9], cameras: { front: { kbps: [3, 4] }, mast: { kbps: [1] } } });
  take(sample(3));
  assert.deepEqual(store.series.time, [1, 2, 3]);
  assert.deepEqual(store.series.predicted_kbps, [8, 9, 3]);
  assert.deepEqual(store.series.cameras.front.kbps, [3, 4, 30]);
  assert.deepEqual(Object.keys(store.series.cameras), ["front", "rear"]);
});
