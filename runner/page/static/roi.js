/** Choosing a region of interest by dragging a rectangle on the picture, in mode S. */

import { camera, decided, inControl, listen, mode, publish } from "./store.js";
import { pending, request, whyNoControl } from "./requests.js";
import { toBox, toPicture, visible } from "./framing.js";
import { isStraight } from "./straighten.js";
import { inside, SMALLEST, withAspect } from "./region.js";
import { make, sameRegion } from "./format.js";

const START_PX = 6; // the pointer moves less than this in a click
const ASPECT = "tod-roi-aspect";
const views = new Map(); // by camera: shows the region that is pending

/** The region on the picture: the one read back, otherwise the one decided. */
export const seenRegion = (name) => {
  const now = decided(name);
  return now?.applied.roi ?? now?.roi ?? null;
};

/** Whether a region that is dragged has the full image's aspect ratio. */
export const isLocked = () => localStorage.getItem(ASPECT) === "locked";

export function toggleLocked() {
  localStorage.setItem(ASPECT, isLocked() ? "free" : "locked");
  publish("aspect");
}

const sizeOf = ({ clientWidth: width, clientHeight: height }) => ({ width, height });

/** A region of the full image from two corners on the box, in whole pixels, inside what is visible and not too small. */
function regionOf(box, view, roi, full, a, b) {
  const corners = [a, b].map((corner) => toPicture(corner, sizeOf(box), roi, view));
  const seen = visible(sizeOf(box), roi, view);
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

export function sendRegion(name, roi) {
  const { x, y, width, height } = roi;
  request(`roi:${name}`, { event: "roi_set", camera: name, x, y, width, height }, `ROI of ${name}`);
}

/** The whole image of a camera of the vehicle. */
export function fullRegion(name) {
  const full = camera(name);
  if (!full) throw new Error(`no camera ${name}`);
  return { x: 0, y: 0, width: full.width, height: full.height };
}

/** Why a region cannot be chosen on a camera's picture; null: it can. */
export function whyNoRegion(name) {
  if (!inControl()) return whyNoControl();
  if (isStraight(name)) return "no ROI can be chosen on a straightened picture; straighten it no longer (l), or type its numbers";
  return mode() === "single" ? null : "the ROI is set in mode S; choose S to set it by hand";
}

/**
 * Let the operator drag a region on a box with a picture.
 * @param {string} name of the camera  @param {HTMLElement} box  @param {() => import("./framing.js").View} view
 */
export function dragRegion(name, box, view) {
  const rectangle = make("div", { class: "roi-drag", hidden: true });
  box.append(rectangle);
  let from = null;
  let dragging = false;

  const point = (event) => {
    const bounds = box.getBoundingClientRect();
    return { x: event.clientX - bounds.x, y: event.clientY - bounds.y };
  };
  const place = (roi) => {
    const seen = seenRegion(name);
    if (!seen) return;
    const shown = toBox({ ...roi, x: roi.x - seen.x, y: roi.y - seen.y }, sizeOf(box), seen, view());
    Object.assign(rectangle.style, {
      left: `${shown.x}px`, top: `${shown.y}px`, width: `${shown.width}px`, height: `${shown.height}px`,
    });
    rectangle.hidden = false;
  };
  const region = (event) => regionOf(box, view(), seenRegion(name), fullRegion(name), from, point(event));
  const end = () => {
    from = null;
    dragging = false;
    refresh();
  };
  const refresh = () => {
    if (dragging) return;
    const wish = waiting(name);
    if (wish && seenRegion(name) && !isStraight(name)) place(wish);
    else rectangle.hidden = true;
  };

  box.addEventListener("pointerdown", (event) => {
    dragging = false;
    if (!event.isPrimary) return end(); // a second finger: zoom.js
    from = event.button === 0 && seenRegion(name) ? point(event) : null;
  });
  box.addEventListener("pointermove", (event) => {
    if (!from || !event.isPrimary) return;
    if (!(event.buttons & 1) || !seenRegion(name)) return end(); // released elsewhere, or the vehicle is offline
    const here = point(event);
    if (!dragging && Math.hypot(here.x - from.x, here.y - from.y) < START_PX) return;
    if (!dragging && whyNoRegion(name)) {
      publish("toast", { text: `${name}: ${whyNoRegion(name)}`, level: "hint" });
      return end();
    }
    dragging = true;
    box.setPointerCapture(event.pointerId);
    place(region(event));
  });
  box.addEventListener("pointerup", (event) => {
    const wish = dragging && seenRegion(name) ? region(event) : null;
    end();
    if (wish) sendRegion(name, wish);
  });
  box.addEventListener("pointercancel", end);
  views.set(name, refresh);
}

listen("requests state straight", () => views.forEach((refresh) => refresh()));

/**
 * The region that was requested or decided, and is not yet the one on the picture.
 * @returns {import("./framing.js").Rectangle|null}
 */
export function waiting(name) {
  const asked = pending(`roi:${name}`)?.event;
  if (asked) return { x: asked.x, y: asked.y, width: asked.width, height: asked.height };
  const now = decided(name);
  return now?.applied.roi && !sameRegion(now.applied.roi, now.roi) ? now.roi : null;
}
