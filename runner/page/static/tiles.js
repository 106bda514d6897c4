/** The tiles: one per camera, with its status, its picture and the values of its stream. */

import { camera, decided, enlarge, inControl, listen, publish, select, store } from "./store.js";
import { drawFirst, giveCanvas, giveGuides, tellSize } from "./link.js";
import { pending, request, whyNoControl } from "./requests.js";
import { dragRegion, seenRegion } from "./roi.js";
import { zoomRegion } from "./zoom.js";
import { bandsOf, boxesOf, gridOf, heightsOf } from "./layout.js";
import { arrange, BIRDSEYE, rolesOf, viewOf } from "./arrange.js";
import { birdseyeSize, placeBirdseye } from "./birdseye.js";
import { shownWords, WHOLE } from "./framing.js";
import { isStraight } from "./straighten.js";
import { straightOptics } from "./straight.js";
import { colourOf } from "./colours.js";
import { by, factor, latency, make, mark, size, spoken, whole, write } from "./format.js";

export const SHAPES = { live: "●", late: "▲", damaged: "◪", frozen: "■", lost: "✕", off: "○", paused: "❚❚", synchronising: "◌", unsupported: "⊘" };
const SHORT = { synchronising: "SYNC", unsupported: "NO PICTURE" }; // the picture has the whole word
const ALARMS = ["late", "damaged", "frozen", "lost", "unsupported"];
const SILENT = ["lost", "off", "paused"]; // no frames arrive: the last values are out of date
export const STILL = [...SILENT, "frozen"]; // what is on show has another age than when it was drawn
const THIN = "\u2009"; // space
const NO_AGE = { age_ms: undefined, bound_ms: undefined };
const UNCERTAIN_MS = 20; // a latency that may be wrong by more is marked
const HEAD = 28; // header and border of a tile, as in the style sheet

const { canShowVideo } = globalThis.boot;
const area = by("tiles");
const scene = by("scene");
const tiles = new Map();
/** @type {import("./layout.js").Band[]} */
let bands = [];
let described = ""; // the cameras for which there are tiles
let grouped = ""; // the bands that they are in
/** @type {Record<string, import("./layout.js").Place>|null} */
let draft = null; // the layout that is being edited
let hinted = false; // whether the way back from an enlarged picture was shown

const sizes = new ResizeObserver((entries) => {
  for (const { target } of entries) tellFrame(target.getAttribute("data-name"));
});

// --- building ---------------------------------------------------------------------------------------------------------

function build({ cameras }) {
  const text = JSON.stringify(cameras);
  if (text !== described) {
    described = text;
    grouped = "";
    draft = null;
    sizes.disconnect();
    tiles.clear();
    cameras.forEach(tile);
  }
  group();
  refreshAll();
}

/** Show a layout that is being edited; null: the one in force. */
export function showDraft(places) {
  draft = places;
  group();
}

/** Put the tiles into bands. */
function group() {
  const cameras = store.hello?.cameras ?? [];
  bands = draft ? [gridOf(cameras, draft)] : bandsOf(cameras, store.hello?.layout.places ?? {});
  const text = JSON.stringify(bands);
  if (text === grouped) return lay();
  grouped = text; // moving a tile takes the focus away
  const row = ({ grid, tiles: those }) => make("div", { class: grid ? "row grid" : "row" }, ...those.map((its) => tiles.get(its.camera.name).element));
  area.replaceChildren(...bands.map(row));
  lay();
}

/** Height of a tile without its picture, as in the style sheet. */
function chrome() {
  if (store.view === "monitor") return 0;
  const style = getComputedStyle(document.documentElement);
  const [scale, below] = ["--text-scale", "--caption"].map((name) => parseFloat(style.getPropertyValue(name)));
  return (HEAD + below) * scale;
}

function sayNoVideo() {
  const text = "Video needs a browser with WebCodecs: Chromium, Chrome or Edge 94 or newer, on localhost or over TLS.";
  area.before(make("p", { class: "no-video", role: "alert" }, text));
}

