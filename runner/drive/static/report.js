/** Draws the charts of a report from the data in the page. It loads nothing from elsewhere. */
"use strict";

/** An element of the page; the page has every element that is looked up. */
const byId = (id) => /** @type {HTMLElement} */ (document.getElementById(id));
/**
 * The charts as runner/drive/figures.py describes them, converted to plotly's traces.
 * @typedef {{title: string, low: number, high: number, marks: number[], log: boolean, percent: boolean}} Axis
 * @typedef {{label: string, x: number[], y: (number|null)[], colour: number|string, dash: number, width: number, steps: boolean,
 *   filled: boolean, points: boolean, around: number[][]|null, why: string[]|null}} Curve
 * @typedef {{label: string, colour: number, spans: [number, number][]}} Bars
 * @typedef {{way: number[][], t: number[], east: number[], north: number[], values: number[], low: number, high: number,
 *   title: string, arrows: number[][]}} Track
 * @typedef {{x: Axis, y: Axis, drive: number|null, unit_s: number, hover: string, curves: Curve[],
 *   shades: Bars[], strip: {bars: Bars[], none: string}|null, track: Track|null}} Chart
 * @type {{day: string[], night: string[], charts: Chart[]}}
 */
const data = JSON.parse(byId("data").textContent ?? "");
const KEY = "tod-report-theme";
const DASHES = ["solid", "6px,2px", "2px,2px", "7px,2px,2px,2px"];
const SHADE = 0.2; // opacity
const MIN_VISIBLE = 0.004; // of the axis: the smallest visible width of a freeze
const VIRIDIS = ["#440154", "#482878", "#3e4a89", "#31688e", "#26828e", "#1f9e89", "#35b779", "#6ece58", "#b5de2b", "#fde725"];

const root = document.documentElement;
const isDay = () => root.dataset.theme === "day";
const themed = (name) => getComputedStyle(root).getPropertyValue(`--${name}`).trim();
// Escapes texts of the drive for plotly's labels, which interpret some HTML.
const ENTITIES = { "&": "&amp;", "<": "&lt;", ">": "&gt;" };
const plain = (text) => String(text).replace(/[&<>]/g, (c) => ENTITIES[c] ?? c).replaceAll("\n", "<br>");

/** Colour of a camera's index in the palette, or of a name in the style sheet. */
function colourOf(colour) {
  if (typeof colour === "string") return themed(colour);
  const colours = isDay() ? data.day : data.night;
  return colours[colour % colours.length];
}

/** The scale without colours too close to the background: the lightest by day, the darkest by night. */
function viridis() {
  const shown = isDay() ? VIRIDIS.slice(0, -1) : VIRIDIS.slice(2);
  return shown.map((colour, i) => [i / (shown.length - 1), colour]);
}

// --- traces -----------------------------------------------------------------------------------------------------------

/** @param {Curve} curve  @param {string} hover of a value */
function traces(curve, hover) {
  const { label, x, y, steps, filled, points, around, why } = curve;
  const colour = colourOf(curve.colour);
  const name = plain(label);
  const shape = steps ? "hv" : "linear";
  const base = { type: "scatter", mode: "lines", x, legendgroup: name };
  const trace = {
    ...base,
    ...(points ? { mode: "markers", marker: { color: colour, size: 6, opacity: 0.6 } } : {}),
    y, name, hovertemplate: why ? "%{text}<extra></extra>" : `${hover} ${name}<extra></extra>`, text: why?.map(plain),
    line: { color: colour, width: filled ? 0 : 1.6 * curve.width, dash: DASHES[curve.dash % DASHES.length], shape },
    ...(filled ? { fill: "tozeroy", fillcolor: `${colour}99` } : {}),
  };
  const side = { ...base, showlegend: false, hoverinfo: "skip", line: { width: 0 } };
  const range = (around ?? []).map((values, i) => ({ ...side, y: values, ...(i ? { fill: "tonexty", fillcolor: `${colour}40` } : {}) }));
  return [...range, trace];
}

