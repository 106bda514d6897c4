/** The page's side of the worker link: messages from the station come in, requests and canvases go out. */

import { checkRegularly } from "./periodic.js";
import { dropOldSample, onStationMessage, publish, store } from "./store.js";

const { canShowVideo, early, worker } = globalThis.boot;
const HUNG_MS = 1500; // the worker reports four times a second
const CHECK_MS = 250;
const ANSWERED_MS = 10_000; // limit of a question to the worker
const questions = new Map();
let lastQuestion = 0;
let reportedAt = performance.now(); // when the worker last reported
/** @type {{connected: boolean}|null} */
let hung = null; // while the worker hangs: its last connection state

const handlers = {
  server: ({ message }) => onStationMessage(message),
  socket({ open, ended }) {
    store.ended = ended;
    if (hung) return void (hung.connected = open);
    store.connected = open;
    if (!open) store.holder = "unknown";
    publish("socket", open);
  },
  status({ camera, status, why }) {
    store.status[camera] = status;
    store.refused[camera] = why;
    publish("status", { camera, status });
  },
  ages({ ages, skew_ms, slow, steering }) {
    reportedAt = performance.now();
    if (hung) onWorkerRecovered(ages);
    store.ages = ages;
    store.skew_ms = skew_ms;
    store.slow = slow;
    store.steering = steering;
    publish("ages", ages);
  },
  asked: () => worker.postMessage({ order: "ready" }),
  login: () => location.assign(`/login${location.search}${location.hash}`),
  hearing: ({ report }) => publish("hearing", report),
  crooked: (message) => publish("crooked", message),
  flat: (message) => publish("flat", message),
  sent: ({ id, sent }) => sent || publish("unsent", id),
  answer({ id, value }) {
    questions.get(id)?.(value);
    questions.delete(id);
  },
};

/** Handle the worker's messages, from its first one on. */
export function start() {
  for (const data of early) handlers[data.kind](data);
  worker.onmessage = ({ data }) => handlers[data.kind](data);
  checkRegularly(CHECK_MS, (now) => {
    dropOldSample();
    checkWorker(now);
  });
}

/** If the worker hangs or has died, its last pictures still look live: mark them as lost. */
function checkWorker(now) {
  if (hung || now - reportedAt < HUNG_MS || !Object.keys(store.status).length) return;
  hung = { connected: store.connected };
  Object.assign(store, { hung: true, connected: false });
  publish("socket", false);
  for (const camera of Object.keys(store.status)) handlers.status({ camera, status: "lost", why: store.refused[camera] });
}

function onWorkerRecovered(ages) {
  Object.assign(store, { hung: false, connected: hung?.connected ?? false });
  hung = null;
  publish("socket", store.connected);
  for (const [camera, { status }] of Object.entries(ages)) handlers.status({ camera, status, why: store.refused[camera] });
}

export const send = (message) => worker.postMessage({ order: "send", message });

/** Transfer the canvases of a camera to the worker: one for its picture, one for the lines above it. */
export function transferCanvases(name, ...elements) {
  if (!canShowVideo) return;
  const [canvas, lines] = elements.map((element) => element.transferControlToOffscreen());
  worker.postMessage({ order: "canvas", name, canvas, lines }, [canvas, lines]);
}

/**
 * State whether the operator can see this page, and its keys reach it; the worker reports it.
 * @param {string} state  @param {boolean} focused
 */
export const reportAttention = (state, focused) => worker.postMessage({ order: "attention", state, focused });

/** @param {string[]} names of the cameras whose guides are shown */
export const showGuides = (names) => worker.postMessage({ order: "guided", names });

/** @param {string|null} name of the camera whose picture is drawn first */
export const drawFirst = (name) => worker.postMessage({ order: "first", name });

/** Transfer the canvases of the bird's-eye view to the worker: one for its picture, one for the lines above it. */
export function transferGround(...elements) {
  if (!canShowVideo) return;
  const [picture, lines] = elements.map((element) => element.transferControlToOffscreen());
  worker.postMessage({ order: "ground", picture, lines }, [picture, lines]);
}

/** Show the bird's-eye view in a box on the screen, or hide it. */
export const showGround = (shown, { clientWidth: width, clientHeight: height }) =>
  worker.postMessage({ order: "above", shown, width, height, ratio: devicePixelRatio });

/**
 * Show only a part of a camera's pictures.
 * @param {string} name  @param {import("./framing.js").Rectangle|null} region px of the full image; null: all of it
 */
export const showCrop = (name, region) => worker.postMessage({ order: "crop", name, region });

/** @param {string[]} names of the cameras whose pictures are straightened */
export const showStraight = (names) => worker.postMessage({ order: "straight", names });

/** Report the size of a picture's box on the screen, in CSS pixels, how the picture is placed in it, and whether it is covered. */
export const reportSize = (name, { clientWidth: width, clientHeight: height }, view, covered) =>
  worker.postMessage({ order: "size", name, width, height, ratio: devicePixelRatio, view, covered });

/** Ask the worker; for tests and benchmarks. */
export function ask(what, name) {
  const id = ++lastQuestion;
  worker.postMessage({ order: "ask", id, what, name });
  return new Promise((resolve, reject) => {
    questions.set(id, resolve);
    setTimeout(() => questions.delete(id) && reject(new Error("the video worker does not answer")), ANSWERED_MS);
  });
}
