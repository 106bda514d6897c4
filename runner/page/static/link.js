/** The page's end of the worker: messages from the station come in here, requests and canvases go out. */

import { publish, store, take } from "./store.js";

const { canShowVideo, early, worker } = globalThis.boot;
const questions = new Map();
let asked = 0;

const heard = {
  server: ({ message }) => take(message),
  socket({ open }) {
    store.connected = open;
    if (!open) store.holder = "nobody";
    publish("socket", open);
  },
  status({ camera, status, why }) {
    store.status[camera] = status;
    store.refused[camera] = why;
    publish("status", { camera, status });
  },
  ages({ ages, skew_ms }) {
    store.ages = ages;
    store.skew_ms = skew_ms;
    publish("ages", ages);
  },
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
}

export const send = (message) => worker.postMessage({ order: "send", message });

export function giveCanvas(name, element) {
  if (!canShowVideo) return;
  const canvas = element.transferControlToOffscreen();
  worker.postMessage({ order: "canvas", name, canvas }, [canvas]);
}

/** Report the size of a canvas on the screen, in CSS pixels. */
export const tellSize = (name, width, height) =>
  worker.postMessage({ order: "size", name, width, height, ratio: devicePixelRatio });

/** Ask the worker; for tests and benchmarks. */
export function ask(what, name) {
  const id = ++asked;
  worker.postMessage({ order: "ask", id, what, name });
  return new Promise((resolve) => questions.set(id, resolve));
}
