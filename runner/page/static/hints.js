/** The keys in force, for tooltips and messages: `inputs` in the configuration assigns them to actions. */

import { listen, store } from "./store.js";

const ARROWS = { ArrowLeft: "←", ArrowUp: "↑", ArrowRight: "→", ArrowDown: "↓", Escape: "Esc" };

/** @param {string|null|undefined} key */
export function labelOf(key) {
  if (!key) return "";
  return ARROWS[key] ?? (/^\p{Lu}$/u.test(key) ? `Shift+${key}` : key);
}

/** A text with the key of an action: "help (?)"; without one if the action has no key. @param {string} text  @param {string} action */
export function withKey(text, action) {
  const key = labelOf(store.hello?.inputs.keys[action]);
  return key ? `${text} (${key})` : text;
}

/** Write the keys into the tooltips of the page's file, and into the texts of its buttons: data-key names the action. */
function refresh() {
  for (const element of document.querySelectorAll("[data-key]")) {
    const { key = "", title, text } = /** @type {HTMLElement} */ (element).dataset;
    if (title) element.setAttribute("title", withKey(title, key));
    if (text) element.textContent = withKey(text, key);
  }
}

export function startHints() {
  refresh();
  listen("hello", refresh);
}