function tile({ name, pose }) {
  const canvas = make("canvas", { "data-name": name, role: "img", "aria-label": `picture of ${spoken(name)}` });
  const parts = {
    view: WHOLE,
    canvas,
    swatch: make("span", { class: "swatch", "aria-hidden": "true" }),
    shown: make("span", { class: "shown" }),
    status: make("span", { class: "status" }),
    on: make("button", { class: "switch", role: "switch", tabindex: "0", onclick: () => switchCamera(name) }),
    box: make("div", { class: "picture", "data-name": name }, canvas),
    rates: make("span", { class: "rates" }),
    form: make("span", { class: "form" }),
  };
  const reason = make("div", { class: "reason", role: "tooltip" });
  const refused = make("p", { class: "refused", hidden: true });
  parts.box.append(reason, refused);
  if (!canShowVideo) parts.box.append(make("p", { class: "no-picture" }, "no video in this browser"));
  const head = make("div", { class: "head" }, parts.swatch, make("b", {}, name), parts.shown, parts.status, parts.on);
  const foot = make("div", { class: "caption" }, parts.rates, parts.form);
  const element = make(
    "article",
    { class: "tile", "data-camera": name, "data-status": "synchronising", tabindex: "0", "aria-label": `camera ${spoken(name)}`,
      onclick: () => select(name), onfocus: () => select(name) },
    head, parts.box, foot,
  );
  parts.box.addEventListener("dblclick", () => enlarge(store.enlarged === name ? null : name));
  parts.on.addEventListener("dblclick", (event) => event.stopPropagation());
  tiles.set(name, { element, reason, refused, ...parts });
  giveCanvas(name, canvas);
  if (pose) {
    const guides = make("canvas", { class: "guides", "data-guides": name, "aria-hidden": "true" });
    canvas.after(guides);
    giveGuides(name, guides);
  }
  dragRegion(name, parts.box, () => tiles.get(name).view);
  zoomRegion(name, parts.box, () => tiles.get(name).view);
  sizes.observe(parts.box);
}

/** Ask to switch a camera on or off: the opposite of the state that the vehicle reports. */
export function switchCamera(name) {
  const on = !decided(name)?.on;
  request(`on:${name}`, { event: "camera_switched", camera: name, on }, `${name} ${on ? "on" : "off"}`);
}

// --- layout -----------------------------------------------------------------------------------------------------------

function lay() {
  drawFirst(store.enlarged ?? rolesOf(store.hello?.cameras ?? []).front?.name ?? null);
  if (store.view === "drive") return layDrive();
  placeBirdseye(undefined);
  for (const [name, { element }] of tiles) {
    const its = camera(name);
    element.hidden = false;
    Object.assign(element.style, { left: "", top: "" });
    frame(name, its && store.view === "monitor" ? viewOf(its) : WHOLE);
  }
  layBands();
  layEnlarged();
}

/** Bands as the layout places them. */
function layBands() {
  const rest = chrome();
  const heights = heightsOf(bands, area.clientWidth, area.clientHeight, rest);
  for (const [i, band] of bands.entries()) {
    const { column, boxes } = boxesOf(band, heights[i], area.clientWidth, rest);
    const tracks = band.grid ? { gridTemplateColumns: `repeat(${band.columns}, ${column}px)`, gridTemplateRows: `repeat(${band.rows}, ${heights[i] + rest}px)` } : {};
    Object.assign(/** @type {HTMLElement} */ (area.children[i]).style, tracks);
    for (const [j, its] of band.tiles.entries()) {
      const { box, element } = tiles.get(its.camera.name);
      const gridArea = `${its.row + 1} / ${its.column + 1} / span ${its.row_span} / span ${its.column_span}`;
      Object.assign(element.style, { width: `${boxes[j].width}px`, gridArea: band.grid ? gridArea : "" });
      box.style.height = `${boxes[j].height}px`;
    }
  }
}

