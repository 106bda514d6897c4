/** The header: vehicle, mode, totals, who is in control; and the banner when vehicle or station is offline. */

import { inControl, listen, mode, publish, store } from "./store.js";
import { complain, pending, request, whyNoControl } from "./requests.js";
import { send } from "./link.js";
import { MOVING } from "./status.js";
import { by, mark, spoken, whole, write } from "./format.js";

const START_MS = 800; // no alarm while the page is opening
const COMPARE_MS = 2000;
const UNKNOWN = "▲ Age of the pictures unknown: no capture times, or no answer from the vehicle's clock; LATE is not shown";
const HOLDERS = { you: "You are in control", another: "Another page is in control", nobody: "Nobody is in control" };

let compared = performance.now(); // when the clocks were last known to be compared, or could not be

const buttons = [...by("modes").querySelectorAll("button")];

/** Ask for another mode. The mode that the vehicle reports stays highlighted. */
export function selectMode(selected) {
  if (selected === mode() && !pending("mode")) return;
  request("mode", { event: "mode_selected", mode: selected }, `mode ${selected}`);
}

export function toggleControl() {
  if (!store.connected) return;
  if (store.view === "monitor") return complain("the page takes and releases control, not its monitors");
  if (store.holder === "you") return send({ release_control: true });
  if (store.holder === "nobody") return send({ take_control: true });
  write(by("confirm-text"), "Another page is in control of this vehicle. Take control from it?");
  by("confirm", HTMLDialogElement).showModal();
}

function refresh() {
  write(by("vehicle"), store.hello?.vehicle ?? "…");
  document.title = [...(globalThis.boot.shown ?? []).map(spoken), store.hello?.vehicle, "tod-runner"].filter(Boolean).join(" · ");
  refreshModes();
  refreshControl();
  refreshBanner();
}

function refreshModes() {
  const now = mode();
  const asked = pending("mode")?.event.mode;
  for (const button of buttons) {
    const own = button.dataset.mode;
    mark(button, "aria-checked", own === now);
    mark(button, "data-pending", own === asked ? "" : null);
    mark(button, "tabindex", own === (now ?? "single") ? 0 : -1);
    mark(button, "aria-disabled", inControl() && now ? null : "true");
  }
}

function refreshControl() {
  const button = by("take-control", HTMLButtonElement);
  write(by("holder"), store.connected ? HOLDERS[store.holder] : "");
  mark(by("holder"), "data-holder", store.holder);
  write(button, store.holder === "you" ? "Release" : "Take control");
  button.classList.toggle("strong", store.connected && store.holder !== "you");
  button.disabled = !store.connected;
  button.title = `${store.connected ? "take or release control (t)" : whyNoControl()}`;
}

function refreshBanner() {
  const away = store.connected ? store.state && !store.state.online : performance.now() > START_MS;
  const text = store.connected
    ? "VEHICLE OFFLINE: video is not live"
    : "NO CONNECTION TO THE STATION: video is not live; reconnecting";
  by("banner").hidden = !away;
  write(by("banner"), away ? `✕ ${text}` : "");
  const words = !store.connected ? "no station" : !store.state ? "no state yet" : away ? "vehicle offline" : "connected";
  write(by("connection"), `${words === "connected" ? "●" : "✕"} ${words}`);
  mark(by("connection"), "data-state", words === "connected" ? "fine" : "bad");
}

/** Warn once the difference of the clocks has been unknown for a while: it takes a moment to measure. */
function refreshWarning() {
  const online = store.connected && store.state?.online && store.sample;
  const moving = Object.entries(store.ages).filter(([name]) => MOVING.includes(store.status[name]));
  const known = moving.every(([, { age_ms, bound_ms }]) => Number.isFinite(age_ms) && Number.isFinite(bound_ms));
  if (!online || (known && Number.isFinite(store.sample?.clock_bound_ms))) compared = performance.now();
  by("warning").hidden = performance.now() - compared < COMPARE_MS;
  write(by("warning"), by("warning").hidden ? "" : UNKNOWN);
}

function refreshTotals() {
  refreshWarning();
  const current = store.connected && store.state?.online;
  for (const key of ["predicted", "allocated", "actual"]) write(by(key), whole(current ? store.sample?.[`${key}_kbps`] : NaN));
  const factor = current ? store.sample?.speed_factor : null;
  by("advice").hidden = !Number.isFinite(factor);
  write(by("speed"), `${whole(100 * (factor ?? 0))} %`);
}

function refreshSkew() {
  by("skew-total").hidden = store.skew_ms === null;
  write(by("skew"), `${whole(store.skew_ms)} ms`);
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
  by("modes").addEventListener("keydown", moveFocus);
  by("take-control").addEventListener("click", toggleControl);
  const confirm = by("confirm", HTMLDialogElement);
  confirm.addEventListener("close", () => {
    if (confirm.returnValue === "yes") send({ take_control: true });
    confirm.returnValue = "";
  });
  by("help-open").addEventListener("click", () => publish("help"));
  listen("hello state control requests socket", refresh);
  listen("sample socket state", refreshTotals);
  listen("ages", refreshSkew);
  setTimeout(refresh, START_MS + 50);
  refresh();
}
