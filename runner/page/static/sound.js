/**
 * Tones for pictures that stand still or are late, in the Drive view of the page in control. Browsers allow sound only
 * after a click or a key, such as those that take control; until then, and while muted, the page says so.
 */

import { listen, publish, store } from "./store.js";
import { Alarm } from "./alarm.js";
import { by, mark, write } from "./format.js";

const KEY = "tod-muted";
const TONES = { lost: [880, 587, 880, 587], late: [659] }; // Hz, one after the other
const LASTS_S = 0.15;
const VOLUME = 0.3;

const alarm = new Alarm();
/** @type {AudioContext|null} */
let context = null;
let drives = false; // whether this page has control, also while the connection is lost: that is when to sound

const muted = () => localStorage.getItem(KEY) === "yes";

/** Create or resume the sound where it is wanted; without a click or key so far it stays blocked. */
function unlock() {
  if (store.view !== "drive") return void context?.suspend();
  if (!drives) return;
  if (!context) {
    context = new AudioContext();
    context.onstatechange = refresh;
  }
  if (context.state !== "running") context.resume().catch(() => refresh());
}

function play(kind) {
  if (context?.state !== "running") return;
  for (const [i, frequency] of TONES[kind].entries()) {
    const from = context.currentTime + i * LASTS_S;
    const oscillator = new OscillatorNode(context, { type: "square", frequency });
    oscillator.connect(new GainNode(context, { gain: VOLUME })).connect(context.destination);
    oscillator.start(from);
    oscillator.stop(from + 0.8 * LASTS_S);
  }
}

function heard({ camera, status }) {
  if (!drives || store.view !== "drive") return;
  const kind = alarm.due(camera, status, performance.now());
  if (!kind) return;
  publish("alarm", kind);
  if (!muted()) play(kind);
}

export function toggleSound() {
  localStorage.setItem(KEY, muted() ? "no" : "yes");
  refresh();
}

function refresh() {
  const blocked = context?.state !== "running";
  const words = muted() ? "✕ Muted" : blocked ? "✕ Sound blocked" : "Sound on";
  by("sound").hidden = !drives;
  write(by("sound"), words);
  mark(by("sound"), "data-level", muted() || blocked ? "near" : "fine");
  by("sound").title = muted() || !blocked ? "tones for lost, frozen and late pictures, or none (b)" : "the browser allows no sound before a click or a key";
}

export function startSound() {
  by("sound").addEventListener("click", () => (context?.state === "running" || muted()) && toggleSound());
  for (const kind of ["pointerup", "keydown"]) addEventListener(kind, unlock);
  listen("control view", () => {
    drives = store.holder === "you" || (drives && !store.connected);
    unlock();
    refresh();
  });
  listen("status", heard);
  addEventListener("storage", refresh); // muted in another window
  refresh();
}