/** A place for each camera by where it looks; the enlarged one has changed places with the front camera. */
function layDrive() {
  const { band, mirror, pictures } = arrange(store.hello?.cameras ?? [], area.clientWidth, area.clientHeight, store.enlarged, birdseyeSize());
  by("drive").style.height = `${band.height}px`;
  by("drive").style.setProperty("--mirror", `${mirror.width}px`);
  placeBirdseye(pictures.get(BIRDSEYE));
  for (const [name, { element }] of tiles) element.hidden = !pictures.has(name);
  for (const [name, { x, y, width, height, view }] of pictures) {
    if (!tiles.has(name)) continue;
    const { box, element } = tiles.get(name);
    Object.assign(element.style, { left: `${x}px`, top: `${y}px`, width: `${width}px` });
    element.classList.remove("enlarged");
    box.style.height = `${height}px`;
    frame(name, view);
  }
  area.classList.remove("has-enlarged");
}

/** Show a camera's picture whole, cropped or mirrored. */
function frame(name, view) {
  const part = tiles.get(name);
  part.view = view;
  Object.assign(part.canvas.style, { objectFit: view.fit, objectPosition: `${100 * view.align}% 50%`, transform: view.mirrored ? "scaleX(-1)" : "" });
  tellFrame(name);
}

function tellFrame(name) {
  const part = tiles.get(name);
  if (!part) return;
  tellSize(name, part.box, part.view);
  refreshShown(name, part);
}

/** State what is cropped. */
function refreshShown(name, { box, shown, view }) {
  const about = camera(name);
  const picture = (isStraight(name) ? null : seenRegion(name)) ?? about;
  const laid = about && picture && box.clientWidth && box.clientHeight;
  const words = laid ? shownWords({ width: box.clientWidth, height: box.clientHeight }, picture, view) : "";
  const straight = about && isStraight(name) ? `straight, ${straightOptics(about).fov_deg}° of ${about.fov_deg}°` : "";
  write(shown, [words, straight].filter(Boolean).join(", "));
}

function layEnlarged() {
  for (const [name, { element, box }] of tiles) {
    const large = store.enlarged === name;
    element.classList.toggle("enlarged", large);
    if (!large) continue;
    element.style.width = "";
    box.style.height = `${scene.clientHeight - chrome()}px`;
  }
  area.classList.toggle("has-enlarged", tiles.has(store.enlarged));
}

// --- what is shown ----------------------------------------------------------------------------------------------------

function refreshAll() {
  for (const { name, index } of store.hello?.cameras ?? []) refresh(name, index);
}

function refresh(name, index) {
  const part = tiles.get(name);
  if (!part) return;
  part.swatch.style.background = colourOf(index);
  part.element.classList.toggle("selected", store.selected === name);
  mark(part.element, "aria-current", store.selected === name ? "true" : null);
  mark(part.element, "data-straight", isStraight(name) ? "" : null);
  refreshStatus(name, part);
  refreshSwitch(name, part);
  refreshCaption(name, part);
  refreshShown(name, part);
}

function refreshStatus(name, { element, status, refused }) {
  const word = store.status[name] ?? "synchronising";
  const why = word === "unsupported" ? store.refused[name] : decided(name)?.fault;
  refused.hidden = !why;
  write(refused, why ?? "");
  mark(element, "data-status", word);
  mark(status, "data-quiet", word === "live" ? "" : null);
  write(status, `${SHAPES[word]} ${SHORT[word] ?? word.toUpperCase()}`);
}

function refreshSwitch(name, { on }) {
  const asked = pending(`on:${name}`);
  const now = decided(name);
  mark(on, "aria-checked", now?.on === true);
  mark(on, "aria-label", `${spoken(name)} on`);
  mark(on, "data-pending", asked ? "" : null);
  on.disabled = !inControl() || !now;
  write(on, asked ? (asked.event.on ? "on…" : "off…") : now ? (now.on ? "on" : "off") : "–");
  mark(on, "title", on.disabled ? (now ? whyNoControl() : "the vehicle is offline") : "switch this camera on or off (o)");
}

