/**
 * Alarms, drawn by the worker into the picture itself: they appear even when the page's main thread is busy.
 * Each alarm has a colour, a word and a shape: LOST a cross, FROZEN a hatch, DAMAGED and LATE, whose picture moves, a dashed frame.
 */

export const RED = "#e01b24";
export const AMBER = "#ffb000";

/**
 * Draw the alarm or notice of a status over the picture in the canvas.
 * @param {OffscreenCanvasRenderingContext2D} context
 * @param {{x: number, y: number, width: number, height: number}} area the part of the canvas that is on the screen
 * @param {boolean} mirrored whether the canvas is mirrored: text is drawn so that it reads correctly
 * @param {string} status
 * @param {string} text
 */
export function drawOverlay(context, area, mirrored, status, text) {
  readably(context, area, mirrored, () => drawStatus(context, area, status, text));
}

/**
 * Draw with the origin in an area's corner so that it reads correctly on the screen.
 * @param {OffscreenCanvasRenderingContext2D} context
 * @param {{x: number, y: number, width: number, height: number}} area
 * @param {boolean} mirrored whether the canvas is mirrored
 * @param {() => void} draw
 */
export function readably(context, area, mirrored, draw) {
  context.save();
  if (mirrored) context.transform(-1, 0, 0, 1, area.x + area.width, area.y);
  else context.translate(area.x, area.y);
  draw();
  context.restore();
}

function drawStatus(context, { width, height }, status, text) {
  const side = Math.min(width, height);
  if (status === "late" || status === "damaged") return drawWarning(context, width, height, side, text);
  if (status === "frozen" || status === "lost") return drawAlarm(context, width, height, side, status, text);
  dim(context, width, height, 0.72);
  drawLabel(context, width, height / 2, side * 0.13, text, "#2b333c", "#e6ebf0");
}

/**
 * Draw a note into the lower right corner: no alarm, so that it neither covers nor colours the picture.
 * @param {OffscreenCanvasRenderingContext2D} context
 * @param {{x: number, y: number, width: number, height: number}} area the part of the canvas that is on the screen
 * @param {boolean} mirrored whether the canvas is mirrored
 * @param {string} text
 */
export function drawNote(context, area, mirrored, text) {
  readably(context, area, mirrored, () => {
    const size = Math.max(10, Math.round(Math.min(area.width, area.height) * 0.07));
    context.font = `600 ${size}px system-ui, "DejaVu Sans", sans-serif`;
    context.textAlign = "end";
    context.textBaseline = "middle";
    const wide = context.measureText(text).width + size;
    context.fillStyle = "rgba(43,51,60,0.8)";
    context.fillRect(area.width - wide, area.height - 1.6 * size, wide, 1.6 * size);
    context.fillStyle = "#e6ebf0";
    context.fillText(text, area.width - size / 2, area.height - 0.75 * size);
  });
}

function drawAlarm(context, width, height, side, status, text) {
  dim(context, width, height, 0.5);
  if (status === "frozen") hatch(context, width, height, side);
  else cross(context, width, height, side);
  frame(context, width, height, side * 0.06, RED, []);
  drawLabel(context, width, height / 2, side * 0.17, text, RED, "#fff");
}

function drawWarning(context, width, height, side, text) {
  frame(context, width, height, side * 0.06, AMBER, [side * 0.16, side * 0.08]);
  drawLabel(context, width, height - side * 0.15, side * 0.13, text, AMBER, "#000");
}

/** Desaturate and darken the last picture, so that it is not mistaken for a live one. */
function dim(context, width, height, dark) {
  context.globalCompositeOperation = "saturation";
  context.fillStyle = "#000";
  context.fillRect(0, 0, width, height);
  context.globalCompositeOperation = "source-over";
  context.fillStyle = `rgba(0,0,0,${dark})`;
  context.fillRect(0, 0, width, height);
}

function hatch(context, width, height, side) {
  stroke(context, side * 0.03, "rgba(224,27,36,0.55)", () => {
    for (let x = -height; x < width; x += side * 0.16) {
      context.moveTo(x, height);
      context.lineTo(x + height, 0);
    }
  });
}

function cross(context, width, height, side) {
  stroke(context, side * 0.04, "rgba(224,27,36,0.8)", () => {
    context.moveTo(0, 0);
    context.lineTo(width, height);
    context.moveTo(0, height);
    context.lineTo(width, 0);
  });
}

export function frame(context, width, height, thick, colour, dashes) {
  context.setLineDash(dashes);
  stroke(context, thick, colour, () => context.rect(thick / 2, thick / 2, width - thick, height - thick));
  context.setLineDash([]);
}

function stroke(context, thick, colour, path) {
  context.lineWidth = thick;
  context.strokeStyle = colour;
  context.beginPath();
  path();
  context.stroke();
}

/** A horizontally centred label, scaled down to fit the width. */
function drawLabel(context, width, y, preferred, text, back, fore) {
  const setSize = (size) => (context.font = `700 ${Math.round(size)}px system-ui, "DejaVu Sans", sans-serif`);
  setSize(preferred);
  const needed = context.measureText(text).width + preferred;
  const size = preferred * Math.min(1, (0.96 * width) / needed);
  setSize(size);
  context.textAlign = "center";
  context.textBaseline = "middle";
  const wide = context.measureText(text).width + size;
  context.fillStyle = back;
  context.fillRect((width - wide) / 2, y - size * 0.8, wide, size * 1.6);
  context.fillStyle = fore;
  context.fillText(text, width / 2, y + size * 0.05);
}
