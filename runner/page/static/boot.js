/**
 * Starts the worker before anything else: it connects and decodes while the rest of the page is loading. Not a module,
 * since modules wait for the whole document.
 */
"use strict";

const canShowVideo =
  typeof VideoDecoder !== "undefined" && typeof HTMLCanvasElement.prototype.transferControlToOffscreen === "function";
const early = []; // the worker's messages before there is a listener
// Cameras of a monitor, a window that shows these for the page of this browser; null: this is a page.
const shown = new URLSearchParams(location.search).get("show")?.split(",").filter((name) => name !== "") ?? null;
const worker = new Worker("/static/video.js", { type: "module" });
globalThis.boot = { canShowVideo, early, shown, worker };

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
  const url = new URL("/live", location.href);
  url.protocol = url.protocol.replace("http", "ws");
  url.search = String(new URLSearchParams({ viewer: token(), browser: browser(), ...(shown && { show: shown.join() }) }));
  return url.href;
}

function random() {
  return [...crypto.getRandomValues(new Uint8Array(16))].map((b) => b.toString(16).padStart(2, "0")).join("");
}

/** A random name of this browser: its monitors share selection and control with its page. */
function browser() {
  const key = "tod-browser";
  const made = localStorage.getItem(key) ?? random();
  localStorage.setItem(key, made);
  return made;
}

/**
 * A random name of this viewer, the same after a reload. It is in the tab's storage only from one document to the next,
 * since a duplicated tab copies the storage and must not take control as well.
 */
function token() {
  const key = "tod-viewer";
  const made = sessionStorage.getItem(key) ?? random();
  sessionStorage.removeItem(key);
  addEventListener("pagehide", () => sessionStorage.setItem(key, made));
  addEventListener("pageshow", () => sessionStorage.removeItem(key));
  return made;
}
