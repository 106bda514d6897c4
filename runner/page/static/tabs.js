/** The tabs of the side panel, for when there is no room for everything at once. */

import { publish } from "./store.js";
import { by, mark } from "./format.js";

const tabs = [...by("tabs").querySelectorAll("button")];
const side = by("side");

export function openTab(name) {
  side.dataset.tab = name;
  for (const tab of tabs) {
    const open = tab.dataset.tab === name;
    mark(tab, "aria-selected", open);
    mark(tab, "tabindex", open ? 0 : -1);
  }
  publish("tab", name);
}

function move(event) {
  const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
  if (!step) return;
  const at = tabs.findIndex((tab) => tab.dataset.tab === side.dataset.tab);
  const next = tabs[(at + step + tabs.length) % tabs.length];
  openTab(next.dataset.tab);
  next.focus();
}

export function startTabs() {
  for (const tab of tabs) tab.addEventListener("click", () => openTab(tab.dataset.tab));
  by("tabs").addEventListener("keydown", move);
  openTab("camera");
}
