/** The header: vehicle, mode, totals and control; and the banner when vehicle or station is offline. */

import { inControl, listen, mode, otherOperator, publish, store } from "./store.js";
import { pending, reportProblem, request, showProblem, whyNoControl } from "./requests.js";
import { send } from "./link.js";
import { withKey } from "./hints.js";
import { Hearing, Holding } from "./holding.js";
import { MOVING } from "./status.js";
import { byId, displayName, setAttribute, setText, whole } from "./format.js";

const START_MS = 800; // no alarm while the page is opening
const GRACE_MS = 2000; // of a warning
const UNKNOWN = "▲ Latency unknown: no capture times, or no answer from the vehicle's clock; LATE covers only the time since arrival here";
const UNMEASURED = "▲ No measurements from the station: speed, advised speed and bitrates are unknown";
const HOLDERS = { you: "You are in control", another: "Another page is in control", nobody: "Nobody is in control" };
const UNHEARD = "the vehicle receives nothing from this station";

let clockKnownAt = performance.now(); // when the clock offset was last known, or could not be measured

let sampledAt = performance.now(); // when a sample was last known, or none was due
let wasSampled = false; // whether any has arrived
let wasOperator = false; // whether the vehicle had this page's operator in control

export const holding = new Holding();
const hearing = new Hearing();
const buttons = [...byId("modes").querySelectorAll("button")];

/** Request another mode. The mode that the vehicle reports stays highlighted. */
export function selectMode(selected) {
  if (selected === mode() && !pending("mode")) return;
  request("mode", { event: "mode_selected", mode: selected }, `mode ${selected}`);
}

/**
 * This page has lost control without releasing it: the driver must know, and other pages may drive. A monitor shares its
 * page's control.
 */
function onControl() {
  if (store.view === "monitor" && store.holder === "nobody" && !store.abandoned) holding.onRelease(); // its page has released it
  const isLost = holding.update(store.holder);
  if (holding.isReleasing) send({ release_control: true }); // the first one may have been lost with its connection
  if (isLost) reportLoss(HOLDERS[store.holder].toLowerCase());
}

/** While this page is in control of its station, the vehicle may have passed control to another operator. */
function watchOperator() {
  if (!inControl() || store.view === "monitor" || !store.state?.online || !store.state.operator) return;
  const other = otherOperator();
  if (other && wasOperator) reportLoss(`operator ${other} is in control`);
  wasOperator = other === null;
}

function watchHearing() {
  const isLost = hearing.update(store.connected ? store.state : null, performance.now());
  if (isLost && inControl() && store.view !== "monitor") reportLoss(UNHEARD);
  refreshControl();
  refreshConnection();
}

/** Why this page does not control the vehicle, although it is in control of its station; null: it does. */
export function whyNotInControl() {
  const other = otherOperator();
  return other ? `operator ${other} is in control` : hearing.isLost ? UNHEARD : null;
}

function reportLoss(why) {
  reportProblem(`CONTROL LOST: ${why}`);
  publish("deposed");
}

export function toggleControl() {
  if (!store.connected) return;
  if (store.view === "monitor") return showProblem("only the page can take or release control, not its monitors");
  if (store.holder === "you") {
    holding.onRelease();
    return send({ release_control: true });
  }
  holding.onTake();
  if (store.holder === "nobody") return send({ take_control: true });
  setText(byId("confirm-text"), "Another page is in control of this vehicle. Take control from it?");
  byId("confirm", HTMLDialogElement).showModal();
}

function refresh() {
  setText(byId("vehicle"), store.hello?.vehicle ?? "…");
  document.title = [...(globalThis.boot.shown ?? []).map(displayName), store.hello?.vehicle, "tod-runner"].filter(Boolean).join(" · ");
  refreshModes();
  refreshControl();
  refreshBanner();
  refreshConnection();
}

function refreshModes() {
  const now = mode();
  const requested = pending("mode")?.event.mode;
  for (const button of buttons) {
    const own = button.dataset.mode;
    setAttribute(button, "aria-checked", own === now);
    setAttribute(button, "data-pending", own === requested ? "" : null);
    setAttribute(button, "tabindex", own === (now ?? "single") ? 0 : -1);
    setAttribute(button, "aria-disabled", inControl() && now ? null : "true");
  }
}

