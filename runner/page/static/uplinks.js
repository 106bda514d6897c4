/** A line for each of several uplinks: what it may carry, what arrives over it, its queue and loss, and its cameras. */

import { displayName, KBPS, make, setAttribute, setText, whole } from "./format.js";

const UNBROKEN = "\u00a0"; // a line breaks elsewhere

/**
 * @typedef {{text: string, title: string, isStalled: boolean}} Line
 * @param {import("./records.js").VehicleState|null|undefined} state
 * @param {import("./records.js").Sample|null|undefined} sample
 * @returns {Line[]} none if the vehicle has one uplink, or is offline
 */
export function uplinkLines(state, sample) {
  if (!state?.online) return [];
  return Object.entries(state.uplinks ?? {}).map(([name, { total_kbps, stalled, reason }]) => {
    const measured = sample?.uplinks?.[name];
    const isStalled = stalled || measured?.state === "stalled";
    const cameras = Object.keys(state.cameras).filter((camera) => state.cameras[camera].uplinks?.includes(name));
    const isAll = cameras.length > 1 && cameras.length === Object.keys(state.cameras).length;
    const carries = isAll ? "all cameras" : cameras.map(displayName).join(", ") || "no camera";
    const carried = `${whole(measured?.kbps)} of ${whole(total_kbps)}${UNBROKEN}${KBPS}`;
    const what = isStalled ? "STALLED" : `${carried}, ${measuredWords(measured)}`;
    const text = `${isStalled ? "✕ " : ""}${name}: ${what}: ${carries}`;
    return { text, title: titled(isStalled ? "nothing arrives" : reason), isStalled };
  });
}

const measuredWords = (measured) => `${whole(measured?.queue_ms)}${UNBROKEN}ms, ${whole(100 * measured?.loss)}${UNBROKEN}% lost`;
const titled = (why) => ["Uplink: received, with packet headers, of allowed; queue, loss, cameras", why].filter(Boolean).join("; ");

/** Show the lines in an element, which is hidden while there are none. @param {HTMLElement} element  @param {Line[]} lines */
export function showUplinks(element, lines) {
  element.hidden = !lines.length;
  while (element.children.length > lines.length) element.lastElementChild?.remove();
  while (element.children.length < lines.length) element.append(make("p", { class: "uplink" }));
  for (const [number, { text, title, isStalled }] of lines.entries()) {
    const line = element.children[number];
    setText(line, text);
    setAttribute(line, "title", title);
    setAttribute(line, "data-stalled", isStalled ? "" : null);
  }
}
