/** The keyboard, and the dialog that lists its keys and the buttons of gamepads. */

import { listen, publish, store } from "./store.js";
import { ACTIONS } from "./actions.js";
import { labelOf } from "./hints.js";
import { selectMode } from "./header.js";
import { actionOf, keyOf } from "./presses.js";
import { byId, make, setText } from "./format.js";

const MODES = { s: "single", a: "automatic", c: "collective" };
const CHORD_MS = 2500;
const NUMBERED = /^camera_\d$/; // actions that select a camera by its number, listed in one row
const ROLES = 4; // actions before them
/** @type {[string, string, string][]} key, button, action */
const FIXED = [
  ["m, then s, a or c", "", "mode Single, Automatic, Collective"],
  ["drag on a picture", "", "choose the ROI (mode S)"],
  ["wheel or pinch on a picture", "", "zoom the ROI (mode S); drag with the middle button or two fingers to move it"],
  ["Tab", "", "next control; arrow keys within modes, tabs and sliders"],
];

let chordAt = -Infinity; // when "m" was pressed

const keys = () => store.hello?.inputs.keys ?? {};

/** Whether a key is meant for the cameras: Enter on a button presses the button, arrows move a slider. */
const isForCameras = ({ target }) => target === document.body || target.classList.contains("tile");

const isTyping = ({ target }) =>
  target.matches?.("textarea, select, input:not([type=range]):not([type=checkbox]):not([type=radio])");

function onKeyDown(event) {
  if (event.repeat && event.key === "Enter" && event.target.closest?.("button")) event.preventDefault(); // it would press it again
  if (event.ctrlKey || event.altKey || event.metaKey || event.repeat) return;
  if (document.querySelector("dialog[open]") || isTyping(event)) return leaveField(event);
  const key = keyOf(event);
  const mode = performance.now() - chordAt < CHORD_MS ? MODES[key.toLowerCase()] : undefined;
  if (key !== "Shift") chordAt = -Infinity;
  if (mode) return selectMode(mode);
  const action = ACTIONS[actionOf(keys(), key) ?? ""];
  if (!action) return onFixedKey(key);
  if (action.onCameras && !isForCameras(event)) return;
  if (action.onCameras) event.preventDefault();
  action.run();
}

/**
 * Enter in a number field sends the number, Escape reverts it; both give the focus back to the cameras. In a dialog
 * these keys belong to the dialog.
 */
function leaveField({ key, target }) {
  if (!(target instanceof HTMLInputElement) || target.type !== "number") return;
  if (target.closest("dialog") || !["Enter", "Escape"].includes(key)) return;
  if (key === "Escape") target.dispatchEvent(new Event("revert"));
  target.blur();
}

/**
 * Give the focus of a clicked button back to the cameras: Enter would press it again, and arrow keys would select no camera.
 * A button pressed by a key keeps it, as does one that moves a picture of the layout by arrow keys.
 */
function onClick({ detail, target }) {
  const button = detail > 0 && target instanceof Element ? target.closest("button, summary") : null;
  if (!(button instanceof HTMLElement) || button.closest("dialog, .mover")) return;
  if (button === document.activeElement) button.blur();
}

function onFixedKey(key) {
  if (key !== "m") return;
  chordAt = performance.now();
  publish("toast", { text: "mode: s Single, a Automatic, c Collective", level: "hint" });
}

/** Two tables beside each other, so that the list fits on small screens. @param {boolean} hasPad whether there is a gamepad */
function keyTables(hasPad) {
  const buttons = store.hello?.inputs.buttons ?? {};
  const listed = (names, of) => names.map(of).join(" ").trim();
  /** @type {(names: string[], description: string) => [string, string, string]} */
  const cells = (names, description) =>
    [listed(names, (name) => labelOf(keys()[name])), listed(names, (name) => buttons[name] ?? ""), description];
  const numbered = Object.keys(ACTIONS).filter((name) => NUMBERED.test(name));
  const single = Object.entries(ACTIONS).filter(([name]) => !NUMBERED.test(name));
  const rows = single.map(([name, { description }]) => cells([name], description));
  const count = store.view === "monitor" ? undefined : store.hello?.cameras.length;
  rows.splice(ROLES, 0, cells(numbered.slice(0, count), "select a camera by its number"));
  /** @param {[string, string, string]} cells */
  const row = ([key, button, action]) =>
    make("tr", {}, make("th", { scope: "row" }, key), ...(hasPad ? [button, action] : [action]).map((text) => make("td", {}, text)));
  const heads = () => ["Key", ...(hasPad ? ["Button"] : []), "Action"].map((head) => make("th", { scope: "col" }, head));
  const used = [...rows, ...FIXED].filter(([key, button]) => key || (hasPad && button)).map(row);
  const half = Math.ceil(used.length / 2);
  const tables = [used.slice(0, half), used.slice(half)].map((part) =>
    make("table", {}, make("thead", {}, make("tr", {}, ...heads())), make("tbody", {}, ...part)));
  return make("div", { class: "columns" }, ...tables);
}

export function startKeys() {
  const help = byId("help", HTMLDialogElement);
  const close = make("form", { method: "dialog" }, make("button", { autofocus: true }, "Close"));
  const pressed = make("p", { id: "pressed", role: "status" });
  listen("pressed", (names) => setText(pressed, `Pressed: ${names.join(", ")}`));
  listen("help", () => {
    if (help.open) return;
    setText(pressed, "");
    const hasPad = navigator.getGamepads().some(Boolean);
    const title = hasPad ? "Keys and buttons of a gamepad" : "Keys";
    help.replaceChildren(make("h2", { id: "help-title" }, title), keyTables(hasPad), pressed, close);
    help.showModal();
  });
  addEventListener("keydown", onKeyDown);
  addEventListener("click", onClick, true); // before a dialog opens, which would return the focus when it closes
}
