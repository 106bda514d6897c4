/**
 * Starts the worker before anything else: it connects and decodes while the rest of the page is loading. Not a module:
 * modules wait for the whole document.
 */
"use strict";

const canShowVideo =
  typeof VideoDecoder !== "undefined" && typeof HTMLCanvasElement.prototype.transferControlToOffscreen === "function";
const early = []; // the worker's messages until link.js handles them
// Cameras that this window shows as a monitor of a page in the same browser; null: it is a page itself.
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

addEventListener("hashchange", () => location.reload()); // #counter may name another camera
worker.addEventListener("error", (event) => event instanceof ErrorEvent || globalThis.loadAgain?.()); // it was not loaded

function liveUrl() {
  const url = new URL("live", location.href); // next to the page: a list of vehicles has one for each
  url.protocol = url.protocol.replace("http", "ws");
  url.search = String(new URLSearchParams({ viewer: viewerToken(), browser: browserId(), ...(shown && { show: shown.join() }) }));
  return url.href;
}

function randomId() {
  return [...crypto.getRandomValues(new Uint8Array(16))].map((b) => b.toString(16).padStart(2, "0")).join("");
}

/** A random ID of this browser, by which monitors share selection and control with their page. */
function browserId() {
  const key = "tod-browser";
  const id = localStorage.getItem(key) ?? randomId();
  localStorage.setItem(key, id);
  return id;
}

/**
 * A random ID of this viewer, kept across a reload. It is in the tab's storage only between two documents: duplicating a
 * tab copies the storage, and the copy must not take control as well.
 */
function viewerToken() {
  const keys = ["tod-viewer", "tod-monitor"];
  const own = keys[shown ? 1 : 0]; // a monitor opened in a page's tab must not inherit its control
  const ids = Object.fromEntries(keys.map((key) => [key, sessionStorage.getItem(key)]));
  ids[own] ??= randomId();
  const clear = () => keys.forEach((key) => sessionStorage.removeItem(key));
  clear();
  addEventListener("pagehide", () => keys.forEach((key) => ids[key] && sessionStorage.setItem(key, ids[key])));
  addEventListener("pageshow", clear);
  return ids[own];
}
