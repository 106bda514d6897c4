/** The tabs of the side panel, used when there is no room for all panels. */

import { publish } from "./store.js";
import { byId, setAttribute } from "./format.js";

const tabs = [...byId("tabs").querySelectorAll("button")];
const side = byId("side");

export function openTab(name) {
  side.dataset.tab = name;
  for (const tab of tabs) {
    const open = tab.dataset.tab === name;
    setAttribute(tab, "aria-selected", open);
    setAttribute(tab, "tabindex", open ? 0 : -1);
  }
  publish("tab", name);
}

function onKeyDown(event) {
  const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
  if (!step) return;
  const at = tabs.findIndex((tab) => tab.dataset.tab === side.dataset.tab);
  const next = tabs[(at + step + tabs.length) % tabs.length];
  openTab(next.dataset.tab);
  next.focus();
}

export function startTabs() {
  for (const tab of tabs) tab.addEventListener("click", () => openTab(tab.dataset.tab));
  byId("tabs").addEventListener("keydown", onKeyDown);
  openTab("camera");
}
