/**
 * The two views of the page, Drive and Configure. Only the operator changes the view: it outlasts a reload, and Drive is
 * offered once, when this tab first gets control. A monitor, a window with some pictures, has a view of its own.
 */

import { inControl, listen, publish, store } from "./store.js";
import { openTab } from "./tabs.js";
import { by } from "./format.js";

const VIEW = "tod-view";
const OFFERED = "tod-drive-offered";
let offered = false; // whether the offer waits for an answer

/** @param {"configure"|"drive"} view */
function choose(view) {
  store.view = view;
  sessionStorage.setItem(VIEW, view);
  answer();
  show();
  publish("view", view);
}

function show() {
  const drive = store.view === "drive";
  document.body.dataset.view = store.view;
  by("drive").hidden = !drive;
  if (!drive) setDrawer(false);
}

export function toggleView() {
  if (store.view !== "monitor") choose(store.view === "drive" ? "configure" : "drive");
}

// --- the drawer: all that is not a picture ----------------------------------------------------------------------------

export function toggleDrawer() {
  if (store.view === "drive") setDrawer(document.body.dataset.drawer === undefined);
}

/** Open a tab, and the drawer for it; close the drawer where that tab is open. */
export function toggleTab(name) {
  const isOpen = document.body.dataset.drawer !== undefined && by("side").dataset.tab === name;
  openTab(name);
  if (store.view === "drive") setDrawer(!isOpen);
}

function setDrawer(open) {
  if (open) document.body.dataset.drawer = "open";
  else delete document.body.dataset.drawer;
  by("drawer").setAttribute("aria-expanded", String(open));
}

// --- full screen ------------------------------------------------------------------------------------------------------

export async function toggleFullScreen() {
  try {
    if (document.fullscreenElement) await document.exitFullscreen();
    else await document.documentElement.requestFullscreen({ navigationUI: "hide" });
  } catch (error) {
    publish("toast", { text: `no full screen: ${error instanceof Error ? error.message : error}`, level: "problem" });
  }
}

const showFullScreen = () => by("full-screen").setAttribute("aria-pressed", String(document.fullscreenElement !== null));

// --- the offer --------------------------------------------------------------------------------------------------------

/** The offer is for who is in control; it waits for an answer, also while the connection is lost. */
function refreshOffer() {
  if (inControl() && store.view === "configure" && !sessionStorage.getItem(OFFERED)) {
    sessionStorage.setItem(OFFERED, "yes");
    offered = true;
  }
  by("offer").hidden = !(offered && inControl());
}

function answer() {
  offered = false;
  refreshOffer();
}

export function startViews() {
  store.view = globalThis.boot.shown ? "monitor" : sessionStorage.getItem(VIEW) === "drive" ? "drive" : "configure";
  for (const id of ["to-drive", "to-configure"]) by(id).addEventListener("click", toggleView);
  by("drawer").addEventListener("click", toggleDrawer);
  by("full-screen").addEventListener("click", toggleFullScreen);
  document.addEventListener("fullscreenchange", showFullScreen);
  by("offer-drive").addEventListener("click", () => choose("drive"));
  by("offer-no").addEventListener("click", answer);
  listen("control socket", refreshOffer);
  show();
  showFullScreen();
}
