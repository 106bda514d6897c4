/** The layout of the Configure view while it is edited: tiles on a grid. */

import { store } from "./store.js";
import { completed, moved, resized, sizeOf } from "./editing.js";
import { GAP } from "./layout.js";
import { showDraft } from "./tiles.js";
import { byId, make } from "./format.js";

const STEPS = { ArrowUp: [-1, 0], ArrowDown: [1, 0], ArrowLeft: [0, -1], ArrowRight: [0, 1] };
const target = make("div", { class: "target", hidden: true }); // where the dragged tile would go

const cameras = () => store.hello?.cameras ?? [];

/** @type {import("./edit.js").Editor} */
export const GRID = {
  kind: "layout",
  help: "Drag a picture to move it, or its corner to resize it; or use the arrow keys, with Shift to resize.",
  initial: () => completed(cameras(), store.hello?.layout.places ?? {}),
  own: () => completed(cameras(), store.hello?.layout.own ?? {}),
  stated: (draft) => completed(cameras(), draft),
  show(draft) {
    showDraft(draft);
    if (draft) byId("tiles").querySelector(".grid")?.append(target);
    else target.remove();
  },
  text(draft, name) {
    const { row, column, row_span, column_span } = draft[name];
    return `row ${row + 1}, column ${column + 1}, ${row_span} high, ${column_span} wide`;
  },
  pressed(draft, name, { key, shiftKey }) {
    const step = STEPS[key];
    if (!step) return undefined;
    const { row, column, row_span, column_span } = draft[name];
    return shiftKey ? resized(draft, name, row_span + step[0], column_span + step[1]) : moved(draft, name, row + step[0], column + step[1]);
  },
  drag(draft, name, mover, press) {
    const isGrip = /** @type {HTMLElement} */ (press.target).classList.contains("grip");
    const own = draft[name];
    const box = /** @type {HTMLElement} */ (mover.parentElement).getBoundingClientRect();
    const across = (box.width + GAP) / own.column_span; // from one column to the next
    const down = (box.height + GAP) / own.row_span;
    const { rows, columns } = sizeOf(draft);
    const placeAt = (at) => {
      const [x, y] = [(at.clientX - press.clientX) / across, (at.clientY - press.clientY) / down];
      if (isGrip) {
        const row_span = clamped(own.row_span + y, 1, rows + 1 - own.row);
        return { ...own, row_span, column_span: clamped(own.column_span + x, 1, columns + 1 - own.column) };
      }
      return { ...own, row: clamped(own.row + y, 0, rows), column: clamped(own.column + x, 0, columns) };
    };
    return {
      over(at) {
        target.hidden = !at;
        if (!at) return;
        const { row, column, row_span, column_span } = placeAt(at);
        target.style.gridArea = `${row + 1} / ${column + 1} / span ${row_span} / span ${column_span}`;
      },
      drop(at) {
        const { row, column, row_span, column_span } = placeAt(at);
        return isGrip ? resized(draft, name, row_span, column_span) : moved(draft, name, row, column);
      },
    };
  },
};

const clamped = (value, least, most) => Math.max(least, Math.min(most, Math.round(value)));
