/** Events, newest first, and toasts for events that need immediate attention. */

import { listen, store } from "./store.js";
import { byId, clockTime, make, setText } from "./format.js";

const TOAST_MS = { hint: 4000, problem: 8000 };
const MAX_TOASTS = 4;

const list = byId("news");
const toasts = byId("toasts");
const latest = make("p", { id: "latest" });
const largeScreen = matchMedia("(min-width: 1700px) and (min-height: 900px)");

const line = ({ time, text, level }) =>
  make("li", { "data-level": level }, make("time", {}, clockTime(time)), " ", level === "problem" ? `✕ ${text}` : text);

function refresh() {
  list.replaceChildren(...store.notes.map(line));
  const [newest] = store.notes;
  setText(latest, newest ? `${clockTime(newest.time)}  ${newest.text}` : "no events yet");
}

/** @param {{text: string, level: string, of?: string}} toast of: another vehicle that it is about */
function showToast({ text, level, of }) {
  [...toasts.children].find((each) => each.getAttribute("data-text") === text)?.remove();
  const shape = level === "problem" ? "✕ " : "";
  const words = make("span", { "data-of": of ?? null }, shape + text);
  const element = make("div", { class: "toast", "data-level": level, "data-text": text }, words);
  element.append(make("button", { "aria-label": "close", onclick: () => element.remove() }, "×"));
  toasts.append(element);
  while (toasts.children.length > MAX_TOASTS) toasts.firstChild?.remove();
  setTimeout(() => element.remove(), TOAST_MS[level]);
}

/** On a large screen the whole list is below the tiles; otherwise only its newest line, and the list has a tab. */
function placeNews() {
  const strip = byId("strip");
  if (largeScreen.matches) strip.replaceChildren(list);
  else {
    byId("news-panel").append(list);
    strip.replaceChildren(latest);
  }
}

export function startNews() {
  largeScreen.addEventListener("change", placeNews);
  placeNews();
  let isScheduled = false;
  listen("note hello", () => {
    if (isScheduled) return;
    isScheduled = true; // several arrive together after hello
    requestAnimationFrame(() => {
      isScheduled = false;
      refresh();
    });
  });
  listen("toast", showToast);
}
