/**
 * The two views of the page, Drive and Configure. Only the operator changes the view. It survives a reload, and Drive is
 * offered once, when this tab first gets control. A monitor, a window with some of the pictures, has its own view.
 */

import { enlarge, inControl, listen, publish, store } from "./store.js";
import { showProblem } from "./requests.js";
import { openTab } from "./tabs.js";
import { byId } from "./format.js";

const VIEW = "tod-view";
const OFFERED = "tod-drive-offered";
let isOffered = false; // whether the offer is unanswered

/** @param {"configure"|"drive"} view */
function setView(view) {
  store.view = view;
  sessionStorage.setItem(VIEW, view);
  dismissOffer();
  applyView();
  enlarge(null); // each view begins with its usual pictures
  publish("view", view);
}

function applyView() {
  const drive = store.view === "drive";
  document.body.dataset.view = store.view;
  byId("drive").hidden = !drive;
  if (!drive) setDrawer(false);
}

export function toggleView() {
  if (store.view !== "monitor") setView(store.view === "drive" ? "configure" : "drive");
}

// --- the drawer: everything but the pictures --------------------------------------------------------------------------

export function toggleDrawer() {
  if (store.view === "drive") setDrawer(document.body.dataset.drawer === undefined);
}

/** Open a tab, and the drawer with it; close the drawer if the tab is already open. */
export function toggleTab(name) {
  const isOpen = document.body.dataset.drawer !== undefined && byId("side").dataset.tab === name;
  openTab(name);
  if (store.view === "drive") setDrawer(!isOpen);
}

function setDrawer(open) {
  if (open) document.body.dataset.drawer = "open";
  else delete document.body.dataset.drawer;
  byId("drawer").setAttribute("aria-expanded", String(open));
  byId("drawer").textContent = open ? "Close drawer" : "Open drawer";
  byId(open ? "side" : "scene").scrollIntoView({ block: "nearest" }); // on a narrow page it is below the pictures
}

// --- full screen ------------------------------------------------------------------------------------------------------

export async function toggleFullScreen() {
  try {
    if (document.fullscreenElement) await document.exitFullscreen();
    else await enterFullScreen();
  } catch (error) {
    showProblem(`full screen failed: ${error instanceof Error ? error.message : error}`);
  }
}

/** Enter full screen, where Escape is the page's key: browsers that can pass it on leave full screen only while it is held. */
async function enterFullScreen() {
  await document.documentElement.requestFullscreen({ navigationUI: "hide" });
  await /** @type {any} */ (navigator).keyboard?.lock?.(["Escape"]).catch(() => {});
}

const showFullScreen = () => (byId("full-screen").textContent = document.fullscreenElement ? "Leave full screen" : "Fill the screen");

// --- the offer --------------------------------------------------------------------------------------------------------

/** Offer the Drive view to the page in control. The offer stays unanswered while the connection is lost. */
function refreshOffer() {
  if (inControl() && store.view === "configure" && !sessionStorage.getItem(OFFERED)) {
    sessionStorage.setItem(OFFERED, "yes");
    isOffered = true;
  }
  byId("offer").hidden = !(isOffered && inControl());
}

function dismissOffer() {
  isOffered = false;
  refreshOffer();
}

export function startViews() {
  store.view = globalThis.boot.shown ? "monitor" : sessionStorage.getItem(VIEW) === "drive" ? "drive" : "configure";
  for (const id of ["to-drive", "to-configure"]) byId(id).addEventListener("click", toggleView);
  byId("drawer").addEventListener("click", toggleDrawer);
  byId("full-screen").addEventListener("click", toggleFullScreen);
  document.addEventListener("fullscreenchange", showFullScreen);
  byId("offer-drive").addEventListener("click", () => setView("drive"));
  byId("offer-no").addEventListener("click", dismissOffer);
  listen("control state socket", refreshOffer);
  applyView();
  showFullScreen();
}
