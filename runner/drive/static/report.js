/** Draws the charts of a report from the data in the page. Nothing is loaded from anywhere. */
"use strict";

const data = JSON.parse(document.getElementById("data").textContent);
const KEY = "tod-report-theme";
const DASHES = ["solid", "6px,2px", "2px,2px", "7px,2px,2px,2px"]; // by place in a panel
const APART = 0.014; // of the axis, between steps that would lie on one another
const WIDE = 8; // latencies that spread over more than this ratio get a logarithmic axis
const VIRIDIS = ["#440154", "#482878", "#3e4a89", "#31688e", "#26828e", "#1f9e89", "#35b779", "#6ece58", "#b5de2b", "#fde725"];

const root = document.documentElement;
const isDay = () => root.dataset.theme === "day";
const themed = (name) => getComputedStyle(root).getPropertyValue(`--${name}`).trim();
const known = (values) => values.filter((value) => value !== null);
// Texts of the drive are shown in plotly's labels, which know a little HTML.
const plain = (text) => String(text).replace(/[&<>]/g, (c) => ({ "&": "&amp;", "<": "&lt;", ">": "&gt;" })[c]);

const colourOf = (drive, name) => {
  const colours = isDay() ? data.day : data.night;
  return colours[Object.keys(drive.cameras).indexOf(name) % colours.length];
};

/** What is not seen on the ground is left out: the lightest by day, the darkest by night. */
function viridis() {
  const shown = isDay() ? VIRIDIS.slice(0, -1) : VIRIDIS.slice(2);
  return shown.map((colour, i) => [i / (shown.length - 1), colour]);
}

const line = (points, name, colour, more = {}, hover = `%{y:,.0f} kbit/s ${plain(name)}<extra></extra>`) =>
  ({ type: "scatter", mode: "lines", x: points.t, y: points.y, name: plain(name), hovertemplate: hover, line: { color: colour, width: 1.6, ...more } });

// --- figures: traces and layout of each -------------------------------------------------------------------------------

const axis = (title, more = {}) => ({
  title: { text: title, standoff: 8, font: { size: 13 } }, gridcolor: themed("grid"), linecolor: themed("line"), zeroline: false,
  tickfont: { size: 12 }, automargin: true, ...more,
});

const time = (more = {}) => axis("time in s", { range: [0, data.end], ...more });
const hold = { shape: "hv" };

/** An axis of latencies, logarithmic where they spread: plotly's own numbers on it leave digits out. */
function spread(title, low, high, more = {}) {
  const log = low > 0 && high / low > WIDE;
  const marks = [-1, 0, 1, 2, 3, 4, 5].flatMap((power) => [1, 2, 5].map((digit) => digit * 10 ** power));
  const range = log ? [Math.log10(low * 0.95), Math.log10(high * 1.05)] : [Math.min(0, low), high * 1.05];
  return axis(title, { range, type: log ? "log" : "linear", ...(log ? { tickvals: marks } : {}), ...more });
}

function totals(drive) {
  const traces = [];
  if (drive.link) {
    traces.push({ ...line(drive.link, "link's rate", themed("link"), { ...hold, width: 0 }), fill: "tozeroy", fillcolor: `${themed("link")}99` });
  }
  traces.push(line(drive.allocated, "allocated", themed("allocated"), { ...hold, width: 3 }));
  traces.push(line(drive.predicted, "predicted", themed("predicted"), { ...hold, dash: "dash" }));
  if (drive.measured) traces.push(line(drive.actual, drive.measured, themed("actual"), { width: 1.2 }));
  return { traces, layout: { xaxis: time(), yaxis: axis("total in kbit/s", { range: [0, most((d) => [d.predicted, d.allocated, d.actual, d.link])] }) } };
}

/** The largest value of some lines of all drives, with some room: axes are shared. */
function most(lines) {
  let top = 0;
  for (const drive of data.drives) {
    for (const each of lines(drive)) for (const value of each ? each.y : []) if (value > top) top = value;
  }
  return top * 1.05 || 1;
}

