/** The bird's-eye view's place on the page: whether it is shown, and in which box. The worker draws it. */

import { enlarge, listen, ofVehicle, publish, store } from "./store.js";
import { BIRDSEYE, isTopView } from "./arrange.js";
import { groundOf } from "./ground.js";
import { showGround, transferGround } from "./link.js";
import { reportProblem, showProblem } from "./requests.js";
import { STALLED } from "./status.js";
import { byId, displayName, setAttribute, setBox, setText } from "./format.js";

const CHOICE = "tod-birdseye";
let failure = ""; // why it cannot be drawn any more

const cameras = () => (globalThis.boot.canShowVideo && store.hello?.dimensions ? store.hello.cameras.filter(isTopView) : []);

/** Off until somebody wants it: without a GPU it takes what the pictures need. */
const isChosen = () => localStorage.getItem(ofVehicle(CHOICE)) === "on";

/** The size of the ground that it shows, m; null: it is off, or the vehicle has no camera that looks down. */
export function birdseyeSize() {
  const dimensions = store.hello?.dimensions;
  return dimensions && !failure && cameras().length && isChosen() ? groundOf(dimensions) : null;
}

function choose(choice) {
  localStorage.setItem(ofVehicle(CHOICE), choice);
  publish("birdseye");
}

/** Cycle: beside the front camera, large in its place, off. */
export function cycleBirdseye() {
  if (store.view !== "drive" || !cameras().length) return;
  if (failure) return showProblem(failure);
  if (!isChosen()) return choose("on");
  if (store.enlarged !== BIRDSEYE) return enlarge(BIRDSEYE);
  enlarge(null);
  choose("off");
}

/** Show it in a box of the Drive view, or hide it. @param {import("./arrange.js").Box|undefined} box */
export function placeBirdseye(box) {
  const element = byId("birdseye");
  element.hidden = !box;
  if (box) setBox(element, box);
  showGround(Boolean(box), element);
  setText(byId("to-birdseye"), `${box ? (store.enlarged === BIRDSEYE ? "Hide" : "Enlarge") : "Show"} bird's eye`);
}

/** The worker could not draw it: the pictures of its cameras take its place. */
function onFailed({ why }) {
  failure = `The bird's-eye view cannot be drawn: ${why}`;
  reportProblem(failure);
  if (store.enlarged === BIRDSEYE) enlarge(null);
  publish("birdseye");
}

/** Also shown here, since the worker may hang. */
function refreshState() {
  const stalled = cameras().map(({ name }) => name).filter((name) => STALLED.includes(store.status[name]));
  setAttribute(byId("birdseye"), "data-standing", stalled.length ? "" : null);
  setText(byId("birdseye-state"), stalled.length ? `✕ not live: ${stalled.map(displayName).join(", ")}` : "");
}

export function startBirdseye() {
  transferGround(byId("birdseye-picture"), byId("birdseye-lines"));
  byId("to-birdseye").addEventListener("click", cycleBirdseye);
  byId("birdseye").addEventListener("dblclick", () => enlarge(store.enlarged === BIRDSEYE ? null : BIRDSEYE));
  listen("hello", () => (byId("to-birdseye").hidden = !cameras().length));
  listen("hello status", refreshState);
  listen("flat", onFailed);
}
