/** The small map of the Drive view: the drive so far around the vehicle, north up, coloured by what was received. */

import { listen, store } from "./store.js";
import { colourOfRate, metres, rangeOf } from "./track.js";
import { byId, rate, whole } from "./format.js";

const ACROSS_M = 250; // of the shorter side
const BAR_M = 50; // the length that the scale bar shows
const LINE_PX = 5;
const ARROW_PX = 11;
const NORTH = 4; // of the word in the corner, and margins, of the size of text
const [TEXT, MUTED, UNKNOWN] = ["#e8edf2", "#a5b3c1", "#76879a"];

const canvas = /** @type {HTMLCanvasElement} */ (byId("drive-map").firstElementChild);
let size = { width: 0, height: 0 }; // CSS px; 0: it is not shown
let drawn = 0; // time of the newest position drawn

/** Size of text, px: it grows with the map. */
const em = () => Math.max(12, Math.round(0.035 * size.width));

function draw() {
  const context = canvas.getContext("2d");
  if (!context || !size.width) return;
  const ratio = devicePixelRatio;
  const [width, height] = [size.width * ratio, size.height * ratio].map(Math.round);
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, size.width, size.height);
  context.font = `${em()}px system-ui, "DejaVu Sans", sans-serif`;
  const track = metres(store.series);
  if (!track) return write(context, "no position yet", size.width / 2, size.height / 2, "center");
  const px_per_m = Math.min(size.width, size.height) / ACROSS_M;
  drawTrack(context, track, px_per_m);
  drawVehicle(context);
  drawScale(context, px_per_m);
  drawLegend(context, rangeOf(track.kbps));
}

function drawTrack(context, { x, y, kbps }, px_per_m) {
  const range = rangeOf(kbps);
  const at = (i) => [size.width / 2 + (x[i] - (x.at(-1) ?? 0)) * px_per_m, size.height / 2 - (y[i] - (y.at(-1) ?? 0)) * px_per_m];
  Object.assign(context, { lineWidth: LINE_PX, lineCap: "round" });
  for (let i = 1; i < x.length; i++) {
    const received = kbps[i];
    context.strokeStyle = received === null || !range ? UNKNOWN : colourOfRate(received, range);
    context.beginPath();
    context.moveTo(...at(i - 1));
    context.lineTo(...at(i));
    context.stroke();
  }
}

/** An arrow by its heading, or a ring while that is unknown. */
function drawVehicle(context) {
  const heading = store.sample?.position?.heading_deg;
  context.save();
  context.translate(size.width / 2, size.height / 2);
  context.beginPath();
  if (heading === undefined) context.arc(0, 0, ARROW_PX * 0.7, 0, 2 * Math.PI);
  else {
    context.rotate((heading * Math.PI) / 180);
    for (const [x, y] of [[0, -1.2], [0.8, 1], [0, 0.6], [-0.8, 1]]) context.lineTo(x * ARROW_PX, y * ARROW_PX);
    context.closePath();
    context.fillStyle = TEXT;
    context.fill();
  }
  Object.assign(context, { lineWidth: 2, strokeStyle: heading === undefined ? TEXT : "#000" });
  context.stroke();
  context.restore();
}

function drawScale(context, px_per_m) {
  const [x, y] = [8, size.height - 8];
  context.fillStyle = MUTED;
  context.fillRect(x, y, BAR_M * px_per_m, 2);
  write(context, `${BAR_M} m`, x, y - 5, "start");
  write(context, "N ↑", size.width - 8, 1.3 * em(), "end");
}

/** What the colours mean, beside or below the north. @param {[number, number]|null} range */
function drawLegend(context, range) {
  if (!range) return;
  const text = `received ${whole(range[0])} to ${rate(range[1])}`;
  const wide = context.measureText(text).width;
  const y = (wide + NORTH * em() > size.width ? 3 : 1.3) * em();
  write(context, text, 8, y, "start");
  for (let at = 0; at < wide; at++) {
    context.fillStyle = colourOfRate(at, [0, wide]);
    context.fillRect(8 + at, y + 0.4 * em(), 1.5, 0.3 * em());
  }
}

function write(context, text, x, y, align) {
  Object.assign(context, { fillStyle: MUTED, textAlign: align });
  context.fillText(text, x, y);
}

/** Positions are kept once a second. */
function onSample() {
  const newest = store.series.time.at(-1) ?? 0;
  if (newest === drawn) return;
  drawn = newest;
  draw();
}

export function startDriveMap() {
  new ResizeObserver(([{ contentRect: { width, height } }]) => {
    size = { width, height };
    draw();
  }).observe(byId("drive-map"));
  listen("sample history", onSample);
}
