/**
 * A slider and a number for one value in kbit/s. The thumb follows the hand; the value in force stands beside it as a
 * mark and a number; after the vehicle's answer the thumb goes to the value in force.
 */

import { pending } from "./requests.js";
import { make, mark, whole, write } from "./format.js";

const STEPS = 1000;
const SPAN = 200; // the right end over the left end; rates below are set by number
const SEND_EVERY_MS = 200;
const HAND_MS = 400;

/**
 * @param {object} what label, data (value of data-control), id of the number, send(kbps), control() name of the request
 * @returns {{element, update({value, max, why}), reset()}}
 */
export function makeSlider({ label, data, id, send, control }) {
  const range = make("input", { type: "range", min: 0, max: STEPS, step: 1, "aria-label": `${label}, slider`, "data-control": `${data}-slider` });
  const number = make("input", { type: "number", min: 1, step: 1, id: id ?? false, "aria-label": `${label}, kbit/s`, "data-control": data });
  const tick = make("i", { class: "tick", "aria-hidden": "true" });
  const inForce = make("span", { class: "in-force" });
  const element = make("div", { class: "slider" }, make("div", { class: "track" }, range, tick), number, inForce);
  let max = 1;
  let edited = false;
  let touched = -Infinity;
  let held = false;

  // Even steps are even ratios: a little matters much at low rates, and no key press goes from plenty to nothing.
  const toKbps = (step) => Math.max(1, Math.round(max * SPAN ** (step / STEPS - 1)));
  const toStep = (kbps) => Math.round(STEPS * Math.min(1, Math.max(0, 1 + Math.log(kbps / max) / Math.log(SPAN))));

  const wish = throttle(send, SEND_EVERY_MS);
  range.addEventListener("pointerdown", () => (held = true));
  range.addEventListener("pointerup", () => (held = false));
  range.addEventListener("pointercancel", () => (held = false));
  range.addEventListener("input", () => {
    touched = performance.now();
    number.value = toKbps(+range.value);
    wish(toKbps(+range.value));
  });
  number.addEventListener("input", () => (edited = true));
  number.addEventListener("blur", () => (edited = false));
  number.addEventListener("change", () => {
    edited = false;
    if (number.value === "") return;
    const kbps = Math.max(1, Math.min(max, Math.round(+number.value)));
    range.value = toStep(kbps);
    send(kbps);
  });

  return {
    element,
    reset: () => (edited = held = false),
    update({ value, max: most, why }) {
      max = most || 1;
      mark(number, "max", max);
      range.disabled = number.disabled = Boolean(why);
      range.title = number.title = why ?? "";
      const asked = pending(control());
      mark(element, "data-pending", asked ? "" : null);
      tick.hidden = !Number.isFinite(value);
      tick.style.setProperty("--at", toStep(value || 1) / STEPS);
      write(inForce, asked ? `◌ now ${whole(value)}` : `now ${whole(value)}`);
      mark(range, "aria-valuetext", `${toKbps(+range.value)} kbit/s, in force ${whole(value)}`);
      if (held || asked || performance.now() - touched < HAND_MS) return;
      range.value = toStep(value || 1);
      if (!edited) number.value = Number.isFinite(value) ? Math.round(value) : "";
    },
  };
}

/** Call at once, then at most every `wait` ms; the last value is always sent. */
function throttle(call, wait) {
  let timer = null;
  let next = null;
  const again = () => {
    timer = null;
    if (next === null) return;
    const value = next;
    next = null;
    timer = setTimeout(again, wait);
    call(value);
  };
  return (value) => {
    next = value;
    if (timer === null) again();
  };
}