/** @param {Bars} bars  @param {Axis} x  @param {number} unit_s */
function freezes({ label, colour, spans }, x, unit_s) {
  const least = MIN_VISIBLE * (x.high - x.low);
  const name = plain(label);
  return {
    type: "bar", orientation: "h", yaxis: "y2", name, showlegend: false,
    base: spans.map(([t]) => t), x: spans.map(([, s]) => Math.max(s, least)),
    y: spans.map(() => name), marker: { color: colourOf(colour), line: { width: 0 } }, hoverinfo: "text", textposition: "none",
    hovertext: spans.map(([t, s]) => `${name} froze at ${(t * unit_s).toFixed(1)} s for ${(s * unit_s).toFixed(2)} s`),
  };
}

/**
 * The track, the values on it, arrows, its ends, and the position at the pointer.
 * @param {Track} track
 * @param {string} hover of a value
 */
function mapTraces({ way: [x, y], t, east, north, values, low, high, title, arrows }, hover) {
  const small = { outlinewidth: 0, tickfont: { size: 12 }, nticks: 6 };
  const bar = { title: { text: title, side: "right", font: { size: 13 } }, thickness: 12, ...small };
  const markers = { type: "scatter", mode: "markers", hoverinfo: "skip" };
  const outlined = { color: themed("panel"), line: { width: 2.5, color: themed("text") } };
  const end = (at, symbol, name) => ({ ...markers, x: [x.at(at)], y: [y.at(at)], name, marker: { ...outlined, symbol, size: 13 } });
  const angle = arrows.map(([, , degrees]) => 90 - degrees); // plotly's go clockwise from north
  return [
    { type: "scatter", mode: "lines", x, y, name: "way", showlegend: false, hoverinfo: "skip", line: { color: themed("line"), width: 2 } },
    { ...markers, x: east, y: north, customdata: t, name: "track", showlegend: false, hoverinfo: undefined,
      marker: { color: values, cmin: low, cmax: high, colorscale: viridis(), size: 7, colorbar: bar },
      hovertemplate: `%{customdata:.1f} s: ${hover}<br>%{x:.0f} m east, %{y:.0f} m north<extra></extra>` },
    { ...markers, x: arrows.map(([each]) => each), y: arrows.map(([, each]) => each), name: "direction", showlegend: false,
      marker: { ...outlined, symbol: "triangle-up", size: 11, angle, line: { ...outlined.line, width: 1.5 } } },
    end(0, "circle", "start"), end(-1, "square", "end"),
    {
      ...markers, x: [], y: [], name: "position at the pointer", showlegend: false,
      marker: { symbol: "circle-open", size: 22, color: themed("text"), line: { width: 4 } },
    },
  ];
}

// --- axes -------------------------------------------------------------------------------------------------------------

/** @param {Axis} axis */
function axisOf({ title, low, high, marks, log, percent }) {
  return {
    title: { text: plain(title), standoff: 8, font: { size: 13 } }, gridcolor: themed("grid"), linecolor: themed("line"), zeroline: false,
    tickfont: { size: 12 }, automargin: true, type: log ? "log" : "linear", range: log ? [Math.log10(low), Math.log10(high)] : [low, high],
    ...(marks.length ? { tickvals: marks } : {}), ...(percent ? { tickformat: ".0%" } : {}),
  };
}

/** Spans over the whole height. @param {Chart} chart */
function shapesOf({ shades }) {
  const shade = ({ colour, spans }) => spans.map(([t, s]) => ({
    type: "rect", xref: "x", yref: "paper", x0: t, x1: t + s, y0: 0, y1: 1, layer: "below", opacity: SHADE,
    fillcolor: colourOf(colour), line: { width: 0 },
  }));
  return shades.flatMap(shade);
}

