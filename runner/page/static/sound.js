/**
 * Tones for stalled or late pictures, on the page in control. Browsers allow sound only after a click or key press, such as
 * the one that takes control; until then, and while muted, the page shows it.
 */

import { alertStatus, listen, publish, store, who } from "./store.js";
import { Alarm, worstKind } from "./alarm.js";
import { monitored } from "./monitored.js";
import { withKey } from "./hints.js";
import { byId, setAttribute, setText } from "./format.js";

const KEY = "tod-muted";
/** Hz, one after the other */
const TONES = { lost: [880, 587, 880, 587], late: [659], asked: [784, 784], passed: [523, 784, 1047], stop: [988, 988, 988] };
const TONE_S = 0.15;
const VOLUME = 0.3;
const CHECK_MS = 250;

const alarm = new Alarm();
const buttons = ["sound", "sound-configure"].map((id) => byId(id));
/** @type {AudioContext|null} */
let context = null;
let wasBlocked = true; // whether the browser blocked sound when the last press began
let isDriving = false; // whether this page has control; kept while a connection is lost, when tones matter most

const isMuted = () => localStorage.getItem(KEY) === "yes";

/** Create or resume the audio context if needed; it stays blocked until a click or key press. */
function unlock() {
  if (!isDriving && store.holder !== "you") return; // its person may be offered control
  if (!context) {
    context = new AudioContext();
    context.onstatechange = onAudioState;
  }
  if (context.state !== "running") context.resume().catch(() => refresh());
}

/** @param {Event} event */
function onPress(event) {
  if (event instanceof KeyboardEvent && event.repeat) return;
  wasBlocked = context?.state !== "running";
  unlock();
}

function onAudioState() {
  const kind = currentKind();
  if (isDriving && kind) play(kind); // the browser blocked its tone
  refresh();
}

function play(kind) {
  if (isMuted() || context?.state !== "running") return;
  for (const [i, frequency] of TONES[kind].entries()) {
    const from = context.currentTime + i * TONE_S;
    const oscillator = new OscillatorNode(context, { type: "square", frequency });
    oscillator.connect(new GainNode(context, { gain: VOLUME })).connect(context.destination);
    oscillator.start(from);
    oscillator.stop(from + 0.8 * TONE_S);
  }
}

/** @param {keyof typeof TONES|null} kind */
function sound(kind) {
  if (!kind) return;
  publish("alarm", kind);
  play(kind);
}

/** Sound for the worst picture, which may have gone wrong before this page had control. */
const soundCurrent = () => isDriving && sound(currentKind());
function currentKind() {
  const own = Object.keys(store.status).map((name) => alertStatus(name));
  return worstKind([...own, ...monitored().map(({ camera, status }) => alertStatus(camera, status))]);
}

/** @param {string} picture  @param {string} camera  @param {string} status */
function onStatus(picture, camera, status) {
  const kind = alarm.due(picture, alertStatus(camera, status), performance.now());
  if (isDriving) sound(kind);
}

function onControl() {
  const before = isDriving;
  isDriving = who() === "you" || (isDriving && ["unknown", "unheard"].includes(who()));
  unlock();
  if (isDriving && !before) soundCurrent();
  refresh();
}

/** Mute or unmute; a press that resumes blocked sound does not mute it as well. */
export function toggleSound() {
  if (isDriving && !isMuted() && context?.state !== "running") return;
  localStorage.setItem(KEY, isMuted() ? "no" : "yes");
  if (!isMuted()) soundCurrent();
  refresh();
}

const isBlocked = () => context?.state !== "running";

/** Why this page's driver hears no tones; "": they are heard. */
export const soundFault = () => (!isDriving ? "" : isMuted() ? "✕ tones muted" : isBlocked() ? "✕ tones blocked" : "");

function refresh() {
  const words = isMuted() ? "Unmute" : isBlocked() ? "Allow sound" : "Mute";
  const isAllowed = isMuted() || !isBlocked();
  const title = isAllowed ? withKey("alarm tones on or off", "sound") : "the browser blocks sound until a click or key press";
  for (const button of buttons) {
    setText(button, words);
    setAttribute(button, "data-level", isMuted() || isBlocked() ? "near" : "fine");
    button.title = title;
  }
  byId("sound").hidden = !isDriving;
  byId("sound-configure").hidden = !isDriving || !(isMuted() || isBlocked());
  publish("sound");
}

/** Say on a monitor what its key has changed on its page. @param {StorageEvent} event */
function showMuted({ key }) {
  if (key === KEY) publish("toast", { text: `alarm tones of the page ${isMuted() ? "muted" : "on"}`, level: "hint" });
}

export function startSound() {
  if (store.view === "monitor") return addEventListener("storage", showMuted);
  const onClick = () => (!wasBlocked || isMuted()) && toggleSound(); // resumed since the press began
  for (const button of buttons) button.addEventListener("click", onClick);
  for (const kind of ["pointerup", "keydown"]) addEventListener(kind, onPress, true);
  listen("control state socket", onControl);
  listen("hello", refresh);
  listen("status", ({ camera, status }) => onStatus(camera, camera, status));
  listen("monitored", ({ picture, camera, status }) => onStatus(picture, camera, status));
  listen("deposed unseen unplugged", () => sound("lost"));
  listen("passed", () => sound("passed"));
  listen("asked", () => sound("asked"));
  listen("stopping", () => store.holder === "you" && sound("stop"));
  addEventListener("storage", refresh); // muted in another window
  setInterval(() => {
    const kind = alarm.overdue(performance.now());
    if (isDriving) sound(kind);
  }, CHECK_MS);
  refresh();
}
