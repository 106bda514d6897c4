/**
 * Starts the worker before anything else: it connects and decodes while the rest of the page is loading. Not a module,
 * since modules wait for the whole document.
 */
"use strict";

const canShowVideo =
  typeof VideoDecoder !== "undefined" && typeof HTMLCanvasElement.prototype.transferControlToOffscreen === "function";
const early = []; // the worker's messages before there is a listener
const worker = new Worker("/static/video.js", { type: "module" });
globalThis.boot = { canShowVideo, early, worker };

worker.onmessage = ({ data }) => early.push(data);
worker.postMessage({
  order: "start",
  url: liveUrl(),
  origin: performance.timeOrigin,
  video: canShowVideo,
  keep: location.hash === "#measure",
  counted: new URLSearchParams(location.hash.slice(1)).get("counter"),
});

addEventListener("hashchange", () => location.reload()); // another camera is to be read

function liveUrl() {
  const url = new URL(`/live?viewer=${token()}`, location.href);
  url.protocol = url.protocol.replace("http", "ws");
  return url.href;
}

/**
 * A random name of this viewer, the same after a reload. It is in the tab's storage only from one document to the next,
 * since a duplicated tab copies the storage and must not take control as well.
 */
function token() {
  const key = "tod-viewer";
  const random = () => [...crypto.getRandomValues(new Uint8Array(16))].map((b) => b.toString(16).padStart(2, "0")).join("");
  const made = sessionStorage.getItem(key) ?? random();
  sessionStorage.removeItem(key);
  addEventListener("pagehide", () => sessionStorage.setItem(key, made));
  addEventListener("pageshow", () => sessionStorage.removeItem(key));
  return made;
}
