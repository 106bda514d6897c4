/** Edits the layout of the Configure view: tiles are dragged on a grid, or moved by keys; the station saves it. */

import { enlarge, inControl, listen, store } from "./store.js";
import { completed, moved, resized, sizeOf } from "./editing.js";
import { GAP } from "./layout.js";
import { complain, pending, request, requests, whyNoControl } from "./requests.js";
import { showDraft } from "./tiles.js";
import { by, make, mark, spoken, write } from "./format.js";

const STEPS = { ArrowUp: [-1, 0], ArrowDown: [1, 0], ArrowLeft: [0, -1], ArrowRight: [0, 1] };

/** @type {import("./editing.js").Draft|null} null: nothing is edited */
let draft = null;
let isOwn = false; // whether the draft is the vehicle's own layout, unchanged
/** @type {string|undefined} the request that saves it */
let saving;
const target = make("div", { class: "target", hidden: true }); // where a tile that is dragged would be
const movers = new Map(); // by camera, what its tile is dragged by

/** Whether the layout is being edited. */
export const isEdited = () => draft !== null;

const cameras = () => store.hello?.cameras ?? [];

// --- begin and end ----------------------------------------------------------------------------------------------------

function begin() {
  const why = store.hello?.layout.problem ?? (inControl() ? null : whyNoControl());
  if (why) return complain(why);
  if (draft || !store.hello) return;
  if (store.enlarged) enlarge(null);
  document.body.dataset.editing = "";
  by("layout-bar").hidden = false;
  for (const { name } of cameras()) addMover(name);
  change(completed(cameras(), store.hello.layout.places), false);
  movers.get(store.selected ?? cameras()[0]?.name)?.focus();
}

function end() {
  if (!draft) return;
  draft = null;
  saving = undefined;
  delete document.body.dataset.editing;
  by("layout-bar").hidden = true;
  movers.forEach((mover) => mover.remove());
  movers.clear();
  target.remove();
  showDraft(null);
  by("edit-layout").focus();
}

function save() {
  if (!draft || pending("layout")) return;
  saving = request("layout", { layout: isOwn ? null : completed(cameras(), draft) }, "layout");
  refresh();
}

function reset() {
  if (store.hello) change(completed(cameras(), store.hello.layout.own), true);
}

/** Once the layout is saved there is nothing more to edit; a refusal leaves it as it is. */
function heard() {
  const answer = requests.answered.find(({ id }) => id === saving);
  if (answer?.result === "applied") return end();
  if (answer) saving = undefined;
  refresh();
}

function refresh() {
  mark(by("layout-save"), "data-pending", pending("layout") ? "" : null);
}

// --- the draft --------------------------------------------------------------------------------------------------------

function change(now, own) {
  const focused = [...movers.values()].find((mover) => mover === document.activeElement);
  draft = now;
  isOwn = own;
  showDraft(now);
  area()?.append(target);
  for (const [name, mover] of movers) describe(name, mover);
  focused?.focus({ preventScroll: true }); // moving its tile took the focus away
}

/** The grid of the tiles. */
const area = () => by("tiles").querySelector(".grid");

function words(name) {
  const { row, column, row_span, column_span } = place(name);
  return `row ${row + 1}, column ${column + 1}, ${row_span} high, ${column_span} wide`;
}

function describe(name, mover) {
  mark(mover, "aria-label", `${spoken(name)}: ${words(name)}`);
  write(mover.firstChild, words(name));
}

/** @returns {import("./layout.js").Place} */
const place = (name) => /** @type {any} */ (draft)[name];

function move(name, row, column) {
  change(moved(/** @type {any} */ (draft), name, row, column), false);
  write(by("announcer"), `${spoken(name)}: ${words(name)}`);
}

function resize(name, row_span, column_span) {
  change(resized(/** @type {any} */ (draft), name, row_span, column_span), false);
  write(by("announcer"), `${spoken(name)}: ${words(name)}`);
}

// --- keys and pointer -------------------------------------------------------------------------------------------------

function addMover(name) {
  const grip = make("span", { class: "grip", "aria-hidden": "true" });
  const mover = make("button", { class: "mover", "data-mover": name, "aria-describedby": "layout-help" }, make("span", { class: "where" }), grip);
  mover.addEventListener("keydown", (event) => pressed(event, name));
  mover.addEventListener("pointerdown", (event) => drag(event, name, mover, event.target === grip));
  document.querySelector(`.tile[data-camera="${name}"]`)?.append(mover);
  movers.set(name, mover);
}

function pressed(event, name) {
  if (event.key === "Escape") return end();
  const step = STEPS[event.key];
  if (!step || event.ctrlKey || event.altKey || event.metaKey) return;
  event.preventDefault();
  event.stopPropagation(); // these keys select cameras elsewhere
  const { row, column, row_span, column_span } = place(name);
  if (event.shiftKey) resize(name, row_span + step[0], column_span + step[1]);
  else move(name, row + step[0], column + step[1]);
}

/** Follow the pointer from a press to its release: `done` gets the place that it points at. */
function drag(event, name, mover, isGrip) {
  if (event.button !== 0 || !draft) return;
  const own = place(name);
  const box = mover.parentElement.getBoundingClientRect();
  const across = (box.width + GAP) / own.column_span; // from one column to the next
  const down = (box.height + GAP) / own.row_span;
  const { rows, columns } = sizeOf(draft);
  const pointed = (at) => {
    const [x, y] = [(at.clientX - event.clientX) / across, (at.clientY - event.clientY) / down];
    if (isGrip) return { ...own, row_span: between(own.row_span + y, 1, rows + 1 - own.row), column_span: between(own.column_span + x, 1, columns + 1 - own.column) };
    return { ...own, row: between(own.row + y, 0, rows), column: between(own.column + x, 0, columns) };
  };
  const show = (at) => {
    const { row, column, row_span, column_span } = pointed(at);
    target.hidden = false;
    target.style.gridArea = `${row + 1} / ${column + 1} / span ${row_span} / span ${column_span}`;
  };
  const release = (at) => {
    for (const [kind, listener] of Object.entries(listeners)) mover.removeEventListener(kind, listener);
    target.hidden = true;
    if (at.type !== "pointerup" || !draft) return;
    const { row, column, row_span, column_span } = pointed(at);
    if (isGrip) resize(name, row_span, column_span);
    else move(name, row, column);
  };
  const listeners = { pointermove: show, pointerup: release, pointercancel: release };
  for (const [kind, listener] of Object.entries(listeners)) mover.addEventListener(kind, listener);
  mover.setPointerCapture(event.pointerId);
}

const between = (value, least, most) => Math.max(least, Math.min(most, Math.round(value)));

export function startEdit() {
  by("edit-layout").addEventListener("click", begin);
  by("layout-save").addEventListener("click", save);
  by("layout-reset").addEventListener("click", reset);
  by("layout-cancel").addEventListener("click", end);
  by("layout-bar").addEventListener("keydown", ({ key }) => key === "Escape" && end());
  listen("requests", heard);
  listen("view", end);
  listen("hello", () => cameras().every(({ name }) => movers.get(name)?.isConnected) || end()); // of another vehicle
}
