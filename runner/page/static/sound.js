/**
 * Tones for stalled or late pictures, in the Drive view of the page in control. Browsers allow sound only after a click or
 * key press, such as the one that takes control; until then, and while muted, the page shows it.
 */

import { listen, publish, store } from "./store.js";
import { Alarm } from "./alarm.js";
import { byId, setAttribute, setText } from "./format.js";

const KEY = "tod-muted";
const TONES = { lost: [880, 587, 880, 587], late: [659] }; // Hz, one after the other
const TONE_S = 0.15;
const VOLUME = 0.3;

const alarm = new Alarm();
/** @type {AudioContext|null} */
let context = null;
let isDriving = false; // whether this page has control; kept while the connection is lost, when tones matter most

const isMuted = () => localStorage.getItem(KEY) === "yes";

/** Create or resume the audio context if needed; it stays blocked until a click or key press. */
function unlock() {
  if (store.view !== "drive") return void context?.suspend();
  if (!isDriving) return;
  if (!context) {
    context = new AudioContext();
    context.onstatechange = refresh;
  }
  if (context.state !== "running") context.resume().catch(() => refresh());
}

function play(kind) {
  if (context?.state !== "running") return;
  for (const [i, frequency] of TONES[kind].entries()) {
    const from = context.currentTime + i * TONE_S;
    const oscillator = new OscillatorNode(context, { type: "square", frequency });
    oscillator.connect(new GainNode(context, { gain: VOLUME })).connect(context.destination);
    oscillator.start(from);
    oscillator.stop(from + 0.8 * TONE_S);
  }
}

function onStatus({ camera, status }) {
  if (!isDriving || store.view !== "drive") return;
  const kind = alarm.due(camera, status, performance.now());
  if (!kind) return;
  publish("alarm", kind);
  if (!isMuted()) play(kind);
}

export function toggleSound() {
  localStorage.setItem(KEY, isMuted() ? "no" : "yes");
  refresh();
}

function refresh() {
  const isBlocked = context?.state !== "running";
  const words = isMuted() ? "✕ Muted" : isBlocked ? "✕ Sound blocked" : "Sound on";
  byId("sound").hidden = !isDriving;
  setText(byId("sound"), words);
  setAttribute(byId("sound"), "data-level", isMuted() || isBlocked ? "near" : "fine");
  byId("sound").title = isMuted() || !isBlocked ? "tones for lost, frozen and late pictures, or none (b)" : "the browser blocks sound until a click or key press";
}

export function startSound() {
  byId("sound").addEventListener("click", () => (context?.state === "running" || isMuted()) && toggleSound());
  for (const kind of ["pointerup", "keydown"]) addEventListener(kind, unlock);
  listen("control view", () => {
    isDriving = store.holder === "you" || (isDriving && !store.connected);
    unlock();
    refresh();
  });
  listen("status", onStatus);
  addEventListener("storage", refresh); // muted in another window
  refresh();
}