function refreshCaption(name, { rates, form, reason }) {
  const now = decided(name);
  const silent = !store.connected || SILENT.includes(store.status[name]);
  const sample = silent ? undefined : store.sample?.cameras[name];
  const still = silent || STILL.includes(store.status[name]);
  const { age_ms, bound_ms } = still ? NO_AGE : ageOf(name, sample);
  const differs = now ? unapplied(now) : [];
  const bitrate = differs.includes("bitrate") || differs.includes("sending");
  const region = differs.includes("size") || differs.includes("ROI");
  const kbps = [sample?.kbps, now?.kbps, now?.demand_kbps].map(whole).join(`${THIN}/${THIN}`);
  const repair = sample?.buffer_ms ? `; the jitter buffer waits up to ${sample.buffer_ms} ms for retransmissions` : "";
  const shape = `${size(sample?.width, sample?.height)} · ×${factor(now?.scaling)}`;
  caption(rates, bitrate, `${whole(sample?.fps)} fps · ${kbps} kbit/s`, "frames per second · kbit/s: actual / allocated / demand");
  const lost = sample?.lost ? ` · ${sample.lost} lost` : "";
  const wire = `${whole(sample?.lost)} packets lost, receiver rebuilt ${whole(sample?.rebuilt)} times`;
  caption(form, region, `${shape} · ${latency(age_ms, bound_ms)}${lost}`, `received size · scaling factor · latency from capture to drawing ± error bound; ${wire}${repair}`);
  mark(form, "data-uncertain", (bound_ms ?? 0) > UNCERTAIN_MS ? "" : null);
  write(reason, now?.reason ?? "");
}

/** Capture to drawing; in a page that shows no video, capture to decoding at the station. */
function ageOf(name, sample) {
  const drawn = store.ages[name];
  return Number.isFinite(drawn?.age_ms) ? drawn : { age_ms: sample?.latency_ms, bound_ms: store.sample?.clock_bound_ms };
}

/** One line of a caption; marked if a decided value was not yet read back. */
function caption(element, differs, text, title) {
  write(element, differs ? `◌ ${text}` : text);
  mark(element, "data-differs", differs ? "" : null);
  mark(element, "title", differs ? `pending: decided, not yet read back; ${title}` : title);
}

/** The decided values that were not yet read back from the elements. */
export function unapplied({ on, sending, roi, width, height, kbps, applied }) {
  const found = [];
  if (applied.sending !== undefined && applied.sending !== sending) found.push("sending");
  if (!on || !sending) return found;
  if (applied.bitrate !== undefined && applied.bitrate !== kbps) found.push("bitrate");
  const { size: is, roi: seen } = applied;
  if (is && (is.width !== width || is.height !== height)) found.push("size");
  if (seen && ["x", "y", "width", "height"].some((key) => seen[key] !== roi[key])) found.push("ROI");
  return found;
}

function announce({ camera: name, status }) {
  const part = tiles.get(name);
  if (!part) return;
  refreshStatus(name, part);
  refreshCaption(name, part);
  if (ALARMS.includes(status)) write(by("announcer"), `${spoken(name)} ${SHORT[status] ?? status} ${store.refused[name] ?? ""}`);
}

export function startTiles() {
  listen("hello", build);
  listen("layout", () => draft || group());
  listen("state sample requests control socket theme selected straight", refreshAll);
  listen("status", announce);
  listen("view birdseye", lay);
  listen("enlarged", (name) => {
    lay();
    if (name && !hinted) publish("toast", { text: "Esc or double click to go back", level: "hint" });
    hinted = true;
  });
  if (!canShowVideo) sayNoVideo();
  new ResizeObserver(lay).observe(scene);
}

/** Move the focus to the tile of a camera. */
export const focusTile = (name) => tiles.get(name)?.element.focus({ preventScroll: true });
