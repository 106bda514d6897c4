/** Which fisheyes' pictures are straightened: the operator's choice, for each camera. The worker does it. */

import { camera, listen, publish, store } from "./store.js";
import { canStraighten } from "./straight.js";
import { showStraight } from "./link.js";

const CHOICE = "tod-straight";
const chosen = new Set(localStorage.getItem(CHOICE)?.split(" "));

/** @param {string|null} name */
export function isStraight(name) {
  const about = camera(name);
  return about !== undefined && canStraighten(about) && chosen.has(about.name);
}

/** Straighten a camera's picture, or show it as it comes. @param {string|null} name */
export function toggleStraight(name = store.selected) {
  const about = camera(name);
  if (!about) return;
  if (!canStraighten(about)) return publish("toast", { text: `${about.name}: lines are straight already; only a fisheye bends them`, level: "hint" });
  if (!chosen.delete(about.name)) chosen.add(about.name);
  tell();
}

function tell() {
  localStorage.setItem(CHOICE, [...chosen].join(" "));
  showStraight([...chosen]);
  publish("straight");
}

/** The worker could not. */
function crooked({ camera: name, why }) {
  chosen.delete(name);
  tell();
  publish("toast", { text: `${name}: the picture cannot be straightened: ${why}`, level: "problem" });
}

export function startStraight() {
  listen("hello", tell);
  listen("crooked", crooked);
}
