/** The page that shows the counter, redrawn in every frame of the display. */

import { CELLS, CYCLE_MS, cellsOf } from "./counter.js";
import { now } from "./clock.js";

const MARGIN = 4; // cells, white on both sides
const canvas = /** @type {HTMLCanvasElement} */ (document.getElementById("cells"));
const digits = /** @type {HTMLElement} */ (document.getElementById("digits"));
const context = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d", { alpha: false, desynchronized: true }));
Object.assign(canvas, { width: CELLS + 2 * MARGIN, height: 1 });

function draw() {
  const ms = now();
  context.fillStyle = "#fff";
  context.fillRect(0, 0, canvas.width, 1);
  context.fillStyle = "#000";
  for (const [i, black] of cellsOf(ms).entries()) if (black) context.fillRect(MARGIN + i, 0, 1, 1);
  digits.textContent = String(Math.floor(ms) % CYCLE_MS).padStart(6, "0");
  requestAnimationFrame(draw);
}

requestAnimationFrame(draw);
