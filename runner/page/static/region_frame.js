/** Where a camera's region lies in its full image, as a drawing of both frames. */

import { fullRegion, pendingRegion, shownRegion } from "./roi.js";
import { make, sameRegion } from "./format.js";

export class RegionFrame {
  element = make("div", { class: "diagram", "aria-hidden": "true" });
  shown = make("i", { class: "is" });
  requested = make("i", { class: "wish" });

  constructor() {
    this.element.append(this.shown, this.requested);
  }

  /** Draw the region of a camera: solid as shown, dashed as requested. @param {string} name */
  refresh(name) {
    const full = fullRegion(name);
    this.element.style.aspectRatio = `${full.width} / ${full.height}`;
    place(this.shown, shownRegion(name), full);
    place(this.requested, pendingRegion(name), full);
  }
}

/** Whether a camera's picture is known to show a part of the full image only. @param {string} name */
export function showsPart(name) {
  const shown = shownRegion(name);
  return shown !== null && !sameRegion(shown, fullRegion(name));
}

function place(element, region, full) {
  element.hidden = !region;
  if (!region) return;
  const percent = (part, of) => `${(100 * part) / of}%`;
  Object.assign(element.style, {
    left: percent(region.x, full.width),
    top: percent(region.y, full.height),
    width: percent(region.width, full.width),
    height: percent(region.height, full.height),
  });
}
