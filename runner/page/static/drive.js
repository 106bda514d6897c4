/** The Drive view's figures: what a driver must not miss. */

import { alertStatus, inControl, listen, mode, ofVehicle, publish, remind, store } from "./store.js";
import { mostOf, worstOf } from "./ages.js";
import { ALARMS } from "./alarm.js";
import { Attention } from "./attention.js";
import { isGuided, nextChoice } from "./guides.js";
import { controlWarning } from "./control.js";
import { linkFault } from "./header.js";
import { reportAttention } from "./link.js";
import { monitored, ownPictures } from "./monitored.js";
import { showProblem } from "./requests.js";
import { soundFault } from "./sound.js";
import { hearingFault } from "./hearing_page.js";
import { SHAPES, showLines } from "./tiles.js";
import { headingText } from "./track.js";
import { fitPanels } from "./panels.js";
import { limitWords } from "./reasons.js";
import { limitReasons, pauseReason } from "./total.js";
import { copiesWords, ofWords, totalsOf } from "./totals.js";
import { showUplinks, uplinkLines } from "./uplinks.js";
import { byId, displayName, KBPS, latency, setAttribute, setText, whole } from "./format.js";

const MODES = { single: "Single", automatic: "Automatic", collective: "Collective" };
const WORDS = { unsupported: "NO PICTURE" };
const WORST_FIRST = Object.keys(ALARMS);
const NOT_LIVE = WORST_FIRST.filter((status) => ALARMS[status] === "lost");
const KMH = 3.6; // of 1 m/s
const GUIDES = "tod-guides";
const RETURNED_MS = 1000; // a press within this time belongs to the return
const SETTLED_MS = 2500; // by then, pictures skipped while hidden no longer count

const STEERED_RAD = 0.6; // of the front wheels, at either end of the bar
const DEGREES = 180 / Math.PI;

const attention = new Attention();
let isFocused = document.hasFocus();
let returnedAt = -Infinity; // when the page was last shown again
let hiddenAt = -Infinity; // when the page was last hidden
const names = () => (store.hello?.cameras ?? []).map(({ name }) => name);
const isOnline = () => store.connected && store.state?.online;

function refresh() {
  refreshAlarms();
  if (store.view !== "drive") return;
  refreshLatency();
  refreshSpeed();
  refreshMotion();
  setText(byId("drive-vehicle"), store.hello?.vehicle ?? "");
  const parts = [MODES[mode() ?? ""] ?? "no mode", totalWords(), linkWords(), soundFault(), hearingFault()];
  setText(byId("line"), parts.filter(Boolean).join(" · "));
  showUplinks(byId("drive-uplinks"), isOnline() ? uplinkLines(store.state, store.sample) : []);
  fitPanels();
}

/** The worst latency of all pictures, in monitors as well. A picture that is not live has none, and is worse than any. */
function refreshLatency() {
  const { camera, age_ms, bound_ms, level } = worstOf([...ownPictures(), ...inMonitors()], store.hello?.late_ms ?? 0);
  const notLive = names().filter(isNotLive);
  const none = Object.values(store.status).includes("synchronising") ? "synchronising" : "no moving picture";
  const from = camera === null ? none : `${level === "unknown" ? "unknown" : "worst"}: ${displayName(camera)}${whereWords(camera, level)}`;
  setAttribute(byId("latency"), "data-level", notLive.length ? "late" : level);
  setText(byId("worst"), latency(age_ms, bound_ms));
  setText(byId("worst-of"), notLive.length ? `${notLive.length} of ${names().length} pictures not live` : from);
}

/** Where most of a high latency arises: a busy machine is not the link. */
function whereWords(camera, level) {
  if (!["near", "late"].includes(level)) return "";
  const most = mostOf({ ...store.sample?.cameras[camera]?.stages_ms, ...store.ages[camera]?.parts_ms });
  return most && ` (${most})`;
}

