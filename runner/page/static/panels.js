/** The panels of the Drive view, in the boxes next to the pictures; their text is as large as fits. */

import { byId, setBox } from "./format.js";

const IDS = { figures: "drive-figures", messages: "messages", words: "drive-words", map: "drive-map", buttons: "drive-buttons" };
const FITS = [1, 0.9, 0.8, 0.7, 0.6, 0.5]; // of the usual size of text
const [FIGURES, WORDS] = [0.05, 0.037]; // size of text, of the width of its box
const LEAST_PX = 11; // of text at its usual size

/** Panels with text, each with what it showed when the size of its text was chosen. @type {Map<HTMLElement, string>} */
const shown = new Map(["figures", "messages", "words", "buttons"].map((name) => [byId(IDS[name]), ""]));

/** @param {import("./arrange.js").Arrangement["panels"]|null} panels null: in another view */
export function placePanels(panels) {
  const area = byId("tiles").getBoundingClientRect();
  for (const [name, id] of Object.entries(IDS)) {
    const [element, box] = [byId(id), panels?.[name]];
    if (name !== "messages") element.hidden = !box;
    if (!box) {
      element.removeAttribute("style");
      continue;
    }
    const isOnPage = name === "messages"; // other views show messages elsewhere
    setBox(element, isOnPage ? { ...box, x: area.x + scrollX + box.x, y: area.y + scrollY + box.y } : box);
    const share = name === "figures" ? FIGURES : WORDS;
    element.style.setProperty("--unit", `${Math.max(LEAST_PX, Math.min(share * box.width, 0.14 * box.height))}px`);
  }
  if (panels) for (const panel of shown.keys()) fit(panel);
}

/** Choose the size of text again where it has become longer or shorter. */
export function fitPanels() {
  for (const [panel, before] of shown) {
    const text = (panel.textContent ?? "").replace(/\d/g, "0"); // all digits are equally wide
    if (text !== before) fit(panel);
    shown.set(panel, text);
  }
}

/** A message changes the text of its panel at any time. */
const messages = byId(IDS.messages);
new MutationObserver(() => messages.style.width && fit(messages)).observe(messages, {
  subtree: true, childList: true, characterData: true, attributeFilter: ["hidden"],
});

/** Make the text of a panel smaller where it would be cut off. @param {HTMLElement} panel */
function fit(panel) {
  const parts = [panel, ...panel.querySelectorAll("b, button")];
  for (const scale of FITS) {
    panel.style.setProperty("--fit", String(scale));
    if (!parts.some(isCut)) return;
  }
}

const isCut = ({ scrollHeight, clientHeight, scrollWidth, clientWidth }) => scrollHeight > clientHeight || scrollWidth > clientWidth;
