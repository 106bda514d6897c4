/** The Drive view's figures: what a driver must not miss. */

import { inControl, listen, mode, publish, store } from "./store.js";
import { worstOf } from "./ages.js";
import { Attention } from "./attention.js";
import { isGuided, nextChoice } from "./guides.js";
import { toggleControl } from "./header.js";
import { send, showGuides } from "./link.js";
import { SHAPES } from "./tiles.js";
import { whyLess } from "./total.js";
import { by, latency, mark, spoken, whole, write } from "./format.js";

const MODES = { single: "Single", automatic: "Automatic", collective: "Collective" };
const ALARMS = ["lost", "frozen", "unsupported", "damaged", "late"]; // the worst first
const WORDS = { unsupported: "NO PICTURE" };
const STANDING = ["lost", "frozen", "unsupported"];
const KMH = 3.6; // of 1 m/s
const GUIDES = "tod-guides";
const SETTLED_MS = 2500; // by then what a hidden page did not draw counts no longer

const attention = new Attention();
let focused = document.hasFocus();
let shown = -Infinity; // when the page was last hidden
let told = ""; // what the station knows of it
const names = () => (store.hello?.cameras ?? []).map(({ name }) => name);
const current = () => store.connected && store.state?.online;

function refresh() {
  if (store.view !== "drive") return;
  refreshLatency();
  refreshSpeed();
  write(by("line"), [MODES[mode() ?? ""] ?? "no mode", totalWords(), linkWords()].join(" · "));
  refreshAlarms();
  refreshControl();
}

/** The worst latency of all pictures. A picture that stands still has none, and is worse than any. */
function refreshLatency() {
  const { camera, age_ms, bound_ms, level } = worstOf(store.ages, store.status, store.hello?.late_ms ?? 0);
  const standing = names().filter((name) => STANDING.includes(store.status[name]));
  const from = camera === null ? "no picture moves" : `${level === "unknown" ? "unknown" : "worst"}: ${spoken(camera)}`;
  mark(by("latency"), "data-level", standing.length ? "late" : level);
  write(by("worst"), latency(age_ms, bound_ms));
  write(by("worst-of"), standing.length ? `${standing.length} of ${names().length} pictures stand still` : from);
}

function refreshSpeed() {
  const speed_mps = current() ? store.sample?.position?.speed_mps : undefined;
  const factor = current() ? store.sample?.speed_factor : undefined;
  write(by("driven"), `${whole(KMH * (speed_mps ?? NaN))} km/h`);
  write(by("advised"), Number.isFinite(factor) ? `advised: ${whole(100 * (factor ?? 0))} % of full speed` : "no speed advised");
  mark(by("speed-now"), "data-level", factor === 0 ? "late" : Number.isFinite(factor) && (factor ?? 1) < 1 ? "near" : "fine");
}

function totalWords() {
  const { total_kbps, asked_kbps } = (current() ? store.state : null) ?? {};
  const less = total_kbps !== undefined && Number.isFinite(asked_kbps) && total_kbps < (asked_kbps ?? 0);
  return `${whole(total_kbps)}${less ? ` of ${whole(asked_kbps)}` : ""} kbit/s`;
}

/** Whether the vehicle is reached, and by what its total is limited, if it is. */
function linkWords() {
  if (!store.connected) return "no station";
  if (!store.state) return "no state yet";
  if (!store.state.online) return "vehicle offline";
  const reason = whyLess().at(-1);
  return reason ? `limited: ${reason.slice(reason.indexOf(": ") + 2)}` : "connected";
}

/** By word, which pictures are not as they should be: FROZEN front left, rear. */
function refreshAlarms() {
  const found = ALARMS.map((status) => ({ status, cameras: names().filter((name) => store.status[name] === status) })).filter(({ cameras }) => cameras.length);
  const words = found.map(({ status, cameras }) => `${SHAPES[status]} ${WORDS[status] ?? status.toUpperCase()} ${cameras.map(spoken).join(", ")}`);
  write(by("alarms"), words.join("  "));
  mark(by("alarms"), "data-level", found.some(({ status }) => STANDING.includes(status)) ? "late" : "near");
}

function refreshControl() {
  const button = by("drive-control", HTMLButtonElement);
  write(button, store.holder === "you" ? "Release" : "Take control");
  button.classList.toggle("strong", store.connected && store.holder !== "you");
  button.disabled = !store.connected;
}

// --- lines on the ground ----------------------------------------------------------------------------------------------

/** @returns {import("./guides.js").Choice} */
const chosen = () => /** @type {any} */ (localStorage.getItem(GUIDES)) ?? "calibrated";
const placedCameras = () => (store.hello?.dimensions ? store.hello.cameras.filter(({ pose }) => pose) : []);

export function toggleGuides() {
  localStorage.setItem(GUIDES, nextChoice(placedCameras(), chosen()));
  refreshGuides();
}

function refreshGuides() {
  const cameras = placedCameras();
  const guided = store.view !== "configure" ? cameras.filter((camera) => isGuided(camera, chosen())).map(({ name }) => name) : [];
  for (const canvas of document.querySelectorAll("canvas.guides")) canvas.toggleAttribute("hidden", !guided.includes(canvas.getAttribute("data-guides") ?? ""));
  showGuides(guided);
  by("guides").hidden = !cameras.length;
  const some = chosen() === "calibrated" && guided.length < cameras.length;
  write(by("guides"), guided.length ? `Guides on${some ? ` (${guided.length})` : ""}` : "Guides off");
}

// --- the driver looks elsewhere ---------------------------------------------------------------------------------------

function look() {
  if (document.hidden) shown = performance.now();
  const slow = store.slow && performance.now() - shown > SETTLED_MS;
  const words = attention.changed({ hidden: document.hidden, focused, elsewhere: store.elsewhere, slow }, performance.now());
  const warning = inControl() ? attention.warning : null;
  by("attention").hidden = warning === null || (store.view !== "drive" && attention.state !== "slow");
  write(by("attention"), warning ?? "");
  tellAttention();
  if (words && inControl() && store.view !== "configure") publish("toast", { text: words, level: "problem" });
}

/** Tell the station, which tells the vehicle while this page is in control. */
function tellAttention() {
  if (!store.connected || told === attention.state) return;
  told = attention.state;
  send({ attention: told });
}

export function startDrive() {
  by("drive-control").addEventListener("click", toggleControl);
  by("guides").addEventListener("click", toggleGuides);
  by("drive-help").addEventListener("click", () => publish("help"));
  addEventListener("blur", () => {
    focused = false;
    look();
  });
  addEventListener("focus", () => {
    focused = true;
    look();
  });
  document.addEventListener("visibilitychange", look);
  listen("hello state sample ages status control socket requests view", refresh);
  listen("socket", () => (told = ""));
  listen("control socket view ages", look);
  listen("hello view", refreshGuides);
  addEventListener("storage", refreshGuides); // chosen in another window
  refresh();
}
