/** Which fisheye pictures are straightened: the operator's choice per camera. The worker straightens them. */

import { camera, listen, ofVehicle, publish, store } from "./store.js";
import { canStraighten } from "./straight.js";
import { showStraight } from "./link.js";
import { reportProblem } from "./requests.js";

const CHOICE = "tod-straight";
const stored = () => new Set(localStorage.getItem(ofVehicle(CHOICE))?.split(" "));
let chosen = new Set();
let vehicle = ""; // whose cameras these are

/** @param {string|null} name */
export function isStraight(name) {
  const info = camera(name);
  return info !== undefined && canStraighten(info) && chosen.has(info.name);
}

/** Straighten a camera's picture, or show the original. @param {string|null} name */
export function toggleStraight(name = store.selected) {
  const info = camera(name);
  if (!info) return;
  const text = `${info.name}: lines are already straight; only a fisheye bends them`;
  if (!canStraighten(info)) return publish("toast", { text, level: "hint" });
  const isOn = chosen.has(info.name); // as shown here; another window may have chosen it meanwhile
  change((choice) => (isOn ? choice.delete(info.name) : choice.add(info.name)));
}

/** Change the choice, which other windows may have changed. @param {(choice: Set<string>) => void} by */
function change(by) {
  chosen = stored();
  by(chosen);
  localStorage.setItem(ofVehicle(CHOICE), [...chosen].join(" "));
  applyChoice();
}

function applyChoice() {
  showStraight([...chosen]);
  publish("straight");
}

function onHello(hello) {
  if (hello.vehicle !== vehicle) chosen = stored();
  vehicle = hello.vehicle;
  applyChoice();
}

/** The worker could not straighten a picture. */
function onStraightenFailed({ camera: name, why }) {
  change((choice) => choice.delete(name));
  reportProblem(`${name}: the picture cannot be straightened: ${why}`);
}

export function startStraight() {
  listen("hello", onHello);
  listen("crooked", onStraightenFailed);
}
