/** Wires the page: one module for each part, all fed by the messages that the worker passes on from the station. */

import { ask, send, start } from "./link.js";
import { listen, store, who } from "./store.js";
import { requests } from "./requests.js";
import { startTheme } from "./theme.js";
import { startViews } from "./views.js";
import { startHints } from "./hints.js";
import { startHeader } from "./header.js";
import { startControl } from "./control.js";
import { startStopping } from "./stopping.js";
import { startWatching } from "./watching.js";
import { startTiles } from "./tiles.js";
import { startDrive } from "./drive.js";
import { startDriveMap } from "./drive_map.js";
import { startBirdseye } from "./birdseye.js";
import { startStraight } from "./straighten.js";
import { startSound } from "./sound.js";
import { hearing, startHearing } from "./hearing_page.js";
import { startTalking, talking } from "./talking_page.js";
import { startTotal } from "./total.js";
import { startPanel } from "./panel.js";
import { startTabs } from "./tabs.js";
import { startNews } from "./news.js";
import { startCharts } from "./charts.js";
import { startMonitored } from "./monitored.js";
import { startMonitors } from "./monitors.js";
import { startEdit } from "./edit.js";
import { startActions } from "./actions.js";
import { startKeys } from "./keys.js";
import { startGamepads } from "./gamepads.js";
import { startOthers } from "./others.js";

startTheme();
startViews();
startHints();
startHeader();
startControl();
startStopping();
startWatching();
startTiles();
startDrive();
startDriveMap();
startBirdseye();
startStraight();
startNews();
startMonitors();
startMonitored();
startEdit();
startActions();
startKeys();
startGamepads();
startSound();
startHearing();
startTalking();
if (store.view !== "monitor") for (const part of [startTotal, startPanel, startTabs, startCharts, startOthers]) part();
start();

/** For tests and benchmarks. With #measure in the address, the first picture of each camera is kept as well. */
const resolvers = new Map();
listen("reply", ({ id, result, reason }) => {
  resolvers.get(id)?.({ result, reason });
  resolvers.delete(id);
});
globalThis.tod = {
  measure: () => ask("measure"),
  stages: () => ask("stages"),
  stated: () => ask("stated"),
  shown: () => ask("shown"),
  hearing,
  talking,
  picture: (name) => ask("picture", name),
  first: (name) => ask("first", name),
  guides: (name) => ask("guides", name),
  birdseye: () => ask("ground"),
  request: (event) =>
    new Promise((resolve) => {
      const id = crypto.randomUUID();
      resolvers.set(id, resolve);
      send({ id, ...event });
    }),
  get requests() {
    return { pending: [...requests.pending.values()].map(({ timer, ...kept }) => kept), answered: requests.answered };
  },
};
const SHOWN = { state: "state", sample: "sample", history: "series", view: "view", selected: "selected" };
for (const [name, key] of Object.entries(SHOWN)) Object.defineProperty(globalThis.tod, name, { get: () => store[key] });
Object.defineProperty(globalThis.tod, "control", { get: who });
