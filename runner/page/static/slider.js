/**
 * A slider and a number for one value in kbit/s. The thumb follows the hand; the value in force is shown beside it as a
 * mark and a number; after the vehicle's answer the thumb moves to the value in force.
 */

import { pending } from "./requests.js";
import { make, mark, whole, write } from "./format.js";
import { STEPS, throttle, toKbps, toStep } from "./scale.js";

const SEND_EVERY_MS = 200;
const HAND_MS = 400;

/**
 * @param {object} what label, data (value of data-control), id of the number, about() what the value is of, send(kbps, about),
 *   control() name of the request
 * @returns {{element, update({value, max, why}), reset()}}
 */
export function makeSlider({ label, data, id, about, send, control }) {
  const range = make("input", { type: "range", min: 0, max: STEPS, step: 1, "aria-label": `${label}, slider`, "data-control": `${data}-slider` });
  const number = make("input", { type: "number", min: 1, step: 1, id: id ?? false, "aria-label": `${label}, kbit/s`, "data-control": data });
  const tick = make("i", { class: "tick", "aria-hidden": "true" });
  const inForce = make("span", { class: "in-force" });
  const element = make("div", { class: "slider" }, make("div", { class: "track" }, range, tick), number, inForce);
  let max = 1;
  let edited = false;
  let touched = -Infinity;
  let held = false;

  const chosen = () => toKbps(+range.value, max);
  const wish = throttle((value) => send(value.kbps, value.about), SEND_EVERY_MS);
  range.addEventListener("pointerdown", () => (held = true));
  range.addEventListener("pointerup", () => (held = false));
  range.addEventListener("pointercancel", () => (held = false));
  range.addEventListener("input", () => {
    touched = performance.now();
    number.value = String(chosen());
    wish({ kbps: chosen(), about: about?.() }); // sent a moment later, when another camera may be selected
  });
  number.addEventListener("input", () => (edited = true));
  number.addEventListener("blur", () => (edited = false));
  number.addEventListener("change", () => {
    edited = false;
    if (number.value === "") return;
    const kbps = Math.max(1, Math.min(max, Math.round(+number.value)));
    range.value = String(toStep(kbps, max));
    send(kbps, about?.());
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
      tick.style.setProperty("--at", String(toStep(value || 1, max) / STEPS));
      write(inForce, asked ? `◌ now ${whole(value)}` : `now ${whole(value)}`);
      mark(range, "aria-valuetext", `${chosen()} kbit/s, in force ${whole(value)}`);
      if (held || asked || performance.now() - touched < HAND_MS) return;
      range.value = String(toStep(value || 1, max));
      if (!edited) number.value = Number.isFinite(value) ? String(Math.round(value)) : "";
    },
  };
}
