/**
 * Monitors: additional windows of this page for other screens, each with some of the cameras. They share the page's selection
 * and control, which only the page itself takes and releases.
 */

import { camera, listen, store } from "./store.js";
import { bandsOf } from "./layout.js";
import { send } from "./link.js";
import { byId, displayName, make, setText } from "./format.js";

const dialog = byId("monitors", HTMLDialogElement);
const path = (names) => `${location.pathname}?show=${names.map(encodeURIComponent).join()}`;

/** The rows of the layout with more than one picture, and each camera. */
function groups({ cameras, layout }) {
  const rows = bandsOf(cameras, layout.places).map(({ tiles }) => tiles.map((tile) => tile.camera.name));
  return [...rows.filter((names) => names.length > 1), ...cameras.map(({ name }) => [name])];
}

function link(names) {
  const anchor = make("a", { href: path(names), target: "_blank", rel: "noopener" }, names.map(displayName).join(", "));
  return make("li", {}, anchor, make("code", {}, location.origin + path(names)));
}

/** List the addresses of monitors. */
export function listMonitors() {
  if (!store.hello || store.view === "monitor" || dialog.open) return;
  dialog.replaceChildren(
    make("h2", { id: "monitors-title" }, "Monitors"),
    make("p", {}, "Open one of these addresses in a window on another screen. " +
      "In this browser, it shares selection and control with this page."),
    make("ul", {}, ...groups(store.hello).map(link)),
    make("form", { method: "dialog" }, make("button", { autofocus: true }, "Close")),
  );
  dialog.showModal();
}

/** Report cameras in this monitor's address that the vehicle does not have. */
function reportUnknownCameras({ vehicle, layout }) {
  const shown = globalThis.boot.shown ?? [];
  const unknown = shown.filter((name) => !camera(name));
  const problem = shown.length ? `${vehicle} has no camera ${unknown.join(", ")}` : "the address names no camera";
  byId("no-such-camera").hidden = shown.length > 0 && !unknown.length;
  setText(byId("no-such-camera"), `${problem}; cameras are ${Object.keys(layout.places).join(", ")}`);
}

export function startMonitors() {
  byId("open-monitors").addEventListener("click", listMonitors);
  listen("chosen", (name) => send({ select: name }));
  listen("hello", ({ selected }) => !selected && store.selected && send({ select: store.selected }));
  if (globalThis.boot.shown) listen("hello", reportUnknownCameras);
}
