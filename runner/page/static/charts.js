/** Charts of the last five minutes and the map. Plotly is large: it loads after the first pictures. */

import { factorAxis, ticksWithin, timeAxis } from "./axes.js";
import { listen, store } from "./store.js";
import { colourOf, themed } from "./colours.js";
import { metres, rangeOf } from "./track.js";
import { byId, displayName, factor, make } from "./format.js";

const SETTLE_MS = 3000; // after the first picture: while the charts load, controls do not answer for most of a second
const AT_LATEST_MS = 5000; // if no picture is live by then
const MARGIN = { l: 58, r: 10, t: 6, b: 40 }; // px around the axes
const LEAST_PX = 70; // Plotly cannot place the axes in a lower chart; the rest is clipped
const BETWEEN_MS = 60; // from one chart to the next, to avoid long tasks

const visible = new Set();
let isLoading = false;
let isSettled = false;

// --- traces -----------------------------------------------------------------------------------------------------------

const relativeTimes = () => {
  const { time } = store.series;
  const now = time.at(-1) ?? 0;
  return time.map((each) => each - now);
};

const line = (x, y, name, colour, more = {}) =>
  ({
    type: "scatter", mode: "lines", x, y, name, line: { color: colour, width: 2, ...more },
    hovertemplate: `%{y:.6~g} ${name}<extra></extra>`,
  });

function totals() {
  const { predicted_kbps, allocated_kbps, actual_kbps } = store.series;
  const x = relativeTimes();
  return [
    line(x, predicted_kbps, "predicted", themed("predicted"), { dash: "dash", shape: "hv" }),
    line(x, allocated_kbps, "allocated", themed("allocated"), { shape: "hv" }),
    line(x, actual_kbps, "received", themed("actual")),
  ];
}

function cameras() {
  const x = relativeTimes();
  return perCamera((name, columns, colour, width) => [
    line(x, columns.allocated_kbps, `${displayName(name)} allocated`, colour, { dash: "dot", width: width * 0.7, shape: "hv" }),
    line(x, columns.kbps, `${displayName(name)} received`, colour, { width }),
  ]);
}

function factors() {
  const x = relativeTimes();
  return perCamera((name, { scaling }, colour, width) => [line(x, scaling, displayName(name), colour, { shape: "hv", width })]);
}

/** Traces of all cameras, the selected one last and thicker. */
function perCamera(traces) {
  const names = Object.keys(store.series.cameras);
  const order = [...names.filter((name) => name !== store.selected), ...names.filter((name) => name === store.selected)];
  return order.flatMap((name) =>
    traces(name, store.series.cameras[name], colourOf(names.indexOf(name)), name === store.selected ? 3 : 1.5));
}

function drive() {
  const points = metres(store.series);
  if (!points) return [];
  const { x, y, kbps } = points;
  const ends = [...new Set(rangeOf(kbps) ?? [])]; // more do not fit
  const bar = { title: { text: "kbit/s", side: "right" }, thickness: 10, outlinewidth: 0, ypad: 0, tickfont: { size: 12 },
    tickvals: ends, ticktext: ends.map((value) => value.toFixed()) };
  return [
    { type: "scatter", mode: "markers", x, y, marker: { color: kbps, colorscale: "Viridis", size: 7, colorbar: bar },
      hovertemplate: "%{x:.0f} m east, %{y:.0f} m north<br>%{marker.color:.0f} kbit/s<extra></extra>" },
    { type: "scatter", mode: "markers", x: [x.at(-1)], y: [y.at(-1)], hovertemplate: "now<extra></extra>",
      marker: { symbol: "circle-open", size: 18, color: themed("text"), line: { width: 3 } } },
  ];
}

// --- layouts ----------------------------------------------------------------------------------------------------------

const axis = (title, more = {}) => ({
  title: { text: title, standoff: 6, font: { size: 12 } }, gridcolor: themed("grid"), linecolor: themed("grid"), zeroline: false,
  tickfont: { size: 12 }, fixedrange: true, ...more,
});

