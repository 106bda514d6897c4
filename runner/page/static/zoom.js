/** Zooming and moving the region of interest in mode S: wheel, pinch of two fingers, middle button. */

import { camera, publish } from "./store.js";
import { placed, toPicture } from "./framing.js";
import { moved, zoomed } from "./region.js";
import { seenRegion, sendRegion, waiting, whyNoRegion } from "./roi.js";
import { throttle } from "./scale.js";

const SEND_EVERY_MS = 250; // each new region starts the encoder anew
const REST_MS = 600; // after it the next turn of the wheel begins with the region in force
const TURN = 0.002; // of the wheel, as a power of e for each px
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
  let wish = null; // of the wheel
  /** @type {Map<number, {x: number, y: number}>} */
  const fingers = new Map();
  /** @type {{region: Rectangle, seen: Rectangle, from: {x: number, y: number}, apart: number}|null} */
  let held = null; // how a gesture of the hand began
  let hinted = -Infinity;

  const size = () => ({ width: box.clientWidth, height: box.clientHeight });
  const here = ({ clientX, clientY }) => ({ x: clientX - box.getBoundingClientRect().x, y: clientY - box.getBoundingClientRect().y });

  /** The region in force or requested, if it may be changed. */
  function current() {
    const why = seenRegion(name) ? whyNoRegion(name) : null;
    if (why && performance.now() - hinted > HINT_EVERY_MS) {
      publish("toast", { text: `${name}: ${why}`, level: "hint" });
      hinted = performance.now();
    }
    return why ? null : (waiting(name) ?? seenRegion(name));
  }

  /** A point of the full image. @param {Rectangle} seen what the box shows of it */
  function imagePoint(point, seen) {
    const { x, y } = toPicture(point, size(), seen, view());
    return { x: seen.x + x, y: seen.y + y };
  }

  function turn(event) {
    event.preventDefault();
    const [region, seen] = [wish && performance.now() - wish.at < REST_MS ? wish.region : current(), seenRegion(name)];
    const full = camera(name);
    if (!region || !seen || !full) return;
    const px = event.deltaY * (event.deltaMode === WheelEvent.DOM_DELTA_LINE ? LINE_PX : 1);
    const factor = Math.exp(px * (event.ctrlKey ? PINCH : TURN));
    wish = { region: zoomed(region, imagePoint(here(event), seen), factor, full), at: performance.now() };
    send(wish.region);
  }

  const middle = () => {
    const points = [...fingers.values()];
    return { x: points.reduce((sum, { x }) => sum + x, 0) / points.length, y: points.reduce((sum, { y }) => sum + y, 0) / points.length };
  };
  const apart = () => {
    const [a, b] = fingers.values();
    return b ? Math.hypot(a.x - b.x, a.y - b.y) : 1;
  };

  function grip() {
    const [region, seen] = [current(), seenRegion(name)];
    held = region && seen ? { region, seen, from: middle(), apart: apart() } : null;
  }

  function move(event) {
    if (!fingers.has(event.pointerId)) return;
    fingers.set(event.pointerId, here(event));
    const full = camera(name);
    if (!held || !full) return;
    const { region, seen, from } = held;
    const [factor, { scale }] = [held.apart / Math.max(1, apart()), placed(size(), seen, view())];
    const larger = zoomed(region, imagePoint(from, seen), factor, full);
    const way = { x: ((view().mirrored ? 1 : -1) * (middle().x - from.x) * factor) / scale, y: (-(middle().y - from.y) * factor) / scale };
    send(moved(larger, way, full));
  }

  box.addEventListener("wheel", turn, { passive: false });
  box.addEventListener("mousedown", (event) => event.button === MIDDLE && event.preventDefault()); // the browser would scroll
  box.addEventListener("pointerdown", (event) => {
    if (event.pointerType !== "touch" && event.button !== MIDDLE) return;
    fingers.set(event.pointerId, here(event));
    box.setPointerCapture(event.pointerId);
    if (event.button === MIDDLE || fingers.size === 2) grip();
  });
  box.addEventListener("pointermove", move);
  const letGo = ({ pointerId }) => {
    if (fingers.delete(pointerId)) held = null;
  };
  box.addEventListener("pointerup", letGo);
  box.addEventListener("pointercancel", letGo);
}
