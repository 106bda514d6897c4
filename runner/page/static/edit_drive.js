/** The layout of the Drive view while it is edited: which picture is in which place. */

import { store } from "./store.js";
import { rolesOf } from "./arrange.js";
import { moved, placeAt, placeOf, placesOf, placeText, shifted, stated } from "./placing.js";
import { driveArrangement, driveRoles, showDriveDraft } from "./tiles.js";
import { byId, make, setBox } from "./format.js";

/** @type {Record<string, "front"|"left"|"right"|"rear"|"row">} */
const PLACES = { ArrowLeft: "left", ArrowRight: "right", ArrowUp: "rear", ArrowDown: "row", Enter: "front" };
const STEPS = { ArrowLeft: -1, ArrowRight: 1 };
const target = make("div", { class: "target", hidden: true }); // where the dragged picture would go

/** @type {import("./edit.js").Editor} */
export const DRIVE = {
  kind: "drive",
  help: "Drag a picture to another place; the one there takes its own. Keys: arrows for left, right, mirror and row, " +
    "Enter for the middle, Shift with ← → along the row.",
  initial: () => placesOf(driveRoles()),
  own: () => placesOf(rolesOf(store.hello?.cameras ?? [])),
  stated,
  show(draft) {
    showDriveDraft(draft);
    if (draft) byId("tiles").append(target);
    else target.remove();
  },
  text: placeText,
  pressed(draft, name, { key, shiftKey }) {
    if (shiftKey) return STEPS[key] && shifted(draft, name, STEPS[key]);
    return PLACES[key] && moved(draft, name, PLACES[key]);
  },
  drag(draft, name) {
    return {
      over(at) {
        target.hidden = !at;
        if (!at) return;
        const { box } = destination(draft, name, at);
        setBox(target, box);
      },
      drop(at) {
        const { place, other } = destination(draft, name, at);
        return moved(draft, name, place, place === "row" && other ? draft.row.indexOf(other) : undefined);
      },
    };
  },
};

/** The place under the pointer, the camera there, if any, and its box in the area. */
function destination(draft, name, { clientX, clientY }) {
  const area = byId("tiles").getBoundingClientRect();
  const tiles = document.elementsFromPoint(clientX, clientY).map((element) => /** @type {HTMLElement|null} */ (element.closest(".tile")));
  const tile = tiles.find((each) => each && each.dataset.camera !== name);
  const other = tile?.dataset.camera;
  const { slots } = driveArrangement();
  const at = other && placeOf(draft, other);
  const place = at && at !== "front" ? at : placeAt(clientX - area.x, clientY - area.y, slots);
  if (!tile || !other || placeOf(draft, other) !== place) return { place, other: undefined, box: slots[place] };
  const { x: left, y: top, width, height } = tile.getBoundingClientRect();
  return { place, other, box: { x: left - area.x, y: top - area.y, width, height } };
}
