/** Day or night: the operator's choice is kept, otherwise the system's is used. */

import { publish } from "./store.js";
import { by } from "./format.js";

const KEY = "tod-theme";
const light = matchMedia("(prefers-color-scheme: light)");

const chosen = () => localStorage.getItem(KEY);

function show() {
  const theme = chosen() ?? (light.matches ? "day" : "night");
  document.documentElement.dataset.theme = theme;
  by("theme").textContent = theme === "day" ? "Night" : "Day";
  publish("theme", theme);
}

export function toggleTheme() {
  localStorage.setItem(KEY, document.documentElement.dataset.theme === "day" ? "night" : "day");
  show();
}

export function startTheme() {
  light.addEventListener("change", show);
  by("theme").addEventListener("click", toggleTheme);
  show();
}