function refreshControl() {
  const button = byId("take-control", HTMLButtonElement);
  const other = otherOperator();
  const isUnheard = store.holder === "you" && hearing.isLost;
  const own = isUnheard ? "Vehicle does not receive you" : HOLDERS[store.holder];
  setText(byId("holder"), !store.connected ? "" : other ? `Operator ${other} is in control` : own);
  setAttribute(byId("holder"), "data-holder", other || isUnheard ? "another" : store.holder);
  setText(button, store.holder === "you" ? "Release" : "Take control");
  button.classList.toggle("strong", store.connected && store.holder !== "you");
  button.disabled = !store.connected;
  button.title = store.connected ? withKey("take or release control", "control") : whyNoControl();
}

function refreshBanner() {
  const isOffline = store.connected ? store.state && !store.state.online : performance.now() > START_MS;
  const why = store.hung
    ? "VIDEO STOPPED: the page's worker does not respond; reload the page"
    : "NO CONNECTION TO THE STATION: video is not live; reconnecting";
  const offline = store.link.fault ? `VIDEO IS NOT LIVE: ${store.link.fault}` : "VEHICLE OFFLINE: video is not live";
  const text = store.connected ? offline : why;
  byId("banner").hidden = !isOffline;
  setText(byId("banner"), isOffline ? `✕ ${text}` : "");
}

/** What is wrong with the connection to the vehicle; null: nothing. */
export function linkFault() {
  if (!store.connected) return store.hung ? "video stopped" : "station unreachable";
  if (!store.state) return "no state yet";
  if (!store.state.online) return store.link.fault ? "no control link" : "vehicle offline";
  return hearing.isLost ? "vehicle receives nothing" : null;
}

function refreshConnection() {
  const fault = linkFault();
  setText(byId("connection"), fault ? `✕ ${fault}` : "● connected");
  setAttribute(byId("connection"), "data-state", fault ? "bad" : "fine");
}

/** Warn once samples have ceased, or the clock offset has been unknown for a while: measuring it takes time. */
function refreshWarning() {
  const now = performance.now();
  const isOnline = store.connected && store.state?.online;
  wasSampled ||= store.sample !== null;
  if (!isOnline || store.sample || !wasSampled) sampledAt = now;
  if (!isOnline || !store.sample || isClockKnown()) clockKnownAt = now;
  const warning = now - sampledAt >= GRACE_MS ? UNMEASURED : now - clockKnownAt >= GRACE_MS ? UNKNOWN : expiryText();
  byId("warning").hidden = !warning;
  setText(byId("warning"), warning);
}

const expiryText = () => (store.connected && store.link.expiring.length ? `▲ Renew the keys: ${store.link.expiring.join("; ")}` : "");

function isClockKnown() {
  const moving = Object.entries(store.ages).filter(([name]) => MOVING.includes(store.status[name]));
  const known = moving.every(([, { age_ms, bound_ms }]) => Number.isFinite(age_ms) && Number.isFinite(bound_ms));
  return known && Number.isFinite(store.sample?.clock_bound_ms);
}

function refreshTotals() {
  refreshWarning();
  const current = store.connected && store.state?.online;
  for (const key of ["predicted", "allocated", "actual"]) setText(byId(key), whole(current ? store.sample?.[`${key}_kbps`] : NaN));
  const factor = current ? store.sample?.speed_factor : null;
  byId("advice").hidden = !Number.isFinite(factor);
  setText(byId("speed"), `${whole(100 * (factor ?? 0))} %`);
}

function refreshSkew() {
  byId("skew-total").hidden = store.skew_ms === null;
  setText(byId("skew"), `${whole(store.skew_ms)} ms`);
}

function moveFocus(event) {
  const step = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[event.key];
  if (!step) return;
  event.preventDefault();
  const at = buttons.findIndex((button) => button === document.activeElement);
  buttons[(at + step + buttons.length) % buttons.length].focus();
}

export function startHeader() {
  for (const button of buttons) button.addEventListener("click", () => selectMode(button.dataset.mode));
  byId("modes").addEventListener("keydown", moveFocus);
  byId("take-control").addEventListener("click", toggleControl);
  const confirm = byId("confirm", HTMLDialogElement);
  confirm.addEventListener("close", () => {
    if (confirm.returnValue === "yes") send({ take_control: true });
    confirm.returnValue = "";
  });
  byId("help-open").addEventListener("click", () => publish("help"));
  listen("control", onControl);
  listen("control state", watchOperator);
  listen("state socket ages", watchHearing);
  listen("hello state link control requests socket", refresh);
  listen("link", refreshWarning);
  listen("sample socket state", refreshTotals);
  listen("ages", refreshWarning);
  listen("ages", refreshSkew);
  setTimeout(refresh, START_MS + 50);
  refresh();
}