/** Pictures in monitors, which say where they are. */
const inMonitors = () => monitored().map((picture) => ({ ...picture, camera: inMonitor(picture.camera) }));
const inMonitor = (camera) => `${displayName(camera)} (monitor)`;

/** Whether a camera's picture is not live, here or in a monitor. */
function isNotLive(camera) {
  const shown = monitored().filter((other) => other.camera === camera).map(({ status }) => status);
  return [store.status[camera], ...shown].some((status) => NOT_LIVE.includes(alertStatus(camera, status)));
}

function refreshSpeed() {
  const speed_mps = isOnline() ? store.sample?.position?.speed_mps : undefined;
  const factor = isOnline() ? store.sample?.speed_factor : undefined;
  setText(byId("driven"), `${whole(KMH * (speed_mps ?? NaN))} km/h`);
  setText(byId("advised"), Number.isFinite(factor) ? `advised: ${whole(100 * (factor ?? 0))} % of full speed` : "no speed advised");
  const level = (factor ?? 1) < 1 ? "near" : Number.isFinite(speed_mps) ? "fine" : "none";
  setAttribute(byId("speed-now"), "data-level", factor === 0 ? "late" : level);
}

/** Gear, heading and steering, each once the vehicle has reported it. */
function refreshMotion() {
  const { heading_deg } = (isOnline() && store.sample?.position) || {};
  const { rad, gear } = (isOnline() && store.steering) || {};
  const shift = `${Math.round(100 * Math.max(-1, Math.min(1, -(rad ?? 0) / STEERED_RAD)))}%`;
  showFigure("heading", heading_deg === undefined ? null : headingText(heading_deg));
  showFigure("gear", gear ?? null);
  showFigure("steering", rad === undefined ? null : steeringText(rad));
  setAttribute(byId("steering-mark"), "style", `--shift: ${shift}`);
}

/** @param {string} name  @param {string|null} text null: unknown, which is shown of what was known before */
function showFigure(name, text) {
  if (text !== null) byId(`${name}-now`).hidden = false;
  setText(byId(name), text ?? "–");
}

/** @param {number} rad to the left */
function steeringText(rad) {
  const deg = Math.round(Math.abs(rad) * DEGREES);
  return deg ? `${deg}° ${rad > 0 ? "left" : "right"}` : "straight";
}

function totalWords() {
  const totals = isOnline() ? totalsOf(store.state) : null;
  return `${whole(totals?.total)}${ofWords(totals)} ${KBPS}${copiesWords(totals)}`;
}

/** The state of the connection, why nothing is sent, or what limits the total. */
function linkWords() {
  const fault = linkFault();
  if (fault) return fault;
  const [pause, reason] = [pauseReason(), limitReasons().filter((each) => !each.includes(": sound takes ")).at(-1)];
  if (pause) return pause;
  return reason ? `limited: ${limitWords(reason)}` : "connected";
}

/** The pictures that are not live, in monitors as well; of the page's own, in the Configure view, those that the enlarged one hides. */
function refreshAlarms() {
  showAlarms(byId("alarms"), names(), [...store.reminders.values()].map((text) => `▲ ${text}`));
  const hidden = store.enlarged ? names().filter((name) => name !== store.enlarged) : [];
  byId("hidden-alarms").hidden = store.view !== "configure" || !showAlarms(byId("hidden-alarms"), hidden);
}

/** Show pictures by status, FROZEN front left, rear (monitor), and further words. Returns whether there are any pictures. */
function showAlarms(element, cameras, further = []) {
  const all = WORST_FIRST.map((status) => ({ status, pictures: picturesOf(status, cameras) }));
  const found = all.filter(({ pictures }) => pictures.length);
  const texts = found.map(({ status, pictures }) => `${SHAPES[status]} ${WORDS[status] ?? status.toUpperCase()} ${pictures.join(", ")}`);
  setText(element, [...texts, ...further].join("  "));
  setAttribute(element, "data-level", found.some(({ status }) => NOT_LIVE.includes(status)) ? "late" : "near");
  return found.length > 0;
}