function base(x, y, more = {}) {
  return {
    autosize: true, margin: MARGIN, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
    font: { family: "system-ui, DejaVu Sans, sans-serif", size: 12, color: themed("text") }, xaxis: x, yaxis: y,
    showlegend: false, hovermode: "closest", hoverlabel: { font: { size: 12 } }, ...more,
  };
}

const time = () => axis("seconds before now", { ...timeAxis(-(relativeTimes()[0] ?? 0)), tickangle: 0 });

/** @param {number} high px of the axis */
const rates = (high) => axis("kbit/s", { rangemode: "tozero", nticks: ticksWithin(high) });

/** @param {number} high px of the axis */
function factorsAxis(high) {
  const highest = Math.max(0, ...Object.values(store.series.cameras).flatMap(({ scaling }) => scaling.map((each) => each ?? 0)));
  const { range, ticks } = factorAxis(store.hello?.cameras ?? [], highest, high);
  return axis("factor", { range, tickvals: ticks, ticktext: ticks.map(factor) });
}

/** @param {number} high px of its axis */
function mapLayout(high) {
  const empty = metres(store.series) === null;
  const annotations = empty
    ? [{ text: "no position yet", showarrow: false, xref: "paper", yref: "paper", x: 0.5, y: 0.5, font: { size: 15 } }]
    : [];
  return base(axis("m east"), axis("m north", { scaleanchor: "x", nticks: ticksWithin(high) }), { annotations });
}

const charts = [
  { id: "chart-totals", traces: totals, layout: (high) => base(time(), rates(high)) },
  { id: "chart-cameras", traces: cameras, layout: (high) => base(time(), rates(high)) },
  { id: "chart-factors", traces: factors, layout: (high) => base(time(), factorsAxis(high)) },
  { id: "chart-map", traces: drive, layout: mapLayout },
];
const config = { displaylogo: false, displayModeBar: false, responsive: false, doubleClick: false };

// --- drawing ----------------------------------------------------------------------------------------------------------

function draw(chart) {
  const element = byId(chart.id);
  if (!globalThis.Plotly || !visible.has(chart.id) || document.hidden || !element.clientHeight) return;
  const size = { width: element.clientWidth, height: Math.max(LEAST_PX, element.clientHeight), autosize: false };
  Plotly.react(element, chart.traces(), { ...chart.layout(size.height - MARGIN.t - MARGIN.b), ...size }, config);
  document.getElementById("js-plotly-tester")?.setAttribute("aria-hidden", "true"); // Plotly measures text in it
}

function drawAll() {
  for (const [i, chart] of charts.entries()) setTimeout(draw, i * BETWEEN_MS, chart);
}

/** Once the first pictures are settled and a chart is on the screen: in the Drive view none is until its drawer opens. */
function loadPlotly() {
  if (isLoading || !isSettled || !visible.size) return;
  isLoading = true;
  const script = make("script", { src: "/plotly.js" });
  script.addEventListener("load", () => {
    drawAll();
    setInterval(drawAll, 1000);
  });
  const failed = "charts are not available: /plotly.js failed to load";
  script.addEventListener("error", () => charts.forEach(({ id }) => byId(id).replaceChildren(failed)));
  document.head.append(script);
}

function settle() {
  isSettled = true;
  loadPlotly();
}

function showLegend() {
  const entries = (store.hello?.cameras ?? []).map(({ name }, i) => {
    const swatch = make("span", { class: "swatch", style: `background:${colourOf(i)}` });
    return make("span", {}, swatch, displayName(name));
  });
  byId("legend").replaceChildren(...entries);
}

export function startCharts() {
  const observer = new IntersectionObserver((entries) => {
    for (const { target, isIntersecting } of entries) {
      if (isIntersecting) visible.add(target.id);
      else visible.delete(target.id);
      if (isIntersecting) draw(charts.find(({ id }) => id === target.id));
    }
    loadPlotly();
  });
  for (const { id } of charts) observer.observe(byId(id));
  let isLive = false;
  listen("status", ({ status }) => {
    if (isLive || status !== "live") return;
    isLive = true;
    setTimeout(settle, SETTLE_MS);
  });
  setTimeout(settle, AT_LATEST_MS);
  listen("hello theme", showLegend);
  listen("theme selected", drawAll);
  new ResizeObserver(drawAll).observe(byId("side"));
}
