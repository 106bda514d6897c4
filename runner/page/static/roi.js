/** Choosing a region of interest by dragging a rectangle on the picture, in mode S. */

import { camera, decisionOf, inControl, listen, mode, publish } from "./store.js";
import { showCrop } from "./link.js";
import { pending, request, whyNoControl } from "./requests.js";
import { toBox, toPicture, visible } from "./framing.js";
import { withKey } from "./hints.js";
import { isStraight } from "./straighten.js";
import { inside, SMALLEST, withAspect } from "./region.js";
import { boxSize, make, sameRegion } from "./format.js";

const DRAG_START_PX = 6; // a click moves the pointer less than this
const ASPECT = "tod-roi-aspect";
const refreshers = new Map(); // by camera: shows the pending region
/** @type {Map<string, import("./framing.js").Rectangle>} */
const crops = new Map(); // by camera that is sent as it encodes: the part that this page shows, where that is not all
let croppedOf = ""; // vehicle of these cameras

/**
 * The region that is laid out on the screen: of a camera that only this page crops, as chosen here. If pictures say what they
 * show, it is the one that the operator has chosen, in which each has its place; otherwise they fill the box, and it is
 * theirs: as read back, or else as decided.
 */
export const shownRegion = (name) => {
  const now = decisionOf(name);
  if (!now) return null;
  if (camera(name)?.passed) return crops.get(name) ?? fullRegion(name);
  return now.chosen ?? (now.placed ? now.roi : (now.applied.roi ?? now.roi));
};

/** The region that the operator has chosen: of it, no more may be sent than is seen. */
export const chosenRegion = (name) => decisionOf(name)?.chosen ?? decisionOf(name)?.roi;

/** Whether a camera's region is this page's own: the camera sends its whole picture, whatever is chosen. */
export const isCropped = (name) => crops.has(name);

/** Whether dragged regions keep the full image's aspect ratio. */
export const isLocked = () => localStorage.getItem(ASPECT) === "locked";

export function toggleLocked() {
  localStorage.setItem(ASPECT, isLocked() ? "free" : "locked");
  publish("aspect");
}

/** A region of the full image from two corners in the box, in whole pixels, within the visible part and not too small. */
function regionOf(box, view, roi, full, a, b) {
  const corners = [a, b].map((corner) => toPicture(corner, boxSize(box), roi, view));
  const seen = visible(boxSize(box), roi, view);
  const along = (key, from, length, end) => {
    const sides = corners.map((corner) => roi[key] + corner[key]).sort((p, q) => p - q);
    return snap(sides, roi[key] + from, roi[key] + from + length, end);
  };
  const [x, width] = along("x", seen.x, seen.width, full.width);
  const [y, height] = along("y", seen.y, seen.height, full.height);
  if (!isLocked()) return { x, y, width, height };
  const towards = { right: corners[1].x >= corners[0].x, down: corners[1].y >= corners[0].y };
  return inside(withAspect({ x, y, width, height }, full.width / full.height, towards), full);
}

/** Whole numbers within the visible bounds; never smaller than the smallest, never outside the image. */
function snap(sides, low, high, end) {
  const [from, to] = sides;
  const start = Math.round(Math.max(low, Math.min(from, high - 1)));
  const stop = Math.round(Math.min(high, Math.max(to, low + 1)));
  const length = Math.max(SMALLEST, stop - start);
  return [Math.max(0, Math.min(start, end - length)), length];
}

/** Show a region: the vehicle sends it, or, of a camera that encodes by itself, this page crops the picture to it. */
export function sendRegion(name, roi) {
  if (camera(name)?.passed) return crop(name, roi);
  const { x, y, width, height } = roi;
  request(`roi:${name}`, { event: "roi_set", camera: name, x, y, width, height }, `ROI of ${name}`);
}

function crop(name, roi) {
  const { x, y, width, height } = roi;
  const part = sameRegion(roi, fullRegion(name)) ? null : { x, y, width, height };
  if (part) crops.set(name, part);
  else crops.delete(name);
  showCrop(name, part);
  publish("crop");
}

/** The worker may have new streams. */
function onHello({ vehicle, cameras }) {
  if (vehicle !== croppedOf) crops.clear();
  croppedOf = vehicle;
  for (const { name } of cameras) showCrop(name, crops.get(name) ?? null);
}

