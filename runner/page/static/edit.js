/** Edits the layout of a view: pictures are dragged, or moved by keys; the station saves it. */

import { enlarge, inControl, listen, store } from "./store.js";
import { DRIVE } from "./edit_drive.js";
import { GRID } from "./edit_grid.js";
import { pending, request, requests, showProblem, whyNoControl } from "./requests.js";
import { announce, byId, displayName, make, setAttribute, setText } from "./format.js";

/**
 * @typedef {object} Editor of the layout of a view; drafts are places as the view's other modules know them
 * @property {string} kind of the request that saves it
 * @property {string} help
 * @property {() => any} initial the places in force
 * @property {() => any} own the places that apply if none are saved
 * @property {(draft: any) => any} stated the places as they are saved
 * @property {(draft: any) => void} show null: the places in force
 * @property {(draft: any, name: string) => string} text where a picture is
 * @property {(draft: any, name: string, event: KeyboardEvent) => any} pressed the draft after a key; undefined: the key has no meaning
 * @property {(draft: any, name: string, mover: HTMLElement, press: PointerEvent) => Drag} drag
 * @typedef {object} Drag of a picture
 * @property {(at: PointerEvent|null) => void} over show where it would go; null: nowhere
 * @property {(at: PointerEvent) => any} drop the draft once it is there
 */

/** @type {Editor|null} null: not editing */
let editor = null;
/** @type {any} */
let draft = null;
let isOwn = false; // whether the draft is what applies if nothing is saved
/** @type {string|undefined} the request that saves it */
let saving;
/** @type {HTMLElement|null} the button that began it */
let opener = null;
const movers = new Map(); // by camera, the handle that drags its tile

/** Whether a layout is being edited. */
export const isEditing = () => editor !== null;

const cameras = () => store.hello?.cameras ?? [];

// --- begin and end ----------------------------------------------------------------------------------------------------

/** @param {Editor} chosen  @param {HTMLElement} button */
function begin(chosen, button) {
  const why = store.hello?.layout.problem ?? (inControl() ? null : whyNoControl());
  if (why) return showProblem(why);
  if (editor || !store.hello) return;
  [editor, opener] = [chosen, button];
  if (store.enlarged) enlarge(null);
  document.body.dataset.editing = "";
  byId("layout-bar").hidden = false;
  setText(byId("layout-help"), editor.help);
  for (const { name } of cameras()) addMover(name);
  setDraft(editor.initial(), false);
  movers.get(store.selected ?? cameras()[0]?.name)?.focus();
}

function end() {
  if (!editor) return;
  const { show } = editor;
  editor = draft = null;
  saving = undefined;
  delete document.body.dataset.editing;
  byId("layout-bar").hidden = true;
  movers.forEach((mover) => mover.remove());
  movers.clear();
  show(null);
  opener?.focus();
}

function save() {
  if (!editor || pending("layout")) return;
  saving = request("layout", { [editor.kind]: isOwn ? null : editor.stated(draft) }, "layout");
  refresh();
}

function reset() {
  if (editor) setDraft(editor.own(), true);
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
  if (!editor) return;
  const focused = [...movers.values()].find((mover) => mover === document.activeElement);
  draft = next;
  isOwn = own;
  editor.show(draft);
  for (const [name, mover] of movers) describe(name, mover);
  focused?.focus({ preventScroll: true }); // moving its tile drops the focus
}

const placeText = (name) => editor?.text(draft, name) ?? "";

function describe(name, mover) {
  setAttribute(mover, "aria-label", `${displayName(name)}: ${placeText(name)}`);
  setText(mover.firstChild, placeText(name));
}

function change(next, name) {
  setDraft(next, false);
  announce(`${displayName(name)}: ${placeText(name)}`);
}

// --- keys and pointer -------------------------------------------------------------------------------------------------

function addMover(name) {
  const parts = [make("span", { class: "where" }), make("span", { class: "grip", "aria-hidden": "true" })];
  const mover = make("button", { class: "mover", "data-mover": name, "aria-describedby": "layout-help" }, ...parts);
  mover.addEventListener("keydown", (event) => onKeyDown(event, name));
  mover.addEventListener("pointerdown", (event) => drag(event, name, mover));
  document.querySelector(`.tile[data-camera="${name}"]`)?.append(mover);
  movers.set(name, mover);
}

function onKeyDown(event, name) {
  if (event.key === "Escape") return end();
  const next = event.ctrlKey || event.altKey || event.metaKey ? undefined : editor?.pressed(draft, name, event);
  if (next === undefined) return;
  event.preventDefault();
  event.stopPropagation(); // otherwise these keys select cameras
  if (!event.repeat) change(next, name);
}

/** Follow the pointer from press to release. */
function drag(press, name, mover) {
  if (press.button !== 0 || !editor) return;
  const { over, drop } = editor.drag(draft, name, mover, press);
  const onRelease = (at) => {
    for (const [kind, listener] of Object.entries(listeners)) mover.removeEventListener(kind, listener);
    over(null);
    if (at.type === "pointerup" && editor) change(drop(at), name);
  };
  const listeners = { pointermove: over, pointerup: onRelease, pointercancel: onRelease };
  for (const [kind, listener] of Object.entries(listeners)) mover.addEventListener(kind, listener);
  mover.setPointerCapture(press.pointerId);
}

export function startEdit() {
  for (const [id, chosen] of /** @type {[string, Editor][]} */ ([["edit-layout", GRID], ["edit-drive", DRIVE]]))
    byId(id).addEventListener("click", () => begin(chosen, byId(id)));
  byId("layout-save").addEventListener("click", save);
  byId("layout-reset").addEventListener("click", reset);
  byId("layout-cancel").addEventListener("click", end);
  byId("layout-bar").addEventListener("keydown", ({ key }) => key === "Escape" && end());
  listen("requests", onRequests);
  listen("view", end);
  listen("hello", () => cameras().every(({ name }) => movers.get(name)?.isConnected) || end()); // of another vehicle
}