/** The pictures of a status: the page's of these cameras, and those in monitors that are worse than the page's of the same camera. */
function picturesOf(status, cameras) {
  const own = cameras.filter((name) => alertStatus(name) === status);
  const isListed = (other) => alertStatus(other.camera, other.status) === status && isWorse(status, alertStatus(other.camera));
  const others = monitored().filter(isListed);
  return [...own.map(displayName), ...new Set(others.map(({ camera }) => inMonitor(camera)))];
}

/** @param {string} status  @param {string|undefined} than */
const isWorse = (status, than) => !(than && than in ALARMS) || WORST_FIRST.indexOf(status) < WORST_FIRST.indexOf(than);

// --- lines on the ground ----------------------------------------------------------------------------------------------

/** @returns {import("./guides.js").Choice} */
const guidesChoice = () => /** @type {any} */ (localStorage.getItem(ofVehicle(GUIDES))) ?? "calibrated";
const placedCameras = () => (store.hello?.dimensions ? store.hello.cameras.filter(({ pose }) => pose) : []);

export function toggleGuides() {
  localStorage.setItem(ofVehicle(GUIDES), nextChoice(placedCameras(), guidesChoice()));
  refreshGuides();
}

function refreshGuides() {
  const cameras = placedCameras();
  const guided = store.view !== "configure" ? cameras.filter((camera) => isGuided(camera, guidesChoice())).map(({ name }) => name) : [];
  showLines(guided);
  byId("guides").hidden = !cameras.length;
  setText(byId("guides"), nextGuides(cameras, guided.length));
}

/** What the button does. @param {import("./store.js").Camera[]} cameras  @param {number} shown */
function nextGuides(cameras, shown) {
  const next = nextChoice(cameras, guidesChoice());
  const more = cameras.filter((camera) => isGuided(camera, next)).length;
  if (more <= shown) return "Hide guides";
  return shown ? "Show all guides" : "Show guides";
}

// --- the driver's attention -------------------------------------------------------------------------------------------

function updateAttention() {
  const { hidden } = document;
  if (hidden) hiddenAt = performance.now();
  const slow = store.slow && performance.now() - hiddenAt > SETTLED_MS;
  if (hidden && !attention.hidden && inControl()) publish("unseen");
  const { elsewhere, covered } = store;
  const message = attention.update({ hidden, focused: isFocused, elsewhere, covered, slow }, performance.now());
  const warning = warningText();
  byId("attention").hidden = warning === null;
  setText(byId("attention"), warning ?? "");
  reportAttention(attention.state, isFocused && !hidden);
  if (message && inControl()) onReturn(message);
}

/** The driver is back, and reminded to check the pictures until a press that came later than the one that brought the page back. */
function onReturn(message) {
  showProblem(message);
  if (attention.was_visible) return;
  remind("return", message);
  returnedAt = performance.now();
}

function onPress() {
  if (performance.now() - returnedAt > RETURNED_MS) remind("return", null);
}

const warningText = () => (inControl() ? attention.warning : controlWarning());

export function startDrive() {
  byId("guides").addEventListener("click", toggleGuides);
  byId("drive-help").addEventListener("click", () => publish("help"));
  addEventListener("blur", () => {
    isFocused = false;
    updateAttention();
  });
  addEventListener("focus", () => {
    isFocused = true;
    updateAttention();
  });
  document.addEventListener("visibilitychange", updateAttention);
  for (const kind of ["pointerdown", "keydown"]) addEventListener(kind, onPress, true);
  listen("hello state sample ages status monitored control socket requests view enlarged reminders sound", refresh);
  listen("control socket state view ages", updateAttention);
  listen("hello view", refreshGuides);
  addEventListener("storage", refreshGuides); // chosen in another window
  refresh();
}
