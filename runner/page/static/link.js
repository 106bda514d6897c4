/** The page's end of the worker: messages from the station come in here, requests and canvases go out. */

import { publish, store, take } from "./store.js";

const { canShowVideo, early, worker } = globalThis.boot;
const HUNG_MS = 1500; // the worker reports four times a second
const CHECK_MS = 250;
const questions = new Map();
let asked = 0;
let told = performance.now(); // when the worker last reported
let checked = told;
/** @type {{connected: boolean}|null} */
let hung = null; // while it does not: what it last stated

const heard = {
  server: ({ message }) => take(message),
  socket({ open }) {
    if (hung) return void (hung.connected = open);
    store.connected = open;
    if (!open) store.holder = "nobody";
    publish("socket", open);
  },
  status({ camera, status, why }) {
    store.status[camera] = status;
    store.refused[camera] = why;
    publish("status", { camera, status });
  },
  ages({ ages, skew_ms, slow }) {
    told = performance.now();
    if (hung) revive(ages);
    store.ages = ages;
    store.skew_ms = skew_ms;
    store.slow = slow;
    publish("ages", ages);
  },
  crooked: (message) => publish("crooked", message),
  sent: ({ id, sent }) => sent || publish("unsent", id),
  answer({ id, value }) {
    questions.get(id)?.(value);
    questions.delete(id);
  },
};

/** Pass on the worker's messages, from its first one on. */
export function start() {
  for (const data of early) heard[data.kind](data);
  worker.onmessage = ({ data }) => heard[data.kind](data);
  setInterval(supervise, CHECK_MS);
}

/** A worker that hangs or has died shows standing pictures as live: its page must not. */
function supervise() {
  const time = performance.now();
  const late = time - checked > 2 * CHECK_MS; // this page has stood still itself: the worker's messages are about to come
  checked = time;
  if (hung || late || time - told < HUNG_MS || !Object.keys(store.status).length) return;
  hung = { connected: store.connected };
  store.connected = false;
  publish("socket", false);
  for (const camera of Object.keys(store.status)) heard.status({ camera, status: "lost", why: store.refused[camera] });
}

function revive(ages) {
  store.connected = hung?.connected ?? false;
  hung = null;
  publish("socket", store.connected);
  for (const [camera, { status }] of Object.entries(ages)) heard.status({ camera, status, why: store.refused[camera] });
}

export const send = (message) => worker.postMessage({ order: "send", message });

export function giveCanvas(name, element) {
  if (!canShowVideo) return;
  const canvas = element.transferControlToOffscreen();
  worker.postMessage({ order: "canvas", name, canvas }, [canvas]);
}

/** Give the worker the canvas of a camera's guides. */
export function giveGuides(name, element) {
  if (!canShowVideo) return;
  const canvas = element.transferControlToOffscreen();
  worker.postMessage({ order: "guides", name, canvas }, [canvas]);
}

/** @param {string[]} names of the cameras whose guides are shown */
export const showGuides = (names) => worker.postMessage({ order: "guided", names });

/** @param {string|null} name of the camera whose picture is drawn first */
export const drawFirst = (name) => worker.postMessage({ order: "first", name });
/** Give the worker the canvases of the bird's-eye view: of its picture, and of the lines above it. */
export function giveGround(...elements) {
  if (!canShowVideo) return;
  const [picture, lines] = elements.map((element) => element.transferControlToOffscreen());
  worker.postMessage({ order: "ground", picture, lines }, [picture, lines]);
}

/** Show the bird's-eye view in a box on the screen, or not. */
export const showGround = (shown, { clientWidth: width, clientHeight: height }) =>
  worker.postMessage({ order: "above", shown, width, height, ratio: devicePixelRatio });

/** @param {string[]} names of the cameras whose pictures are straightened */
export const showStraight = (names) => worker.postMessage({ order: "straight", names });

/** Report the size of a picture's box on the screen, in CSS pixels, and how the picture lies in it. */
export const tellSize = (name, { clientWidth: width, clientHeight: height }, view) =>
  worker.postMessage({ order: "size", name, width, height, ratio: devicePixelRatio, view });

/** Ask the worker; for tests and benchmarks. */
export function ask(what, name) {
  const id = ++asked;
  worker.postMessage({ order: "ask", id, what, name });
  return new Promise((resolve) => questions.set(id, resolve));
}
