/** The vehicle's sound on the page: a button that mutes it, its level and its age. Silent until a click or key press. */

import { listen, store } from "./store.js";
import { byId, make, setAttribute, setText, whole } from "./format.js";

const { worker } = globalThis.boot;
const KEY = "tod-vehicle-muted";
const FADE_S = 0.02;
const QUIET_DB = -60; // the lower end of the level meter

const button = make("button", { id: "hearing", hidden: "" });
const words = make("span");
const level = make("meter", { min: String(QUIET_DB), max: "0", high: "-6", "aria-label": "level of the vehicle's sound" });
/** @type {AudioContext|null} */
let context = null;
/** @type {GainNode|null} */
let volume = null;
let failure = "";
/** @type {{age_ms: number|null, ahead_ms: number|null, level_db: number|null, target_ms: number, counts: any}|null} */
let heard = null;

const isMuted = () => localStorage.getItem(KEY) === "yes";
const isBlocked = () => context?.state !== "running";

async function build() {
  if (typeof AudioDecoder === "undefined") return void (failure = "this browser cannot decode it");
  const own = (context = new AudioContext({ sampleRate: 48_000, latencyHint: "interactive" }));
  await own.audioWorklet.addModule("/static/hearing_worklet.js");
  const node = new AudioWorkletNode(own, "hearing", { numberOfInputs: 0, outputChannelCount: [1] });
  const { port1, port2 } = new MessageChannel();
  node.port.postMessage({ worker: port1 }, [port1]);
  volume = new GainNode(own, { gain: isMuted() ? 0 : 1 });
  node.connect(volume).connect(own.destination);
  own.onstatechange = () => attach();
  attach(port2);
}

/** @param {MessagePort} [port] */
function attach(port) {
  const latency_ms = 1000 * ((context?.baseLatency ?? 0) + (context?.outputLatency ?? 0));
  worker.postMessage({ order: "hearing", port, running: !isBlocked(), latency_ms }, port ? [port] : []);
  refresh();
}

function unlock() {
  if (context && isBlocked()) context.resume().catch(() => refresh());
}

function toggle() {
  if (!isMuted() && isBlocked()) return; // this press allows it
  localStorage.setItem(KEY, isMuted() ? "no" : "yes");
  refresh();
}

/** Why nothing is heard; "": it is. */
function fault() {
  const sample = store.sample?.sound;
  if (failure) return failure;
  if (sample?.fault || sample?.refused) return sample.fault ?? sample.refused;
  if (isBlocked()) return "blocked by the browser until a click or key press";
  if (isMuted()) return "muted";
  return (heard?.age_ms ?? null) === null ? "nothing arrives" : "";
}

function refresh() {
  if (context && volume) volume.gain.setTargetAtTime(isMuted() ? 0 : 1, context.currentTime, FADE_S);
  const why = fault();
  const short = isMuted() ? "muted" : why ? (isBlocked() ? "blocked" : "nothing") : `${whole(heard?.age_ms)} ms`;
  setText(words, `${why ? "✕ " : ""}Hearing ${short}`);
  setAttribute(button, "data-level", why ? "near" : "fine");
  level.value = heard?.level_db ?? QUIET_DB;
  button.title = `The vehicle's sound: ${why || `${step(heard?.ahead_ms ?? null)}; ${lost(heard?.counts)}; click to mute`}`;
}

/** @param {number|null} ahead_ms */
function step(ahead_ms) {
  if (ahead_ms === null) return "difference to the front camera unknown";
  return `${whole(Math.abs(ahead_ms))} ms ${ahead_ms < 0 ? "behind" : "ahead of"} the front camera`;
}

const lost = (counts) => `${whole(counts?.concealed ?? 0)} packets concealed, ${whole(counts?.dry ?? 0)} gaps`;

/** Beside the alarm tones, in either view. */
function place() {
  const isDrive = store.view === "drive";
  if (isDrive) byId("sound").after(button);
  else byId("sound-configure").after(button);
}

function onHello() {
  button.hidden = !store.hello?.sound;
  if (store.hello?.sound && !context && !failure) build().catch((error) => (failure = String(error.message ?? error)));
}

export function startHearing() {
  if (store.view === "monitor") return;
  button.append(words, level);
  button.addEventListener("click", toggle);
  for (const kind of ["pointerup", "keydown"]) addEventListener(kind, unlock, true);
  listen("hello", onHello);
  listen("view", place);
  listen("sample", refresh);
  listen("hearing", (report) => {
    heard = report;
    refresh();
  });
  addEventListener("storage", refresh); // muted in another window
  place();
}

/** For tests. */
export const hearing = () => ({ ...heard, state: context?.state, gain: volume?.gain.value, fault: fault() });
