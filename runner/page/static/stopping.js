/** Asking the vehicle to stop, whoever drives: the buttons, the key, and the tone when somebody has asked. */

import { listen, onlyWatches, publish, store } from "./store.js";
import { pending, showProblem, submit, whyNoControl } from "./requests.js";
import { stopWords } from "./driving.js";
import { byId, setAttribute } from "./format.js";

const buttons = ["ask-stop", "drive-ask-stop"].map((id) => byId(id));
/** @type {number|null} since when the last one stood that this page knows of */
let known = null;

/** A second press lifts nothing: only a button of its own does. */
export function askToStop() {
  if (!store.connected || onlyWatches()) return showProblem(whyNoControl());
  const text = stopWords(store.driving, store.hello?.operator ?? "");
  if (text) return publish("toast", { text, level: "hint" });
  submit("stop", { event: "stop_requested" }, "ask to stop");
}

function refresh() {
  const since = store.driving?.stop_since ?? null;
  if (since !== null && since !== known) publish("stopping");
  known = since;
  for (const button of buttons) {
    setAttribute(button, "aria-disabled", since !== null);
    setAttribute(button, "data-pending", pending("stop") !== undefined);
  }
}

export function startStopping() {
  for (const button of buttons) button.addEventListener("click", askToStop);
  listen("hello state socket requests", refresh);
}