const ofPanel = (part, key) => (drive) => (drive.panels[part] ?? []).map((name) => drive.cameras[name][key]);

function bitrates(drive, part) {
  const traces = drive.panels[part].map((name, i) =>
    line(drive.cameras[name].actual, name, colourOf(drive, name), { dash: DASHES[i % 4] }));
  const title = `${drive.measured || "actual"} bitrate in kbit/s`;
  return { traces, layout: { xaxis: time(), yaxis: axis(title, { range: [0, most(ofPanel(part, "actual"))] }), hovermode: "x unified" } };
}

function scaling(drive, part) {
  const names = drive.panels[part];
  const all = data.drives.flatMap((d) => ofPanel(part, "factor")(d).flatMap(({ y }) => known(y)));
  const marks = [...new Set(all)].sort((a, b) => a - b);
  const top = marks.at(-1) ?? 1;
  const traces = names.map((name, i) => {
    const { t, y, why } = drive.cameras[name].factor;
    const offset = ((names.length - 1) / 2 - i) * APART * top;
    const shifted = y.map((factor) => (factor === null ? null : factor + offset));
    const trace = line({ t, y: shifted }, name, colourOf(drive, name), { ...hold, dash: DASHES[i % 4] }, "%{text}<extra></extra>");
    trace.text = why.map((each, k) => `<b>${plain(name)}</b> from ${t[k].toFixed(1)} s: ${y[k] === null ? "off" : y[k]}<br>${plain(each)}`);
    return trace;
  });
  const range = [Math.max(0, (marks[0] ?? 0) - 0.2 * top), top * 1.12];
  return { traces, layout: { xaxis: time(), yaxis: axis("resolution factor", { tickvals: marks, range }), hovermode: "closest", hoverdistance: 60 } };
}

function quality(drive, part) {
  const shown = drive.panels[part].filter((name) => drive.cameras[name].quality);
  const traces = shown.map((name) =>
    line(drive.cameras[name].quality, name, colourOf(drive, name), { dash: DASHES[drive.panels[part].indexOf(name) % 4] }, `%{y:.4~g} ${plain(name)}<extra></extra>`));
  const values = data.drives.flatMap((d) => Object.values(d.cameras).flatMap((camera) => (camera.quality ? known(camera.quality.y) : [])));
  const [low, high] = extent(values);
  const room = 0.05 * (high - low || 1);
  return { traces, layout: { xaxis: time(), yaxis: axis(`estimated ${data.metric}`, { range: [low - room, high + room] }), hovermode: "x unified" } };
}

function extent(values) {
  let [low, high] = [Infinity, -Infinity];
  for (const value of values) [low, high] = [Math.min(low, value), Math.max(high, value)];
  return [low, high];
}

const latency = (drive, part) => (part === 0 ? latencyOverTime(drive) : distribution(drive));