/** The full image of a camera. */
export function fullRegion(name) {
  const full = camera(name);
  if (!full) throw new Error(`no camera ${name}`);
  return { x: 0, y: 0, width: full.width, height: full.height };
}

/** Whether a camera is to send, or may still send, a part of its image only; or this page shows a part only. */
export function isPart(name) {
  if (isCropped(name)) return true;
  const [full, decided] = [fullRegion(name), chosenRegion(name)];
  return [decided, pendingRegion(name)].some((region) => region && !sameRegion(region, full));
}

export const AS_ENCODED = "it is sent as the camera encodes it; set size and bitrate in the camera";

/** Why a region cannot be chosen on a camera's picture; null: it can. */
export function whyNoRegion(name) {
  const isOwn = camera(name)?.passed; // the page crops it: nothing is requested
  if (!isOwn && !inControl()) return whyNoControl();
  const how = `${withKey("turn straightening off", "straighten")}, or type the numbers`;
  if (isStraight(name)) return `no ROI can be chosen on a straightened picture; ${how}`;
  return isOwn || mode() === "single" ? null : "the ROI is set in mode S; choose S to set it by hand";
}

/**
 * Let the operator drag a region on a box with a picture.
 * @param {string} name of the camera  @param {HTMLElement} box  @param {() => import("./framing.js").View} view
 */
export function dragRegion(name, box, view) {
  const rectangle = make("div", { class: "roi-drag", hidden: true });
  box.append(rectangle);
  let origin = null;
  let isDragging = false;

  const point = (event) => {
    const bounds = box.getBoundingClientRect();
    return { x: event.clientX - bounds.x, y: event.clientY - bounds.y };
  };
  const place = (roi) => {
    const seen = shownRegion(name);
    if (!seen) return;
    const shown = toBox({ ...roi, x: roi.x - seen.x, y: roi.y - seen.y }, boxSize(box), seen, view());
    Object.assign(rectangle.style, {
      left: `${shown.x}px`, top: `${shown.y}px`, width: `${shown.width}px`, height: `${shown.height}px`,
    });
    rectangle.hidden = false;
  };
  const region = (event) => regionOf(box, view(), shownRegion(name), fullRegion(name), origin, point(event));
  const end = () => {
    origin = null;
    isDragging = false;
    refresh();
  };
  const refresh = () => {
    if (isDragging) return;
    const wanted = pendingRegion(name);
    if (wanted && shownRegion(name) && !isStraight(name)) place(wanted);
    else rectangle.hidden = true;
  };

  box.addEventListener("pointerdown", (event) => {
    isDragging = false;
    if (!event.isPrimary) return end(); // a second finger: zoom.js
    origin = event.button === 0 && shownRegion(name) ? point(event) : null;
  });
  box.addEventListener("pointermove", (event) => {
    if (!origin || !event.isPrimary) return;
    if (!(event.buttons & 1) || !shownRegion(name)) return end(); // released elsewhere, or the vehicle is offline
    const here = point(event);
    if (!isDragging && Math.hypot(here.x - origin.x, here.y - origin.y) < DRAG_START_PX) return;
    if (!isDragging && whyNoRegion(name)) {
      publish("toast", { text: `${name}: ${whyNoRegion(name)}`, level: "hint" });
      return end();
    }
    isDragging = true;
    box.setPointerCapture(event.pointerId);
    place(region(event));
  });
  box.addEventListener("pointerup", (event) => {
    const chosen = isDragging && shownRegion(name) ? region(event) : null;
    end();
    if (chosen) sendRegion(name, chosen);
  });
  box.addEventListener("pointercancel", end);
  refreshers.set(name, refresh);
}

listen("hello", onHello);
listen("requests state straight crop", () => refreshers.forEach((refresh) => refresh()));

/**
 * The region that was requested or decided but that the picture does not show yet.
 * @returns {import("./framing.js").Rectangle|null}
 */
export function pendingRegion(name) {
  const requested = pending(`roi:${name}`)?.event;
  if (requested) return { x: requested.x, y: requested.y, width: requested.width, height: requested.height };
  const now = decisionOf(name);
  return now?.applied.roi && !now.chosen && !sameRegion(now.applied.roi, now.roi) ? now.roi : null;
}
