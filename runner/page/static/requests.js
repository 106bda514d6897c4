/**
 * Requests to the vehicle, each with the control that sent it. The page shows the values of the vehicle's state, not those
 * of a request; a control is shown as pending until its request is answered.
 */

import { driverView, inControl, listen, note, onlyWatches, publish, store, who } from "./store.js";
import { withKey } from "./hints.js";
import { send } from "./link.js";

const GIVE_UP_MS = 2000; // after the station should have answered "timed out" itself
const PREFIX = Math.random().toString(36).slice(2, 8);

/**
 * @typedef {{id: string, control: string, event: Record<string, any>, description: string, sent: number, timer: any}} Request
 * @typedef {Omit<Request, "timer"> & {result: string, reason: string, answered: number}} Answered
 * @type {{pending: Map<string, Request>, answered: Answered[]}}
 */
export const requests = { pending: new Map(), answered: [] };
let count = 0;

/**
 * Send an event that needs control.
 * @param {string} control name of what it sets, "mode", "on:front_left": a newer request for it replaces an older one
 * @param {object} event without id
 * @param {string} description for the list of events if the request fails
 * @returns {string|undefined} its id; undefined: this page is not in control
 */
export function request(control, event, description) {
  return inControl() ? submit(control, event, description) : void showProblem(whyNoControl());
}

/** Send an event, also without control. @param {string} control  @param {object} event  @param {string} description */
export function submit(control, event, description) {
  const id = `${PREFIX}-${++count}`;
  const none = { id, result: "timed out", reason: "no answer from the station" };
  const timer = setTimeout(() => onReply(none), 1000 * (store.hello?.answer_s ?? 0) + GIVE_UP_MS);
  requests.pending.set(id, { id, control, event, description, timer, sent: Date.now() });
  send({ id, ...event });
  publish("requests");
  return id;
}

/** The newest unanswered request of a control. */
export function pending(control) {
  return [...requests.pending.values()].findLast((each) => each.control === control);
}

/** Why this page's person cannot change what is sent, and what they can do. */
export function whyNoControl() {
  if (store.hung) return "the page's worker does not respond";
  if (!store.connected) return store.ended ? "the station has ended" : "no connection to the station";
  if (onlyWatches()) return "you may only watch";
  const { driving } = store;
  switch (who()) {
    case "another":
      return "another page holds control";
    case "operator":
      return `operator ${driving?.holder} is in control; ${whatToDo()}`;
    case "lost":
      return `operator ${driving?.holder} was in control and is lost; ${whatToDo()}`;
    case "unheard":
      return "the vehicle receives nothing from this station";
    case "unknown":
      return "the vehicle is offline";
    default:
      return store.view === "monitor" ? "the page of this monitor does not hold control" : withKey("take control first", "control");
  }
}

/** How this page's operator gets control from another one. */
function whatToDo() {
  const { driving, own } = driverView();
  if (driving?.offered === own) return withKey("accept control", "control");
  return driving?.requested.includes(own) ? "you have asked for control" : withKey("request control", "control");
}

/** Show a problem in a toast. */
export function showProblem(text) {
  publish("toast", { text, level: "problem" });
}

/** Show a problem in a toast, and keep it in the list of events. */
export function reportProblem(text) {
  note({ text, level: "problem" });
  showProblem(text);
}

function onReply({ id, result, reason }) {
  const entry = requests.pending.get(id);
  if (!entry) return;
  clearTimeout(entry.timer);
  requests.pending.delete(id);
  const { timer, ...kept } = entry;
  requests.answered = [...requests.answered, { ...kept, result, reason, answered: Date.now() }].slice(-200);
  if (result !== "applied") reportProblem(`${entry.description}: ${result}${reason ? `: ${reason}` : ""}`);
  publish("answered", { ...kept, result });
  publish("requests");
}

listen("reply", onReply);
listen("unsent", (id) => onReply({ id, result: "timed out", reason: "no connection to the station" }));
