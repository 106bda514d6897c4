/** Formatting of numbers, and small helpers for the page's elements. */

const WHOLE = new Intl.NumberFormat("en", { maximumFractionDigits: 0, useGrouping: false });

/** A whole number, "–" where unknown. */
export const whole = (value) => (Number.isFinite(value) ? WHOLE.format(value) : "–");

export const KBPS = "kbit/s"; // the unit of every bitrate on the page, as in configuration, events and log

/** A bitrate, or one of another: 1704 kbit/s, 1704 of 6000 kbit/s. */
export const rate = (...kbps) => `${kbps.map(whole).join(" of ")} ${KBPS}`;

/** To a tenth, "–" where unknown. Values below 0 are clock errors, and shown as 0. */
export const tenth = (value) => (Number.isFinite(value) ? Math.max(0, value).toFixed(1) : "–");

/** A factor in its shortest exact form: 0.25, 0.125. */
export const factor = (value) => (Number.isFinite(value) ? String(Math.round(value * 1e4) / 1e4) : "–");

/** Size of an element's contents, CSS px. To read it may lay out the page. @param {Element} element */
export const boxSize = ({ clientWidth: width, clientHeight: height }) => ({ width, height });

export const size = (width, height) => (width && height ? `${width}×${height}` : "–");

/** A latency in ms and its error bound: 48 ± 6 ms. */
export const latency = (ms, bound) =>
  Number.isFinite(ms) && Number.isFinite(bound) ? `${whole(ms)} ± ${whole(Math.ceil(bound))} ms` : "– ms";

export const region = (roi) => (roi ? `${size(roi.width, roi.height)} at ${roi.x}, ${roi.y}` : "–");

export const sameRegion = (a, b) => ["x", "y", "width", "height"].every((key) => a?.[key] === b?.[key]);

export const clockTime = (seconds) => new Date(seconds * 1000).toTimeString().slice(0, 8);

export const capital = (text) => text[0].toUpperCase() + text.slice(1);

/** A camera's name for display: front_left -> front left. */
export const displayName = (name) => name.replaceAll("_", " ");

/**
 * The page's element with an id.
 * @template {HTMLElement} [E=HTMLElement]
 * @param {string} id
 * @param {new () => E} [kind]
 * @returns {E}
 */
export function byId(id, kind) {
  const element = document.getElementById(id);
  if (!(element instanceof (kind ?? HTMLElement))) throw new Error(`index.html: no ${kind?.name ?? "element"} #${id}`);
  return /** @type {E} */ (element);
}

/**
 * An element: make("button", {class: "on", title: "..."}, "text", child).
 * Keys that begin with "on" are listeners; false and null leave an attribute out.
 * @template {keyof HTMLElementTagNameMap} K
 * @param {K} tag
 * @param {Record<string, any>} attributes
 * @param {(Node|string)[]} children
 * @returns {HTMLElementTagNameMap[K]}
 */
export function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [key, value] of Object.entries(attributes)) {
    if (key.startsWith("on")) element.addEventListener(key.slice(2), value);
    else if (value !== false && value !== null) element.setAttribute(key, value === true ? "" : value);
  }
  element.append(...children);
  return element;
}

/** Place an element, px of its container. @param {HTMLElement} element  @param {import("./arrange.js").Box} box */
export function setBox({ style }, { x, y, width, height }) {
  Object.assign(style, { left: `${x}px`, top: `${y}px`, width: `${width}px`, height: `${height}px` });
}

/** Set the text only if it differs: the page is updated four times a second, mostly with unchanged values. */
export function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** Have a screen reader speak a text, also one that it has just spoken: it speaks what is added. @param {string} text */
export const announce = (text) => byId("announcer").replaceChildren(make("span", {}, text));

/** Set or remove an attribute, only if it differs. Those of ARIA state false, too. */
export function setAttribute(element, name, value) {
  const isAbsent = value === null || value === undefined || (value === false && !name.startsWith("aria-"));
  const text = isAbsent ? null : String(value);
  if (element.getAttribute(name) === text) return;
  if (text === null) element.removeAttribute(name);
  else element.setAttribute(name, text);
}
