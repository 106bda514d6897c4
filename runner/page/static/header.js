/** The header: vehicle, mode and totals; and the banner when vehicle or station is offline. */

import { inControl, listen, mode, publish, store } from "./store.js";
import { pending, request } from "./requests.js";
import { isUnheard } from "./control.js";
import { MOVING } from "./status.js";
import { byId, displayName, setAttribute, setText, whole } from "./format.js";

const START_MS = 800; // no alarm while the page is opening
const GRACE_MS = 2000; // of a warning
const UNKNOWN = "▲ Latency unknown: no capture times, or no answer from the vehicle's clock; LATE covers only the time since arrival here";
const ENDED = "○ The station has ended: no video. This page looks for it, and connects once it runs again";
const UNMEASURED = "▲ No measurements from the station: speed, advised speed and bitrates are unknown";

let clockKnownAt = performance.now(); // when the clock offset was last known, or could not be measured

let sampledAt = performance.now(); // when a sample was last known, or none was due
let wasSampled = false; // whether any has arrived

const buttons = [...byId("modes").querySelectorAll("button")];

/** Request another mode. The mode that the vehicle reports stays highlighted. */
export function selectMode(selected) {
  if (selected === mode() && !pending("mode")) return;
  request("mode", { event: "mode_selected", mode: selected }, `mode ${selected}`);
}

function refresh() {
  setText(byId("vehicle"), store.hello?.vehicle ?? "…");
  document.title = [...(globalThis.boot.shown ?? []).map(displayName), store.hello?.vehicle, "tod-runner"].filter(Boolean).join(" · ");
  document.body.style.setProperty("--vehicle", JSON.stringify(store.hello ? `${store.hello.vehicle}: ` : ""));
  refreshModes();
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

function refreshBanner() {
  const isOffline = store.connected ? store.state && !store.state.online : performance.now() > START_MS;
  const why = store.hung
    ? "VIDEO STOPPED: the page's worker does not respond; reload the page"
    : "NO CONNECTION TO THE STATION: video is not live; reconnecting";
  const gone = store.ended && !store.hung ? ENDED : `✕ ${why}`;
  const offline = store.link.fault ? `VIDEO IS NOT LIVE: ${store.link.fault}` : "VEHICLE OFFLINE: video is not live";
  byId("banner").hidden = !isOffline;
  setAttribute(byId("banner"), "data-level", gone === ENDED && !store.connected ? "ended" : null);
  setText(byId("banner"), isOffline ? (store.connected ? `✕ ${offline}` : gone) : "");
}

/** What is wrong with the connection to the vehicle; null: nothing. */
export function linkFault() {
  if (!store.connected) return store.hung ? "video stopped" : store.ended ? "station has ended" : "station unreachable";
  if (!store.state) return "no state yet";
  if (!store.state.online) return store.link.fault ? "no control link" : "vehicle offline";
  return isUnheard() ? "vehicle receives nothing" : null;
}

function refreshConnection() {
  const fault = linkFault();
  const state = !fault ? "fine" : store.ended && !store.hung ? "ended" : "bad";
  setText(byId("connection"), fault ? `${state === "ended" ? "○" : "✕"} ${fault}` : "● connected");
  setAttribute(byId("connection"), "data-state", state);
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
  byId("help-open").addEventListener("click", () => publish("help"));
  listen("hello state link control requests socket", refresh);
  listen("link", refreshWarning);
  listen("sample socket state", refreshTotals);
  listen("ages", refreshWarning);
  listen("ages", refreshConnection);
  listen("ages", refreshSkew);
  setTimeout(refresh, START_MS + 50);
  refresh();
}
