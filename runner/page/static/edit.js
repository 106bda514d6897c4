/** Edits the layout of the Configure view: tiles are dragged on a grid, or moved by keys; the station saves it. */

import { enlarge, inControl, listen, store } from "./store.js";
import { completed, moved, resized, sizeOf } from "./editing.js";
import { GAP } from "./layout.js";
import { pending, request, requests, showProblem, whyNoControl } from "./requests.js";
import { showDraft } from "./tiles.js";
import { announce, byId, displayName, make, setAttribute, setText } from "./format.js";

const STEPS = { ArrowUp: [-1, 0], ArrowDown: [1, 0], ArrowLeft: [0, -1], ArrowRight: [0, 1] };

/** @type {import("./editing.js").Draft|null} null: not editing */
let draft = null;
let isOwn = false; // whether the draft is the vehicle's own layout, unchanged
/** @type {string|undefined} the request that saves it */
let saving;
const target = make("div", { class: "target", hidden: true }); // where the dragged tile would go
const movers = new Map(); // by camera, the handle that drags its tile

/** Whether the layout is being edited. */
export const isEditing = () => draft !== null;

const cameras = () => store.hello?.cameras ?? [];

// --- begin and end ----------------------------------------------------------------------------------------------------

function begin() {
  const why = store.hello?.layout.problem ?? (inControl() ? null : whyNoControl());
  if (why) return showProblem(why);
  if (draft || !store.hello) return;
  if (store.enlarged) enlarge(null);
  document.body.dataset.editing = "";
  byId("layout-bar").hidden = false;
  for (const { name } of cameras()) addMover(name);
  setDraft(completed(cameras(), store.hello.layout.places), false);
  movers.get(store.selected ?? cameras()[0]?.name)?.focus();
}

function end() {
  if (!draft) return;
  draft = null;
  saving = undefined;
  delete document.body.dataset.editing;
  byId("layout-bar").hidden = true;
  movers.forEach((mover) => mover.remove());
  movers.clear();
  target.remove();
  showDraft(null);
  byId("edit-layout").focus();
}

function save() {
  if (!draft || pending("layout")) return;
  saving = request("layout", { layout: isOwn ? null : completed(cameras(), draft) }, "layout");
  refresh();
}

function reset() {
  if (store.hello) setDraft(completed(cameras(), store.hello.layout.own), true);
}

/** Leave editing once the layout is saved; a refusal keeps the draft. */
function onRequests() {
  const answered = requests.answered.find(({ id }) => id === saving);
  if (answered?.result === "applied") return end();
  if (answered) saving = undefined;
  refresh();
}

function refresh() {
  setAttribute(byId("layout-save"), "data-pending", pending("layout") ? "" : null);
}

// --- the draft --------------------------------------------------------------------------------------------------------

function setDraft(next, own) {
  const focused = [...movers.values()].find((mover) => mover === document.activeElement);
  draft = next;
  isOwn = own;
  showDraft(next);
  grid()?.append(target);
  for (const [name, mover] of movers) describe(name, mover);
  focused?.focus({ preventScroll: true }); // moving its tile drops the focus
}

/** The element with the tiles. */
const grid = () => byId("tiles").querySelector(".grid");

function placeText(name) {
  const { row, column, row_span, column_span } = place(name);
  return `row ${row + 1}, column ${column + 1}, ${row_span} high, ${column_span} wide`;
}

function describe(name, mover) {
  setAttribute(mover, "aria-label", `${displayName(name)}: ${placeText(name)}`);
  setText(mover.firstChild, placeText(name));
}

/** @returns {import("./layout.js").Place} */
const place = (name) => /** @type {any} */ (draft)[name];

function move(name, row, column) {
  setDraft(moved(/** @type {any} */ (draft), name, row, column), false);
  announce(`${displayName(name)}: ${placeText(name)}`);
}

function resize(name, row_span, column_span) {
  setDraft(resized(/** @type {any} */ (draft), name, row_span, column_span), false);
  announce(`${displayName(name)}: ${placeText(name)}`);
}

// --- keys and pointer -------------------------------------------------------------------------------------------------

function addMover(name) {
  const grip = make("span", { class: "grip", "aria-hidden": "true" });
  const mover = make("button", { class: "mover", "data-mover": name, "aria-describedby": "layout-help" }, make("span", { class: "where" }), grip);
  mover.addEventListener("keydown", (event) => onKeyDown(event, name));
  mover.addEventListener("pointerdown", (event) => drag(event, name, mover, event.target === grip));
  document.querySelector(`.tile[data-camera="${name}"]`)?.append(mover);
  movers.set(name, mover);
}

function onKeyDown(event, name) {
  if (event.key === "Escape") return end();
  const step = STEPS[event.key];
  if (!step || event.ctrlKey || event.altKey || event.metaKey) return;
  event.preventDefault();
  event.stopPropagation(); // otherwise these keys select cameras
  if (event.repeat) return;
  const { row, column, row_span, column_span } = place(name);
  if (event.shiftKey) resize(name, row_span + step[0], column_span + step[1]);
  else move(name, row + step[0], column + step[1]);
}

/** Follow the pointer from press to release, then move or resize the tile. */
function drag(event, name, mover, isGrip) {
  if (event.button !== 0 || !draft) return;
  const own = place(name);
  const box = mover.parentElement.getBoundingClientRect();
  const across = (box.width + GAP) / own.column_span; // from one column to the next
  const down = (box.height + GAP) / own.row_span;
  const { rows, columns } = sizeOf(draft);
  const placeAt = (at) => {
    const [x, y] = [(at.clientX - event.clientX) / across, (at.clientY - event.clientY) / down];
    if (isGrip) return { ...own, row_span: clamped(own.row_span + y, 1, rows + 1 - own.row), column_span: clamped(own.column_span + x, 1, columns + 1 - own.column) };
    return { ...own, row: clamped(own.row + y, 0, rows), column: clamped(own.column + x, 0, columns) };
  };
  const onMove = (at) => {
    const { row, column, row_span, column_span } = placeAt(at);
    target.hidden = false;
    target.style.gridArea = `${row + 1} / ${column + 1} / span ${row_span} / span ${column_span}`;
  };
  const onRelease = (at) => {
    for (const [kind, listener] of Object.entries(listeners)) mover.removeEventListener(kind, listener);
    target.hidden = true;
    if (at.type !== "pointerup" || !draft) return;
    const { row, column, row_span, column_span } = placeAt(at);
    if (isGrip) resize(name, row_span, column_span);
    else move(name, row, column);
  };
  const listeners = { pointermove: onMove, pointerup: onRelease, pointercancel: onRelease };
  for (const [kind, listener] of Object.entries(listeners)) mover.addEventListener(kind, listener);
  mover.setPointerCapture(event.pointerId);
}

const clamped = (value, least, most) => Math.max(least, Math.min(most, Math.round(value)));

export function startEdit() {
  byId("edit-layout").addEventListener("click", begin);
  byId("layout-save").addEventListener("click", save);
  byId("layout-reset").addEventListener("click", reset);
  byId("layout-cancel").addEventListener("click", end);
  byId("layout-bar").addEventListener("keydown", ({ key }) => key === "Escape" && end());
  listen("requests", onRequests);
  listen("view", end);
  listen("hello", () => cameras().every(({ name }) => movers.get(name)?.isConnected) || end()); // of another vehicle
}
