/** The keyboard, and the dialog that lists its keys. */

import { enlarge, listen, publish, select, store } from "./store.js";
import { selectMode, toggleControl } from "./header.js";
import { focusTile, switchCamera } from "./tiles.js";
import { sendFull } from "./panel.js";
import { toggleTheme } from "./theme.js";
import { rolesOf } from "./arrange.js";
import { toggleGuides } from "./drive.js";
import { toggleSound } from "./sound.js";
import { toggleDrawer, toggleFullScreen, toggleView } from "./views.js";
import { by, make } from "./format.js";

const MODES = { s: "single", a: "automatic", c: "collective" };
const LOOKS = { ArrowLeft: "left", ArrowUp: "front", ArrowRight: "right", ArrowDown: "rear" };
const CHORD_MS = 2500;
const LIST = [
  ["1 … 9", "select a camera"],
  ["o", "switch the selected camera on or off"],
  ["← ↑ → ↓", "Drive view: select the left, front, right or rear camera"],
  ["Enter, double click", "enlarge the selected camera; in the Drive view it changes places with the front camera"],
  ["Esc", "back from the enlarged picture"],
  ["v", "Drive or Configure view"],
  ["d", "Drive view: open or close the drawer"],
  ["g", "Drive view: lines on the ground of calibrated cameras, of all, or none"],
  ["b", "Drive view: tones for lost, frozen and late pictures, or none"],
  ["Shift+F", "full screen"],
  ["drag on a picture", "choose the ROI (mode S)"],
  ["f", "full image of the selected camera (mode S)"],
  ["Shift+S, Shift+A, Shift+C", "mode Single, Automatic, Collective"],
  ["m, then s, a or c", "the same"],
  ["t", "take or release control"],
  ["n", "night or day"],
  ["Tab", "from control to control; arrows within modes, tabs and sliders"],
  ["?", "this list"],
];

let chord = -Infinity;

const plain = {
  o: () => store.selected && switchCamera(store.selected),
  f: sendFull,
  t: toggleControl,
  n: toggleTheme,
  v: toggleView,
  d: toggleDrawer,
  b: toggleSound,
  g: () => store.view === "drive" && toggleGuides(),
  F: toggleFullScreen,
  "?": () => publish("help"),
  m() {
    chord = performance.now();
    publish("toast", { text: "mode: s Single, a Automatic, c Collective", level: "hint" });
  },
  Escape: () => store.enlarged && enlarge(null),
  Enter: enlargeSelected,
};

/** Whether a key is meant for the cameras: Enter on a button presses the button, arrows move a slider. */
const forCameras = ({ target }) => target === document.body || target.classList.contains("tile");

function enlargeSelected(event) {
  if (!forCameras(event)) return;
  event.preventDefault();
  if (store.selected) enlarge(store.enlarged === store.selected ? null : store.selected);
}

const typing = ({ target }) =>
  target.matches?.("textarea, select, input:not([type=range]):not([type=checkbox]):not([type=radio])");

function pressed(event) {
  if (event.ctrlKey || event.altKey || event.metaKey || event.repeat) return;
  if (document.querySelector("dialog[open]") || (typing(event) && event.key !== "Escape")) return;
  const { key } = event;
  const mode = MODES[key.toLowerCase()];
  const chorded = performance.now() - chord < CHORD_MS;
  if (key !== "Shift") chord = -Infinity;
  if (mode && (event.shiftKey || chorded)) return selectMode(mode);
  if (/^[1-9]$/.test(key)) return selectCamera(store.hello?.cameras[+key - 1]?.name);
  if (key in LOOKS && store.view === "drive" && forCameras(event)) return selectCamera(rolesOf(store.hello?.cameras ?? [])[LOOKS[key]]?.name);
  plain[key]?.(event);
}

function selectCamera(name) {
  if (name === undefined) return;
  if (store.enlarged) enlarge(name);
  select(name);
  focusTile(name);
}

export function startKeys() {
  const help = by("help", HTMLDialogElement);
  const rows = LIST.map(([key, what]) => make("tr", {}, make("th", { scope: "row" }, key), make("td", {}, what)));
  const close = make("form", { method: "dialog" }, make("button", { autofocus: true }, "Close"));
  help.append(make("h2", { id: "help-title" }, "Keys"), make("table", {}, make("tbody", {}, ...rows)), close);
  listen("help", () => help.open || help.showModal());
  addEventListener("keydown", pressed);
}
