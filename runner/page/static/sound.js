/**
 * Tones for stalled or late pictures, on the page in control. Browsers allow sound only after a click or key press, such as
 * the one that takes control; until then, and while muted, the page shows it.
 */

import { alertStatus, listen, publish, store, who } from "./store.js";
import { Alarm, worstKind } from "./alarm.js";
import { monitored } from "./monitored.js";
import { isBlocked, isMuted, isOfMuting, play, setMuted, unlock } from "./tones.js";
import { withKey } from "./hints.js";
import { byId, setAttribute, setText } from "./format.js";

const CHECK_MS = 250;

const alarm = new Alarm();
const buttons = ["sound", "sound-configure"].map((id) => byId(id));
let wasBlocked = true; // whether the browser blocked sound when the last press began
let isDriving = false; // whether this page has control; kept while a connection is lost, when tones matter most

/** To be called with each press: whoever acts for the station may be offered control. */
function allow() {
  if (isDriving || store.holder === "you") unlock(onAudioState);
}

/** @param {Event} event */
function onPress(event) {
  if (event instanceof KeyboardEvent && event.repeat) return;
  wasBlocked = isBlocked();
  allow();
}

function onAudioState() {
  const kind = currentKind();
  if (isDriving && kind) play(kind); // the browser blocked its tone
  refresh();
}

/** @param {import("./tones.js").Kind|null} kind */
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
  allow();
  if (isDriving && !before) soundCurrent();
  refresh();
}

/** Mute or unmute; a press that resumes blocked sound does not mute it as well. */
export function toggleSound() {
  if (isDriving && !isMuted() && isBlocked()) return;
  setMuted(!isMuted());
  if (!isMuted()) soundCurrent();
  refresh();
}

/** Why this page's driver hears no tones; "": they are heard. */
export const soundFault = () => (!isDriving ? "" : isMuted() ? "✕ tones muted" : isBlocked() ? "✕ tones blocked" : "");

function refresh() {
  const words = isMuted() ? "Unmute tones" : isBlocked() ? "Allow sound" : "Mute tones";
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
function showMuted(event) {
  if (isOfMuting(event)) publish("toast", { text: `alarm tones of the page ${isMuted() ? "muted" : "on"}`, level: "hint" });
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
  listen("other", sound);
  listen("stopping", () => store.holder === "you" && sound("stop"));
  addEventListener("storage", refresh); // muted in another window
  setInterval(() => {
    const kind = alarm.overdue(performance.now());
    if (isDriving) sound(kind);
  }, CHECK_MS);
  refresh();
}
