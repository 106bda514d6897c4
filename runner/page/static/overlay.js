/**
 * Alarms, drawn by the worker into the picture itself: they appear even when the page's main thread is busy.
 * They keep to its rim: a frame, and a label at the upper edge, away from the road. Each has a colour, a word, a mark and a
 * frame of its own: LOST solid with crosses in its corners, FROZEN hatched; DAMAGED dotted and LATE dashed, whose pictures move.
 */

export const RED = "#e01b24";
export const AMBER = "#ffb000";
const MARKS = { lost: "✕", frozen: "■", damaged: "◪", late: "▲" };
// Shares of the shorter side, and CSS px at most: of frames and of words.
const ALARM = { thick: [0.05, 24], text: [0.15, 64] };
const WARNING = { thick: [0.03, 14], text: [0.1, 34] };
const HEAD_PX = 24; // CSS px at the upper edge that a picture's name may cover
const SOLID = [];

/**
 * Draw the alarm or notice of a status over the picture in the canvas.
 * @param {OffscreenCanvasRenderingContext2D} context
 * @param {{x: number, y: number, width: number, height: number}} area the part of the canvas that is on the screen
 * @param {boolean} mirrored whether the canvas is mirrored: text is drawn so that it reads correctly
 * @param {string} status
 * @param {string} text
 * @param {number} css px of the canvas in a CSS px
 */
export function drawOverlay(context, area, mirrored, status, text, css) {
  readably(context, area, mirrored, () => drawStatus(context, area, status, text, css));
}

/** Fill a canvas with what stands for a part of the image that was not sent: no picture looks like it. */
export function drawUnsent(context, width, height) {
  const step = Math.max(8, Math.round(Math.min(width, height) / 12));
  context.fillStyle = "#1d242b";
  context.fillRect(0, 0, width, height);
  context.strokeStyle = "#46525e";
  context.lineWidth = step / 6;
  context.beginPath();
  for (let x = step - height; x < width; x += step) {
    context.moveTo(x, height);
    context.lineTo(x + height, 0);
  }
  context.stroke();
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

function drawStatus(context, { width, height }, status, text, css) {
  const side = Math.min(width, height);
  if (!MARKS[status]) {
    dim(context, width, height, 0.72);
    return drawLabel(context, width, height / 2, side * 0.13, text, "#2b333c", "#e6ebf0");
  }
  const isStalled = status === "frozen" || status === "lost";
  const [thick, size] = Object.values(isStalled ? ALARM : WARNING).map(([share, most]) => Math.min(share * side, most * css));
  if (isStalled) dim(context, width, height, 0.5);
  FRAMES[status](context, width, height, thick);
  const y = Math.min(HEAD_PX * css, 0.35 * height) + 0.8 * size;
  drawLabel(context, width, y, size, `${MARKS[status]} ${text}`, isStalled ? RED : AMBER, isStalled ? "#fff" : "#000");
}

const FRAMES = {
  lost(context, width, height, thick) {
    frame(context, width, height, thick, RED, SOLID);
    for (const x of [1.5 * thick, width - 1.5 * thick]) for (const y of [1.5 * thick, height - 1.5 * thick]) cross(context, x, y, thick);
  },
  frozen(context, width, height, thick) {
    frame(context, width, height, 1.3 * thick, "#000", SOLID);
    hatch(context, width, height, 1.3 * thick);
    frame(context, width, height, 0.3 * thick, RED, SOLID);
  },
  damaged: (context, width, height, thick) => frame(context, width, height, thick, AMBER, [thick, thick]),
  late: (context, width, height, thick) => frame(context, width, height, thick, AMBER, [5 * thick, 2.5 * thick]),
};

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

/** Desaturate and darken the last picture, so that it is not mistaken for a live one. */
function dim(context, width, height, dark) {
  context.globalCompositeOperation = "saturation";
  context.fillStyle = "#000";
  context.fillRect(0, 0, width, height);
  context.globalCompositeOperation = "source-over";
  context.fillStyle = `rgba(0,0,0,${dark})`;
  context.fillRect(0, 0, width, height);
}

/** Stripes in a frame. */
function hatch(context, width, height, thick) {
  context.save();
  context.beginPath();
  context.rect(0, 0, width, height);
  context.rect(thick, thick, width - 2 * thick, height - 2 * thick);
  context.clip("evenodd");
  stroke(context, thick * 0.7, RED, () => {
    for (let x = -height; x < width; x += 2 * thick) {
      context.moveTo(x, height);
      context.lineTo(x + height, 0);
    }
  });
  context.restore();
}

/** A cross on a red ground. */
function cross(context, x, y, size) {
  context.fillStyle = RED;
  context.fillRect(x - 1.5 * size, y - 1.5 * size, 3 * size, 3 * size);
  stroke(context, size * 0.5, "#fff", () => {
    for (const sign of [1, -1]) {
      context.moveTo(x - size, y - sign * size);
      context.lineTo(x + size, y + sign * size);
    }
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
