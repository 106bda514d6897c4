/** News, newest first, and toasts for what needs immediate attention. */

import { listen, store } from "./store.js";
import { by, clockTime, make, write } from "./format.js";

const TOAST_MS = { hint: 4000, problem: 8000 };
const MOST = 4;

const list = by("news");
const toasts = by("toasts");
const latest = make("p", { id: "latest" });
const roomy = matchMedia("(min-width: 1700px) and (min-height: 900px)");

const line = ({ time, text, level }) =>
  make("li", { "data-level": level }, make("time", {}, clockTime(time)), " ", level === "problem" ? `✕ ${text}` : text);

function refresh() {
  list.replaceChildren(...store.notes.map(line));
  const [newest] = store.notes;
  write(latest, newest ? `${clockTime(newest.time)}  ${newest.text}` : "no news yet");
}

function toast({ text, level }) {
  [...toasts.children].find((each) => each.getAttribute("data-text") === text)?.remove();
  const shape = level === "problem" ? "✕ " : "";
  const element = make("div", { class: "toast", "data-level": level, "data-text": text }, shape + text);
  element.append(make("button", { "aria-label": "close", onclick: () => element.remove() }, "×"));
  toasts.append(element);
  while (toasts.children.length > MOST) toasts.firstChild?.remove();
  setTimeout(() => element.remove(), TOAST_MS[level]);
}

/** If there is room, the whole list is below the tiles; otherwise only its newest line, and the list has a tab. */
function place() {
  const strip = by("strip");
  if (roomy.matches) strip.replaceChildren(list);
  else {
    by("news-panel").append(list);
    strip.replaceChildren(latest);
  }
}

export function startNews() {
  roomy.addEventListener("change", place);
  place();
  let waits = false;
  listen("note hello", () => {
    if (waits) return;
    waits = true; // several come at once after hello
    requestAnimationFrame(() => {
      waits = false;
      refresh();
    });
  });
  listen("toast", toast);
}
