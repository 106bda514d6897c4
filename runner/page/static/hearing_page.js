/** The vehicle's sound on the page: a button that mutes it, its level and its age. Silent until a click or key press. */

import { listen, publish, store } from "./store.js";
import { withKey } from "./hints.js";
import { byId, make, setAttribute, setText, whole } from "./format.js";

const { worker } = globalThis.boot;
const MUTED = "tod-vehicle-muted"; // in the browser's storage
const FADE_S = 0.02;
const SAME_MS = 2; // latencies of the output that differ by less
const QUIET_DB = -60; // the lower end of the level meter

const button = make("button", { id: "hearing", hidden: "" });
const words = make("span");
const level = make("meter", { min: String(QUIET_DB), max: "0", high: "-6", "aria-label": "level of the vehicle's sound" });
/** @type {AudioContext|null} */
let context = null;
/** @type {GainNode|null} */
let volume = null;
let latency_ms = 0; // as the worker knows it
let failure = "";
let isDucked = false; // while somebody speaks at this page
let wasBlocked = true; // whether the browser blocked it when the last press began
/** @type {{age_ms: number|null, ahead_ms: number|null, level_db: number|null, target_ms: number, counts: any}|null} */
let heard = null;

const isMuted = () => localStorage.getItem(MUTED) === "yes";
const isBlocked = () => context?.state !== "running";

async function build() {
  if (typeof AudioDecoder === "undefined") return void (failure = "this browser cannot decode it");
  const own = (context = new AudioContext({ sampleRate: 48_000, latencyHint: 0 })); // the least
  await own.audioWorklet.addModule("/static/hearing_worklet.js");
  const node = new AudioWorkletNode(own, "hearing", { numberOfInputs: 0, outputChannelCount: [1] });
  const { port1, port2 } = new MessageChannel();
  node.port.postMessage({ worker: port1 }, [port1]);
  volume = new GainNode(own, { gain: isMuted() ? 0 : 1 });
  node.connect(volume).connect(own.destination);
  own.onstatechange = () => attach();
  attach(port2);
}

/** From the audio thread to the ear, ms; known some time after it has begun. */
const outputLatency = () => 1000 * ((context?.baseLatency ?? 0) + (context?.outputLatency ?? 0));

/** @param {MessagePort} [port] */
function attach(port) {
  latency_ms = outputLatency();
  worker.postMessage({ order: "hearing", port, running: !isBlocked(), latency_ms }, port ? [port] : []);
  refresh();
}

/** @param {Event} event */
function unlock(event) {
  if (event instanceof KeyboardEvent && event.repeat) return;
  wasBlocked = isBlocked();
  if (context && wasBlocked) context.resume().catch(() => refresh());
}

/** Mute or unmute; a press that allows it does not mute it as well. */
export function toggleHearing() {
  if (!store.hello?.sound) return publish("toast", { text: "sound is not chosen: sound=", level: "hint" });
  if (!isMuted() && isBlocked()) return;
  localStorage.setItem(MUTED, isMuted() ? "no" : "yes");
  refresh();
}

const BLOCKED = "blocked by the browser until a click or key press";

/** Why nothing is heard; "": it is. */
function fault() {
  if (isMuted()) return "muted";
  const sample = store.sample?.sound;
  if (failure) return failure;
  if (sample?.fault || sample?.refused) return sample.fault ?? sample.refused;
  if (isBlocked()) return BLOCKED;
  return (heard?.age_ms ?? null) === null ? "nothing arrives" : "";
}

function refresh() {
  if (context && volume) volume.gain.setTargetAtTime(isMuted() || isDucked ? 0 : 1, context.currentTime, FADE_S);
  const why = fault();
  const short = why === "muted" ? why : why === BLOCKED ? "blocked" : why ? "none" : `${whole(heard?.age_ms)} ms`;
  setText(words, `${why ? "✕ " : ""}Sound ${short}${store.sample?.sound?.recorded ? " · recorded" : ""}`);
  setAttribute(button, "data-level", why ? "near" : "fine");
  level.value = heard?.level_db ?? QUIET_DB;
  const title = `The vehicle's sound: ${why || `${step(heard?.ahead_ms ?? null)}; ${lost(heard?.counts)}`}`;
  button.title = `${title}\n${withKey(isMuted() ? "unmute" : "mute", "hear")}`;
}

/** @param {number|null} ahead_ms */
function step(ahead_ms) {
  if (ahead_ms === null) return "difference to the main picture unknown";
  return `${whole(Math.abs(ahead_ms))} ms ${ahead_ms < 0 ? "behind" : "ahead of"} the main picture`;
}

const lost = (counts) => `${whole(counts?.concealed ?? 0)} packets concealed, ${whole(counts?.dry ?? 0)} gaps`;

/** Silence while somebody speaks at this page: the vehicle's microphone hears its loudspeaker. @param {boolean} on */
export function duck(on) {
  isDucked = on;
  refresh();
}

/** Beside the alarm tones, in either view. @param {HTMLElement} element */
export const placeBeside = (element) => byId(store.view === "drive" ? "sound" : "sound-configure").after(element);

function onHello() {
  button.hidden = !store.hello?.sound;
  if (store.hello?.sound && !context && !failure) build().catch((error) => (failure = String(error.message ?? error)));
}

export function startHearing() {
  if (store.view === "monitor") return;
  button.append(words, level);
  button.addEventListener("click", () => (!wasBlocked || isMuted()) && toggleHearing()); // allowed since the press began
  for (const kind of ["pointerup", "keydown"]) addEventListener(kind, unlock, true);
  listen("hello", onHello);
  listen("view", () => placeBeside(button));
  listen("sample", refresh);
  listen("hearing", (report) => {
    heard = report;
    if (Math.abs(outputLatency() - latency_ms) > SAME_MS) attach();
    else refresh();
  });
  addEventListener("storage", refresh); // muted in another window
  placeBeside(button);
}

/** For the line of the Drive view. */
export const hearingFault = () => (store.hello?.sound && fault() ? `✕ sound${isMuted() ? "" : ":"} ${fault()}` : "");

/** For tests. */
export const hearing = () => ({ ...heard, state: context?.state, gain: volume?.gain.value, fault: fault() });