function latencyOverTime(drive) {
  const { t, median, p95, freezes, watched } = drive.latency;
  const [low, high] = extent(data.drives.flatMap((d) => known([...d.latency.median, ...d.latency.p95])));
  const hover = (name) => `%{y:.0f} ms ${name}<extra></extra>`;
  const traces = [
    line({ t, y: p95 }, "95th percentile", themed("late"), {}, hover("95th percentile")),
    line({ t, y: median }, "median", themed("allocated"), {}, hover("median")),
  ];
  const frozen = [...new Set(freezes.map(({ camera }) => camera))];
  for (const name of frozen) {
    const own = freezes.filter(({ camera }) => camera === name);
    traces.push({
      type: "bar", orientation: "h", yaxis: "y2", name: plain(name), showlegend: false, base: own.map((f) => f.t), x: own.map((f) => Math.max(f.s, data.end * 0.004)),
      y: own.map(() => plain(name)), marker: { color: colourOf(drive, name), line: { width: 0 } },
      hovertext: own.map((f) => `${plain(name)} froze at ${f.t.toFixed(1)} s for ${f.s.toFixed(2)} s`), hoverinfo: "text", textposition: "none",
    });
  }
  const strip = Math.min(0.4, 0.06 + 0.055 * frozen.length);
  const said = watched ? "no freezes" : "arrivals were not logged: freezes are not known";
  const annotations = frozen.length ? [] : [{ text: said, showarrow: false, xref: "paper", yref: "paper", x: 0.5, y: 0.03, font: { size: 12, color: themed("muted") } }];
  const yaxis = spread("latency in ms", low, high, { domain: [strip + 0.08, 1] });
  const yaxis2 = axis("", { domain: [0, strip], type: "category", dtick: 1, tickfont: { size: frozen.length > 4 ? 9 : 11 }, visible: frozen.length > 0 });
  return { traces, layout: { xaxis: time({ anchor: "free", position: 0 }), yaxis, yaxis2, annotations, bargap: 0.2, barmode: "overlay", hovermode: "closest" } };
}

function distribution(drive) {
  const several = data.drives.length > 1;
  const hover = (name) => `%{x:.0f} ms or less: %{y:.1%} of the frames, ${plain(name)}<extra></extra>`;
  const colours = isDay() ? data.day : data.night;
  const curve = (x, name, colour, more) => line({ t: x, y: drive.shares }, name, colour, more, hover(name));
  const traces = several
    ? data.drives.filter((d) => d.latency.all.length).map((d, i) => curve(d.latency.all, d.label, colours[i % colours.length], { dash: DASHES[i % 4], width: 2 }))
    : Object.entries(drive.cameras).filter(([, camera]) => camera.latency.length).map(([name, camera]) => curve(camera.latency, name, colourOf(drive, name)));
  if (!several) traces.push(curve(drive.latency.all, "all cameras", themed("text"), { dash: "dash", width: 2.4 }));
  const [low, high] = extent(data.drives.flatMap((d) => d.latency.all.slice(0, -1)));
  const of = data.drives.some((d) => d.latency.of === "arrival") ? "arrival" : "decode";
  const xaxis = spread(`latency from capture to ${of} in ms`, low, high);
  return { traces, layout: { xaxis, yaxis: axis("share of frames", { range: [0, 1.01], tickformat: ".0%", tickvals: [0, 0.25, 0.5, 0.75, 0.95] }) } };
}

function bitrate_on_track(drive) {
  const { t, x, y, kbps, way } = drive.track;
  const tracks = data.drives.filter((d) => d.track).flatMap((d) => known(d.track.kbps));
  const [cmin, cmax] = extent(tracks);
  const bar = { title: { text: "kbit/s", side: "top", font: { size: 13 } }, thickness: 12, outlinewidth: 0, tickfont: { size: 12 }, nticks: 6 };
  const mark = (at, symbol, name) => ({
    type: "scatter", mode: "markers", x: [way.x.at(at)], y: [way.y.at(at)], name, hoverinfo: "skip",
    marker: { symbol, size: 13, color: themed("panel"), line: { width: 2.5, color: themed("text") } },
  });
  const here = { type: "scatter", mode: "markers", x: [], y: [], name: "where you point at", showlegend: false, hoverinfo: "skip", marker: { symbol: "circle-open", size: 22, color: themed("text"), line: { width: 4 } } };
  const traces = [
    { type: "scatter", mode: "lines", ...way, name: "way", showlegend: false, hoverinfo: "skip", line: { color: themed("line"), width: 2 } },
    { type: "scatter", mode: "markers", x, y, customdata: t, name: "track", showlegend: false,
      marker: { color: kbps, cmin, cmax, colorscale: viridis(), size: 7, colorbar: bar },
      hovertemplate: "%{customdata:.1f} s: %{marker.color:,.0f} kbit/s<br>%{x:.0f} m east, %{y:.0f} m north<extra></extra>" },
    arrows(way.x, way.y), mark(0, "circle", "start"), mark(-1, "square", "end"), here,
  ];
  return { traces, layout: { xaxis: axis("m east of the start"), yaxis: axis("m north of the start", { scaleanchor: "x" }), hovermode: "closest" } };
}