/** Layout of the freezes, which have their own rows below the curves. @param {Chart} chart */
function stripOf({ strip, x, y }) {
  if (!strip) return {};
  const rows = strip.bars.length;
  const height = Math.min(0.4, 0.06 + 0.055 * rows);
  const none = {
    text: plain(strip.none), showarrow: false, xref: "paper", yref: "paper", x: 0.5, y: 0.03,
    font: { size: 12, color: themed("muted") },
  };
  return {
    xaxis: { ...axisOf(x), anchor: "free", position: 0 },
    yaxis: { ...axisOf(y), domain: [height + 0.08, 1] },
    yaxis2: { domain: [0, height], type: "category", dtick: 1, automargin: true, tickfont: { size: rows > 4 ? 9 : 11 }, visible: rows > 0 },
    annotations: rows ? [] : [none], bargap: 0.2, barmode: "overlay",
  };
}

// --- drawing ----------------------------------------------------------------------------------------------------------

/** @type {any[]} elements that plotly draws into, in the order of the data */
const charts = [...document.querySelectorAll(".chart")];
const config = { displaylogo: false, responsive: true, modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d"] };

function draw(element) {
  const chart = data.charts[charts.indexOf(element)];
  const { x, y, hover, curves, strip, track, unit_s } = chart;
  const drawn = [
    ...(track ? mapTraces(track, hover) : []),
    ...curves.flatMap((curve) => traces(curve, hover)),
    ...(strip?.bars ?? []).map((bars) => freezes(bars, x, unit_s)),
  ];
  const overTime = chart.drive !== null && !track;
  const layout = {
    autosize: true, margin: { l: 56, r: 12, t: 26, b: 44 }, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
    font: { family: "system-ui, DejaVu Sans, sans-serif", size: 12, color: themed("text") },
    hovermode: overTime && hover && !strip ? "x unified" : "closest", hoverdistance: hover && !track ? 20 : 60,
    hoverlabel: { font: { size: 12, color: themed("text") }, bgcolor: themed("raised"), bordercolor: themed("line"), align: "left" },
    showlegend: true, legend: { orientation: "h", x: 0, y: 1, xanchor: "left", yanchor: "bottom", font: { size: 12 } },
    modebar: { color: themed("muted"), activecolor: themed("accent"), bgcolor: "rgba(0,0,0,0)", orientation: "v" },
    xaxis: axisOf(x), yaxis: { ...axisOf(y), ...(track ? { scaleanchor: "x" } : {}) }, shapes: shapesOf(chart), ...stripOf(chart),
  };
  Plotly.react(element, drawn, layout, config);
  if (element.dataset.drawn) return;
  element.dataset.drawn = "yes";
  if (overTime) element.on("plotly_hover", ({ points }) => markPosition(chart, points[0].x));
}

/** Marks the vehicle's position on the map at a time of a chart. */
function markPosition({ drive, unit_s }, at) {
  const index = data.charts.findIndex((each) => each.track && each.drive === drive);
  const track = data.charts[index]?.track;
  const map = charts[index];
  if (!track || !map?.data || typeof at !== "number") return;
  let now = track.t.findIndex((each) => each >= at * unit_s);
  if (now < 0) now = track.t.length - 1;
  Plotly.restyle(map, { x: [[track.east[now]]], y: [[track.north[now]]] }, [map.data.length - 1]);
}

/** Draw one chart after the other, so that the page is never blocked. */
function drawAll() {
  for (const [i, element] of charts.entries()) setTimeout(draw, i * 5, element);
}

// --- day and night ----------------------------------------------------------------------------------------------------

const light = matchMedia("(prefers-color-scheme: light)");
const button = byId("theme");

/** Read the stored theme, or store one; a page opened from a file may have no storage. */
function storedTheme(value) {
  try {
    if (value) localStorage.setItem(KEY, value);
    return localStorage.getItem(KEY);
  } catch {
    return value ?? null;
  }
}

function show(theme) {
  root.dataset.theme = theme;
  button.textContent = theme === "day" ? "Night" : "Day";
  drawAll();
}

button.addEventListener("click", () => {
  const theme = isDay() ? "night" : "day";
  storedTheme(theme);
  show(theme);
});
light.addEventListener("change", () => show(storedTheme() ?? (light.matches ? "day" : "night")));
addEventListener("beforeprint", () => show("day"));
show(storedTheme() ?? (light.matches ? "day" : "night"));
