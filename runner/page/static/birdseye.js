/** The bird's-eye view's place on the page: whether it is shown, and in which box. The worker draws it. */

import { enlarge, listen, publish, store } from "./store.js";
import { BIRDSEYE, isTopView } from "./arrange.js";
import { groundOf } from "./ground.js";
import { giveGround, showGround } from "./link.js";
import { STANDING } from "./status.js";
import { by, mark, spoken, write } from "./format.js";

const CHOICE = "tod-birdseye";

const cameras = () => (globalThis.boot.canShowVideo && store.hello?.dimensions ? store.hello.cameras.filter(isTopView) : []);

/** Without a choice only what was measured is shown. */
function isChosen() {
  const choice = localStorage.getItem(CHOICE);
  return choice === null ? cameras().every(({ calibrated }) => calibrated) : choice === "on";
}

/** The size of the ground that it shows, m; null: it is off, or the vehicle has no camera that looks down. */
export function birdseyeSize() {
  const dimensions = store.hello?.dimensions;
  return dimensions && cameras().length && isChosen() ? groundOf(dimensions) : null;
}

function choose(choice) {
  localStorage.setItem(CHOICE, choice);
  publish("birdseye");
}

/** In the row below the front camera, then large in its place, then off. */
export function changeBirdseye() {
  if (store.view !== "drive" || !cameras().length) return;
  if (!isChosen()) return choose("on");
  if (store.enlarged !== BIRDSEYE) return enlarge(BIRDSEYE);
  enlarge(null);
  choose("off");
}

/** Show it in a box of the Drive view, or not. @param {import("./arrange.js").Box|undefined} box */
export function placeBirdseye(box) {
  const element = by("birdseye");
  element.hidden = !box;
  if (box) Object.assign(element.style, Object.fromEntries([["left", box.x], ["top", box.y], ["width", box.width], ["height", box.height]].map(([key, px]) => [key, `${px}px`])));
  showGround(Boolean(box), element);
  mark(by("to-birdseye"), "aria-pressed", Boolean(box));
}

/** Said here, too, since the worker may hang. */
function refreshState() {
  const standing = cameras().map(({ name }) => name).filter((name) => STANDING.includes(store.status[name]));
  mark(by("birdseye"), "data-standing", standing.length ? "" : null);
  write(by("birdseye-state"), standing.length ? `✕ not live: ${standing.map(spoken).join(", ")}` : "");
}

export function startBirdseye() {
  giveGround(by("birdseye-picture"), by("birdseye-lines"));
  by("to-birdseye").addEventListener("click", changeBirdseye);
  by("birdseye").addEventListener("dblclick", () => enlarge(store.enlarged === BIRDSEYE ? null : BIRDSEYE));
  listen("hello", () => (by("to-birdseye").hidden = !cameras().length));
  listen("hello status", refreshState);
}
