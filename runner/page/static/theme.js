/** Day or night theme: the operator's choice if there is one, otherwise the system's. */

import { publish } from "./store.js";
import { byId } from "./format.js";

const KEY = "tod-theme";
const light = matchMedia("(prefers-color-scheme: light)");

const chosen = () => localStorage.getItem(KEY);

function applyTheme() {
  const theme = chosen() ?? (light.matches ? "day" : "night");
  document.documentElement.dataset.theme = theme;
  byId("theme").textContent = theme === "day" ? "Night" : "Day";
  publish("theme", theme);
}

export function toggleTheme() {
  localStorage.setItem(KEY, document.documentElement.dataset.theme === "day" ? "night" : "day");
  applyTheme();
}

export function startTheme() {
  light.addEventListener("change", applyTheme);
  byId("theme").addEventListener("click", toggleTheme);
  applyTheme();
}