/** Small arrows along the way, every eighth of it. */
function arrows(x, y) {
  const way = [0];
  for (let i = 1; i < x.length; i++) way.push(way[i - 1] + Math.hypot(x[i] - x[i - 1], y[i] - y[i - 1]));
  const at = (share) => Math.max(1, way.findIndex((each) => each >= share * way.at(-1)));
  const where = way.at(-1) > 20 ? [1, 2, 3, 4, 5, 6, 7].map((k) => at(k / 8)) : [];
  const back = (i) => Math.max(0, way.findIndex((each) => each >= way[i] - 0.01 * way.at(-1)));
  const angle = where.map((i) => 90 - (Math.atan2(y[i] - y[back(i)], x[i] - x[back(i)]) * 180) / Math.PI);
  return {
    type: "scatter", mode: "markers", x: where.map((i) => x[i]), y: where.map((i) => y[i]), name: "direction", showlegend: false, hoverinfo: "skip",
    marker: { symbol: "triangle-up", size: 11, angle, color: themed("panel"), line: { width: 1.5, color: themed("text") } },
  };
}

const figures = { bitrate_on_track, totals, bitrates, scaling, latency, quality };

// --- when they draw ---------------------------------------------------------------------------------------------------

const charts = [...document.querySelectorAll(".chart")];
const config = { displaylogo: false, responsive: true, modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d"] };

function draw(chart) {
  const { figure, drive, part } = chart.dataset;
  const { traces, layout } = figures[figure](data.drives[drive], Number(part));
  const base = {
    autosize: true, margin: { l: 56, r: 12, t: 26, b: 44 }, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
    font: { family: "system-ui, DejaVu Sans, sans-serif", size: 12, color: themed("text") }, hovermode: "x unified",
    hoverlabel: { font: { size: 12, color: themed("text") }, bgcolor: themed("raised"), bordercolor: themed("line"), align: "left" },
    showlegend: true, legend: { orientation: "h", x: 0, y: 1, xanchor: "left", yanchor: "bottom", font: { size: 12 } },
    modebar: { color: themed("muted"), activecolor: themed("accent"), bgcolor: "rgba(0,0,0,0)", orientation: "v" },
  };
  Plotly.react(chart, traces, { ...base, ...layout }, config);
  if (chart.dataset.drawn) return;
  chart.dataset.drawn = "yes";
  if (figure !== "bitrate_on_track" && !(figure === "latency" && part === "1")) chart.on("plotly_hover", ({ points }) => point(drive, points[0].x));
}

/** Marks on the map where the vehicle was at a time. */
function point(drive, t) {
  const map = document.querySelector(`.bitrate_on_track[data-drive="${drive}"]`);
  const track = data.drives[drive].track;
  if (!map?.data || !track || typeof t !== "number") return;
  let at = track.t.findIndex((each) => each >= t);
  if (at < 0) at = track.t.length - 1;
  Plotly.restyle(map, { x: [[track.x[at]]], y: [[track.y[at]]] }, [map.data.length - 1]);
}

/** One after the other, so that the page is never stuck. */
function drawAll() {
  for (const [i, chart] of charts.entries()) setTimeout(draw, i * 5, chart);
}

// --- day and night ----------------------------------------------------------------------------------------------------

const light = matchMedia("(prefers-color-scheme: light)");
const button = document.getElementById("theme");

/** A file's page may have no storage. */
function kept(value) {
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
  kept(theme);
  show(theme);
});
light.addEventListener("change", () => show(kept() ?? (light.matches ? "day" : "night")));
addEventListener("beforeprint", () => show("day"));
show(kept() ?? (light.matches ? "day" : "night"));
