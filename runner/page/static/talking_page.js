/**
 * Speaking at the vehicle while a key, the button or a gamepad's button is held, by the page in control. The vehicle says
 * whether it hears it; meanwhile the vehicle's sound is silent here, so that nobody hears an echo.
 */

import { inControl, listen, store } from "./store.js";
import { showProblem, whyNoControl } from "./requests.js";
import { duck, placeBeside } from "./hearing_page.js";
import { withKey } from "./hints.js";
import { make, setAttribute, setText } from "./format.js";
import { keyOf } from "./presses.js";

const { worker } = globalThis.boot;
const RATE = 48_000;
const ECHO_MS = 500; // after the release, in which the voice may still come back through the vehicle's microphone
const CONFIRM_MS = 1000; // by then the vehicle has said that it hears it
/** By what the browser calls it. */
const REFUSALS = {
  NotAllowedError: "the browser gives this page no microphone",
  NotFoundError: "there is no microphone",
  NotSupportedError: "there is no microphone",
  NotReadableError: "the microphone is in use, or does not work",
};

const button = make("button", { id: "talking", hidden: "" });
/** @type {MessagePort|null} to the audio thread */
let port = null;
/** @type {MediaStreamTrack|null} */
let track = null;
/** @type {Promise<void>|null} */
let opening = null;
let failure = "";
/** @type {"key"|"pad"|"pointer"|null} what is held */
let heldBy = null;
let heldSince = 0;
/** @type {ReturnType<typeof setTimeout>|undefined} */
let echoTimer;

/** Ask for the microphone: once, at the first press. It hears nothing while no key is held. */
async function open() {
  if (!navigator.mediaDevices) throw new Error("browsers give a microphone to HTTPS and this machine's own pages only");
  const audio = { channelCount: 1, echoCancellation: true, noiseSuppression: true, autoGainControl: true };
  const stream = await navigator.mediaDevices.getUserMedia({ audio });
  const context = new AudioContext({ sampleRate: RATE, latencyHint: "interactive" });
  await context.audioWorklet.addModule("/static/talking_worklet.js");
  const node = new AudioWorkletNode(context, "talking", { numberOfOutputs: 0, channelCount: 1, channelCountMode: "explicit" });
  const { port1, port2 } = new MessageChannel();
  node.port.postMessage({ worker: port1 }, [port1]);
  worker.postMessage({ order: "talking", port: port2 }, [port2]);
  context.createMediaStreamSource(stream).connect(node);
  port = node.port;
  [track] = stream.getAudioTracks();
  track.onended = () => {
    letGo();
    [port, track, opening] = [null, null, null];
  };
}

/** A key, or something else, is held from now on. @param {"key"|"pad"|"pointer"} by */
export function hold(by) {
  const why = whyNot();
  if (why) return showProblem(`you cannot speak: ${why}`);
  [heldBy, heldSince, failure] = [by, performance.now(), ""];
  opening ??= open();
  opening.then(apply).catch((error) => {
    opening = null;
    failure = REFUSALS[error.name] ?? String(error.message ?? error);
    if (heldBy) showProblem(`you cannot speak: ${failure}`);
    letGo();
  });
  apply();
}

/** It is held no more. @param {"key"|"pad"|"pointer"} [by] undefined: whatever is held */
export function letGo(by) {
  if (!heldBy || (by && by !== heldBy)) return;
  heldBy = null;
  apply();
}

function apply() {
  const held = heldBy !== null;
  if (track) track.enabled = held;
  port?.postMessage({ held });
  clearTimeout(echoTimer);
  if (held) duck(true);
  else echoTimer = setTimeout(() => duck(false), ECHO_MS);
  refresh();
}

/** Why this page cannot speak now; "": it can. */
function whyNot() {
  const voice = store.state?.voice;
  if (!store.hello?.voice) return "voice is not chosen: voice=";
  if (!inControl()) return whyNoControl();
  if (!voice) return "the vehicle has no loudspeaker: voice=";
  if (voice.fault) return `the vehicle's loudspeaker: ${voice.fault}`;
  return voice.operator === store.hello.operator ? "" : "not connected to the vehicle's loudspeaker yet";
}

/** Whether the vehicle hears what is spoken here, by its own word. */
const isHeard = () => heldBy !== null && Boolean(store.state?.voice?.speaking) && whyNot() === "";

function refresh() {
  const why = whyNot() || failure;
  if (heldBy && whyNot()) return letGo();
  const isLate = heldBy !== null && !isHeard() && performance.now() - heldSince > CONFIRM_MS;
  setText(button, isHeard() ? "SPEAKING" : isLate ? "✕ Not heard" : heldBy ? "Speaking …" : why ? "✕ Speak" : "Speak");
  setAttribute(button, "data-level", isHeard() ? "live" : isLate || why ? "near" : "fine");
  const title = isLate ? "the vehicle hears nothing" : why || "speak at the vehicle's loudspeaker while this is held";
  button.title = withKey(title, "talk");
}

/** @param {KeyboardEvent} event */
function onKeyUp(event) {
  const own = store.hello?.inputs.keys.talk;
  if (own && keyOf({ key: event.key, shiftKey: false }) === keyOf({ key: own, shiftKey: false })) letGo("key");
}

export function startTalking() {
  if (store.view === "monitor") return;
  button.addEventListener("pointerdown", (event) => {
    button.setPointerCapture(event.pointerId);
    hold("pointer");
  });
  for (const kind of ["pointerup", "pointercancel"]) button.addEventListener(kind, () => letGo("pointer"));
  addEventListener("keyup", onKeyUp, true);
  addEventListener("blur", () => letGo());
  document.addEventListener("visibilitychange", () => document.hidden && letGo());
  listen("hello", () => (button.hidden = !store.hello?.voice));
  listen("hello view state control socket sample", refresh);
  listen("view", () => placeBeside(button));
  placeBeside(button);
}

/** For the line of the Drive view, and for tests. */
export const talking = () => ({ held: heldBy !== null, heard: isHeard(), why: whyNot() || failure, words: button.textContent });
