/**
 * A slider and a number field for one value in kbit/s. The thumb follows the pointer; a tick and a number next to it show
 * the value in force, to which the thumb moves after the vehicle's answer.
 */

import { pending } from "./requests.js";
import { KBPS, make, rate, setAttribute, setText, whole } from "./format.js";
import { STEPS, throttle, toKbps, toStep } from "./scale.js";

const SEND_EVERY_MS = 200;
const HAND_MS = 400;

/**
 * @param {object} options label, data (value of data-control), id of the number field, target() of the value, send(kbps, target),
 *   control() name of the request
 * @returns {{element: HTMLElement, update: (now: {value: any, inForce?: any, max: any, why: any}) => void, reset: () => void}}
 *   value: as set; inForce: what rules have left of it
 */
export function makeSlider({ label, data, id, target, send, control }) {
  const named = (what, key) => ({ "aria-label": `${label}, ${what}`, "data-control": key });
  const range = make("input", { type: "range", min: 0, max: STEPS, step: 1, ...named("slider", `${data}-slider`) });
  const number = make("input", { type: "number", min: 1, step: 1, id: id ?? false, ...named(KBPS, data) });
  const tick = make("i", { class: "tick", "aria-hidden": "true" });
  const words = make("span", { class: "in-force" });
  const element = make("div", { class: "slider" }, make("div", { class: "track" }, range, tick), number, words);
  let max = 1;
  let isEdited = false;
  let touchedAt = -Infinity;
  let isHeld = false;
  let shown = ""; // value in force

  const chosen = () => toKbps(+range.value, max);
  const sendSoon = throttle((value) => send(value.kbps, value.target), SEND_EVERY_MS);
  range.addEventListener("pointerdown", () => (isHeld = true));
  range.addEventListener("pointerup", () => {
    isHeld = false;
    range.blur(); // arrow keys select cameras again
  });
  range.addEventListener("pointercancel", () => (isHeld = false));
  range.addEventListener("input", () => {
    touchedAt = performance.now();
    number.value = String(chosen());
    sendSoon({ kbps: chosen(), target: target?.() }); // by the time it is sent, another camera may be selected
  });
  number.addEventListener("input", () => (isEdited = true));
  number.addEventListener("blur", () => (isEdited = false));
  number.addEventListener("revert", () => (number.value = shown));
  number.addEventListener("change", () => {
    isEdited = false;
    if (number.value === "") return;
    const kbps = Math.max(1, Math.min(max, Math.round(+number.value)));
    range.value = String(toStep(kbps, max));
    send(kbps, target?.());
  });

  return {
    element,
    reset: () => (isEdited = isHeld = false),
    update({ value, inForce = value, max: limit, why }) {
      max = limit || 1;
      shown = Number.isFinite(value) ? String(Math.round(value)) : "";
      setAttribute(number, "max", max);
      range.disabled = number.disabled = Boolean(why);
      range.title = number.title = why ?? "";
      const isPending = Boolean(pending(control()));
      setAttribute(element, "data-pending", isPending ? "" : null);
      tick.hidden = !Number.isFinite(inForce);
      tick.style.setProperty("--at", String(toStep(inForce || 1, max) / STEPS));
      setText(words, isPending ? `◌ now ${whole(inForce)}` : `now ${whole(inForce)}`);
      setAttribute(range, "aria-valuetext", `${rate(chosen())}, in force ${whole(inForce)}`);
      if (isHeld || isPending || performance.now() - touchedAt < HAND_MS) return;
      range.value = String(toStep(value || 1, max));
      if (!isEdited) number.value = shown;
    },
  };
}
