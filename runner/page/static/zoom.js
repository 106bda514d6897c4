/** Zooming and moving the region of interest in mode S: wheel, pinch of two fingers, middle button. */

import { boxSize } from "./format.js";
import { camera, publish } from "./store.js";
import { placement, toPicture } from "./framing.js";
import { moved, zoomed } from "./region.js";
import { pendingRegion, sendRegion, shownRegion, whyNoRegion } from "./roi.js";
import { throttle } from "./scale.js";

const SEND_EVERY_MS = 250; // each new region restarts the encoder
const REST_MS = 600; // after this pause the wheel starts again from the region in force
const TURN = 0.002; // of the wheel, exponent of e per px
const PINCH = 0.01; // of two fingers on a touchpad, which browsers report as a wheel with Control
const LINE_PX = 16;
const HINT_EVERY_MS = 3000;
const MIDDLE = 1;

/** @typedef {import("./framing.js").Rectangle} Rectangle */

/**
 * Let the operator zoom and move the region on a box with a picture.
 * @param {string} name of the camera  @param {HTMLElement} box  @param {() => import("./framing.js").View} view
 */
export function zoomRegion(name, box, view) {
  const send = throttle((region) => sendRegion(name, region), SEND_EVERY_MS);
  /** @type {{region: Rectangle, at: number}|null} */
  let wheelRegion = null; // requested by the wheel
  /** @type {Map<number, {x: number, y: number}>} */
  const fingers = new Map();
  /** @type {{region: Rectangle, seen: Rectangle, from: {x: number, y: number}, distance: number}|null} */
  let gesture = null; // how a pinch or drag began
  let hinted = -Infinity;

  const size = () => boxSize(box);
  const positionOf = ({ clientX, clientY }) => ({ x: clientX - box.getBoundingClientRect().x, y: clientY - box.getBoundingClientRect().y });

  /** The region requested, shown or in force; null: it may not be changed. */
  function current() {
    const why = shownRegion(name) ? whyNoRegion(name) : null;
    if (why && performance.now() - hinted > HINT_EVERY_MS) {
      publish("toast", { text: `${name}: ${why}`, level: "hint" });
      hinted = performance.now();
    }
    return why ? null : (pendingRegion(name) ?? shownRegion(name));
  }

  /** A point of the full image. @param {Rectangle} seen what the box shows of it */
  function imagePoint(point, seen) {
    const { x, y } = toPicture(point, size(), seen, view());
    return { x: seen.x + x, y: seen.y + y };
  }

  function onWheel(event) {
    event.preventDefault();
    const wheeled = wheelRegion && performance.now() - wheelRegion.at < REST_MS ? wheelRegion.region : null;
    const [region, seen] = [wheeled ?? current(), shownRegion(name)];
    const full = camera(name);
    if (!region || !seen || !full) return;
    const px = event.deltaY * (event.deltaMode === WheelEvent.DOM_DELTA_LINE ? LINE_PX : 1);
    const factor = Math.exp(px * (event.ctrlKey ? PINCH : TURN));
    wheelRegion = { region: zoomed(region, imagePoint(positionOf(event), seen), factor, full), at: performance.now() };
    send(wheelRegion.region);
  }

  const centre = () => {
    const points = [...fingers.values()];
    return { x: points.reduce((sum, { x }) => sum + x, 0) / points.length, y: points.reduce((sum, { y }) => sum + y, 0) / points.length };
  };
  const fingerDistance = () => {
    const [a, b] = fingers.values();
    return b ? Math.hypot(a.x - b.x, a.y - b.y) : 1;
  };

  function beginGesture() {
    const [region, seen] = [current(), shownRegion(name)];
    gesture = region && seen ? { region, seen, from: centre(), distance: fingerDistance() } : null;
  }

  function onPointerMove(event) {
    if (!fingers.has(event.pointerId)) return;
    fingers.set(event.pointerId, positionOf(event));
    const full = camera(name);
    if (!gesture || !full) return;
    const { region, seen, from } = gesture;
    const [factor, { scale }] = [gesture.distance / Math.max(1, fingerDistance()), placement(size(), seen, view())];
    const larger = zoomed(region, imagePoint(from, seen), factor, full);
    const side = view().mirrored ? 1 : -1;
    const [x, y] = [(side * (centre().x - from.x) * factor) / scale, (-(centre().y - from.y) * factor) / scale];
    const offset = { x, y };
    send(moved(larger, offset, full));
  }

  box.addEventListener("wheel", onWheel, { passive: false });
  box.addEventListener("mousedown", (event) => event.button === MIDDLE && event.preventDefault()); // the browser would scroll
  box.addEventListener("pointerdown", (event) => {
    if (event.pointerType !== "touch" && event.button !== MIDDLE) return;
    fingers.set(event.pointerId, positionOf(event));
    box.setPointerCapture(event.pointerId);
    if (event.button === MIDDLE || fingers.size === 2) beginGesture();
  });
  box.addEventListener("pointermove", onPointerMove);
  const onPointerEnd = ({ pointerId }) => {
    if (fingers.delete(pointerId)) gesture = null;
  };
  box.addEventListener("pointerup", onPointerEnd);
  box.addEventListener("pointercancel", onPointerEnd);
}
