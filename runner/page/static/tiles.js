/** The tiles: one per camera, with its status, its picture and the values of its stream. */

import { alertStatus, camera, decisionOf, enlarge, inControl, listen, publish, select, store, whyUndecided } from "./store.js";
import { drawFirst, reportSize, showGuides, transferCanvases } from "./link.js";
import { pending, request, whyNoControl } from "./requests.js";
import { chosenRegion, dragRegion, isCropped, isPart, shownRegion } from "./roi.js";
import { RegionFrame, showsPart } from "./region_frame.js";
import { zoomRegion } from "./zoom.js";
import { bandsOf, boxesOf, gridOf, heightsOf, narrowBands, spreadBands } from "./layout.js";
import { arrange, BIRDSEYE, rolesOf, viewOf } from "./arrange.js";
import { birdseyeSize, placeBirdseye } from "./birdseye.js";
import { placePanels } from "./panels.js";
import { framingText, WHOLE } from "./framing.js";
import { isStraight } from "./straighten.js";
import { straightOptics } from "./straight.js";
import { withKey } from "./hints.js";
import { ALARMS } from "./alarm.js";
import { percent, reasonWords, shareOf } from "./reasons.js";
import { colourOf } from "./colours.js";
import { announce, boxSize, byId, displayName, factor, KBPS, latency, make, setAttribute, setText, size, whole } from "./format.js";

export const SHAPES = {
  live: "●", late: "▲", damaged: "◪", frozen: "■", lost: "✕", off: "○", paused: "❚❚", synchronising: "◌", unsupported: "⊘", refused: "⊗",
  ended: "○",
};
const SHORT = { synchronising: "SYNC", unsupported: "NO PICTURE" }; // the overlay has the full word
const SILENT = ["lost", "off", "paused", "refused", "ended"]; // no frames arrive: the last values are out of date
export const STALE = [...SILENT, "frozen"]; // the displayed picture is older than when it was drawn
export const EXPLAINED = ["refused", "unsupported"]; // by `store.refused`
const THIN = "\u2009"; // space
const NO_AGE = { age_ms: undefined, bound_ms: undefined };
const UNCERTAIN_MS = 20; // a latency with a larger error bound is marked
const TOGETHER_MS = 100; // a timer, since no animation frame comes while the page is hidden
const BORDERS = 2; // of a tile, as in the style sheet
const narrow = matchMedia("(max-width: 999px)"); // the Configure view is one column then, as in the style sheet

const { canShowVideo } = globalThis.boot;
const area = byId("tiles");
const scene = byId("scene");
const tiles = new Map();
/** @type {import("./layout.js").Band[]} */
let bands = [];
let camerasKey = ""; // the cameras that the tiles were built for
let bandsKey = ""; // the bands that they were grouped into
/** @type {Record<string, import("./layout.js").Place>|null} */
let draft = null; // the layout of the Configure view that is being edited
/** @type {import("./placing.js").Places|null} */
let driveDraft = null; // likewise of the Drive view
const spoken = new Map(); // by camera, alarms that are about to be spoken
let wasHinted = false; // whether the hint on how to leave an enlarged picture was shown

const sizes = new ResizeObserver((entries) => {
  for (const { target } of entries) reportFrame(target.getAttribute("data-name"));
});

// --- building ---------------------------------------------------------------------------------------------------------

function build({ cameras, dimensions }) {
  const key = JSON.stringify([cameras, dimensions]); // as in the worker, whose new streams need new canvases
  if (key !== camerasKey) {
    camerasKey = key;
    bandsKey = "";
    draft = driveDraft = null;
    sizes.disconnect();
    tiles.clear();
    cameras.forEach(buildTile);
  }
  groupTiles();
  refreshAll();
}

/** Show a layout that is being edited; null: the one in force. */
export function showDraft(places) {
  draft = places;
  groupTiles();
}

/** Likewise in the Drive view. */
export function showDriveDraft(places) {
  driveDraft = places;
  layOut();
}

/** The cameras by their role in the Drive view. */
export const driveRoles = () => rolesOf(store.hello?.cameras ?? [], drivePlaces());
let isTold = false; // how a picture is enlarged
const drivePlaces = () => driveDraft ?? store.hello?.layout.drive ?? null;

/** Put the tiles into bands. */
function groupTiles() {
  const cameras = store.hello?.cameras ?? [];
  bands = draft ? [gridOf(cameras, draft)] : bandsOf(cameras, store.hello?.layout.places ?? {});
  if (isColumn()) bands = narrowBands(bands, area.clientWidth);
  else if (!draft && !store.hello?.layout.saved) bands = spreadBands(bands, area.clientWidth, area.clientHeight, chromeHeight());
  const key = JSON.stringify(bands);
  if (key === bandsKey) return layOut();
  bandsKey = key; // only if changed: moving a tile drops the focus
  const row = ({ grid, tiles: shown }) =>
    make("div", { class: grid ? "row grid" : "row" }, ...shown.map((tile) => tiles.get(tile.camera.name).element));
  area.replaceChildren(...bands.map(row));
  layOut();
}

const isColumn = () => narrow.matches && store.view === "configure";

/** Height of a tile without its picture, as in the style sheet. */
function chromeHeight() {
  if (store.view === "monitor") return 0;
  const style = getComputedStyle(document.documentElement);
  const [scale, head, below] = ["--text-scale", "--head", "--caption"].map((name) => parseFloat(style.getPropertyValue(name)));
  return (BORDERS + head + below) * scale;
}

function showNoVideo() {
  const text = "Video needs a browser with WebCodecs: Chromium, Chrome or Edge 94 or newer, on localhost or over TLS.";
  area.before(make("p", { class: "no-video", role: "alert" }, text));
}

function buildTile({ name }) {
  const canvas = make("canvas", { "data-name": name, role: "img", "aria-label": `picture of ${displayName(name)}` });
  const lines = make("canvas", { class: "lines", "aria-hidden": "true", hidden: true });
  const parts = {
    view: WHOLE,
    measured: { width: 0, height: 0 },
    canvas,
    lines,
    swatch: make("span", { class: "swatch", "aria-hidden": "true" }),
    shown: make("span", { class: "shown" }),
    shape: make("span"),
    word: make("span", { class: "word" }),
    on: make("button", { class: "switch", role: "switch", tabindex: "0", onclick: () => switchCamera(name) }),
    box: make("div", { class: "picture", "data-name": name }, canvas, lines),
    rates: make("span", { class: "rates" }),
    form: make("span", { class: "form" }),
    frame: new RegionFrame(),
  };
  const status = make("span", { class: "status" }, parts.shape, " ", parts.word);
  const reason = make("div", { class: "reason", role: "tooltip" });
  const refused = make("p", { class: "refused", hidden: true });
  parts.box.append(parts.frame.element, reason, refused);
  const head = make("div", { class: "head" }, parts.swatch, make("b", {}, ...breakable(name)), parts.shown, status, parts.on);
  const foot = make("div", { class: "caption" }, parts.rates, parts.form);
  const element = make(
    "article",
    { class: "tile", "data-camera": name, "data-status": "synchronising", tabindex: "0", "aria-label": `camera ${displayName(name)}`,
      onclick: () => choose(name), onfocus: () => select(name) },
    head, parts.box, foot,
  );
  parts.box.addEventListener("dblclick", () => enlarge(store.enlarged === name ? null : name));
  parts.on.addEventListener("dblclick", (event) => event.stopPropagation());
  tiles.set(name, { element, status, reason, refused, ...parts });
  transferCanvases(name, canvas, lines);
  dragRegion(name, parts.box, () => tiles.get(name).view);
  zoomRegion(name, parts.box, () => tiles.get(name).view);
  sizes.observe(parts.box);
}

/** A click on a picture. In the Drive view it seems to do little: say once what would enlarge the picture. */
function choose(name) {
  if (store.view === "drive" && !isTold) {
    publish("toast", { text: withKey("double click: the large picture", "enlarge"), level: "hint" });
    isTold = true;
  }
  select(name);
}

/** Show the lines on the ground of these cameras only; a hidden canvas costs nothing. @param {string[]} names */
export function showLines(names) {
  for (const [name, { lines }] of tiles) lines.hidden = !names.includes(name);
  showGuides(names);
}

/** A name that may be broken into lines after its underscores. @param {string} name */
const breakable = (name) => name.split(/(?<=_)/).flatMap((part) => [part, make("wbr")]);

/** Request to switch a camera on or off: the opposite of what was requested last, or else of what the vehicle reports. */
export function switchCamera(name) {
  const on = !(pending(`on:${name}`)?.event.on ?? decisionOf(name)?.on);
  request(`on:${name}`, { event: "camera_switched", camera: name, on }, `${name} ${on ? "on" : "off"}`);
}

// --- layout -----------------------------------------------------------------------------------------------------------

function layOut() {
  drawFirst(store.enlarged ?? driveRoles().front?.name ?? null);
  if (store.view === "drive") return layOutDrive();
  placeBirdseye(undefined);
  placePanels(null);
  for (const [name, { element }] of tiles) {
    const info = camera(name);
    element.hidden = false;
    Object.assign(element.style, { left: "", top: "" });
    setView(name, info && store.view === "monitor" ? viewOf(info) : WHOLE);
  }
  layOutBands();
  layOutEnlarged();
}

/** The bands of the layout. */
function layOutBands() {
  const rest = chromeHeight();
  const heights = heightsOf(bands, area.clientWidth, isColumn() ? Infinity : area.clientHeight, rest);
  for (const [i, band] of bands.entries()) {
    const { column, boxes } = boxesOf(band, heights[i], area.clientWidth, rest);
    const repeated = (count, px) => `repeat(${count}, ${px}px)`;
    const rows = repeated(band.rows, heights[i] + rest);
    const tracks = band.grid ? { gridTemplateColumns: repeated(band.columns, column), gridTemplateRows: rows } : {};
    Object.assign(/** @type {HTMLElement} */ (area.children[i]).style, tracks);
    for (const [j, tile] of band.tiles.entries()) {
      const { box, element } = tiles.get(tile.camera.name);
      const gridArea = `${tile.row + 1} / ${tile.column + 1} / span ${tile.row_span} / span ${tile.column_span}`;
      Object.assign(element.style, { width: `${boxes[j].width}px`, gridArea: band.grid ? gridArea : "" });
      box.style.height = `${boxes[j].height}px`;
    }
  }
}

/** The Drive view as it is arranged now. */
export function driveArrangement() {
  const birdseye = driveDraft ? null : birdseyeSize(); // it would hide the top views
  const { clientWidth, clientHeight } = area;
  return arrange(store.hello?.cameras ?? [], clientWidth, clientHeight, store.enlarged, birdseye, drivePlaces());
}

/** Place each camera by its direction; the enlarged one swaps places with the front camera. */
function layOutDrive() {
  const { panels, pictures } = driveArrangement();
  placePanels(panels);
  placeBirdseye(pictures.get(BIRDSEYE));
  for (const [name, { element }] of tiles) element.hidden = !pictures.has(name);
  for (const [name, { x, y, width, height, view }] of pictures) {
    if (!tiles.has(name)) continue;
    const { box, element } = tiles.get(name);
    Object.assign(element.style, { left: `${x}px`, top: `${y}px`, width: `${width}px` });
    element.classList.remove("enlarged");
    box.style.height = `${height}px`;
    setView(name, view);
  }
  area.classList.remove("has-enlarged");
}

/** Show a camera's picture whole, cropped or mirrored. */
function setView(name, view) {
  const part = tiles.get(name);
  part.view = view;
  const transform = view.mirrored ? "scaleX(-1)" : "";
  Object.assign(part.canvas.style, { objectFit: view.fit, transform });
  part.frame.element.style.transform = transform;
  reportFrame(name);
}

/** Whether an enlarged picture takes the place of this one. */
const isCovered = (name) => store.view !== "drive" && tiles.has(store.enlarged) && store.enlarged !== name;

function reportFrame(name) {
  const part = tiles.get(name);
  if (!part) return;
  part.measured = boxSize(part.box);
  reportSize(name, part.box, part.view, isCovered(name));
  refreshFraming(name, part);
}

/** State which part of the picture is shown. To read the size from the box would lay out the page for each tile. */
function refreshFraming(name, { measured, shown, view, frame }) {
  const info = camera(name);
  const hasFrame = info && !isStraight(name) && showsPart(name);
  frame.element.hidden = !hasFrame;
  if (hasFrame) frame.refresh(name);
  const picture = (isStraight(name) ? null : shownRegion(name)) ?? info;
  const isLaidOut = info && picture && measured.width && measured.height;
  const framing = isLaidOut ? framingText(measured, picture, view) : "";
  const straight = info && isStraight(name) ? `straight, ${straightOptics(info).fov_deg}° of ${info.fov_deg}°` : "";
  setText(shown, [framing, straight, partText(name)].filter(Boolean).join(", "));
}

/** That a camera sends, or this page shows, a part of its image only, and how to end that. @param {string} name */
function partText(name) {
  const [info, chosen] = [camera(name), chosenRegion(name)];
  const seen = isCropped(name) && shownRegion(name);
  if (info && seen) return withKey(`${percent(shareOf(seen, info))} of its image shown, by this page`, "full_image");
  return info && chosen && isPart(name) ? withKey(`only ${percent(shareOf(chosen, info))} of its image sent`, "full_image") : "";
}

function layOutEnlarged() {
  for (const [name, { element, box }] of tiles) {
    const large = store.enlarged === name;
    element.classList.toggle("enlarged", large);
    if (!large) continue;
    element.style.width = "";
    // What is below stays visible: it may say that sound is blocked, and which other pictures are lost.
    box.style.height = `${isColumn() ? Math.round(0.6 * area.clientWidth) : area.clientHeight - chromeHeight()}px`;
    if (isColumn()) element.scrollIntoView({ block: "nearest" });
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
  setAttribute(part.element, "aria-current", store.selected === name ? "true" : null);
  setAttribute(part.element, "data-straight", isStraight(name) ? "" : null);
  refreshStatus(name, part);
  refreshSwitch(name, part);
  refreshCaption(name, part);
  refreshFraming(name, part);
}

function refreshStatus(name, { element, status, shape, word, refused }) {
  const now = store.status[name] ?? "synchronising";
  const why = EXPLAINED.includes(now) ? store.refused[name] : (decisionOf(name)?.fault ?? (store.state?.online ? whyUndecided(name) : ""));
  refused.hidden = !why;
  setText(refused, why ?? "");
  setAttribute(element, "data-status", now);
  setAttribute(status, "data-quiet", now === "live" ? "" : null);
  setText(shape, SHAPES[now]);
  setText(word, SHORT[now] ?? now.toUpperCase());
}

function refreshSwitch(name, { on }) {
  const requested = pending(`on:${name}`);
  const now = decisionOf(name);
  setAttribute(on, "aria-checked", now?.on === true);
  setAttribute(on, "aria-label", `${displayName(name)} on`);
  setAttribute(on, "data-pending", requested ? "" : null);
  on.disabled = !inControl() || !now;
  setText(on, requested ? (requested.event.on ? "on…" : "off…") : now ? (now.on ? "on" : "off") : "–");
  setAttribute(on, "title", on.disabled ? (now ? whyNoControl() : whyUndecided(name)) : withKey("switch this camera on or off", "switch"));
}

function refreshCaption(name, { rates, form, reason }) {
  const now = decisionOf(name);
  const isSilent = !store.connected || SILENT.includes(store.status[name]);
  const sample = isSilent ? undefined : store.sample?.cameras[name];
  const isStale = isSilent || STALE.includes(store.status[name]);
  const { age_ms, bound_ms } = isStale ? NO_AGE : ageOf(name, sample);
  const differs = now ? unapplied(now) : [];
  const bitrate = differs.includes("bitrate") || differs.includes("sending");
  const region = differs.includes("size") || differs.includes("ROI");
  const kbps = [sample?.kbps, now?.kbps, now?.demand_kbps].map(whole).join(`${THIN}/${THIN}`);
  const repair = sample?.buffer_ms ? `; the jitter buffer waits up to ${sample.buffer_ms} ms for retransmissions` : "";
  const part = now && isPart(name) && !isCropped(name) ? ` of ${percent(shareOf(now.roi, camera(name) ?? now.roi))} of the image` : "";
  const shape = `${size(sample?.width, sample?.height)} · ×${factor(now?.scaling)}${part}`;
  const own = camera(name)?.fps;
  const sent = now?.fps ?? own;
  const isFewer = sent !== own;
  const of = (now?.slow_fps || isFewer) && !isSilent ? ` of ${whole(sent)}` : "";
  const left = isFewer ? ` received of those sent; the camera delivers ${whole(own)}` : "";
  const rated = `pictures a second${left} · ${KBPS}: received / allocated / demanded`;
  caption(rates, bitrate, `${whole(sample?.fps)}${of} fps · ${kbps} ${KBPS}`, rated);
  const lost = sample?.lost ? ` · ${sample.lost} lost` : "";
  const wire = `${whole(sample?.lost)} packets lost, receiver rebuilt ${whole(sample?.rebuilt)} times`;
  const why = `received size · scaling factor · latency from capture to drawing ± error bound; ${wire}${repair}`;
  caption(form, region, `${shape} · ${latency(age_ms, bound_ms)}${lost}`, why);
  const isUncertain = (bound_ms ?? 0) > UNCERTAIN_MS && store.status[name] !== "synchronising"; // clocks agree soon
  setAttribute(form, "data-uncertain", isUncertain ? "" : null);
  const info = camera(name);
  setText(reason, info ? reasonWords(now, store.state, info, Number.isFinite(store.sample?.predicted_kbps)) : "");
}

/** From capture to drawing; on a page without video, from capture to decoding at the station. */
function ageOf(name, sample) {
  const drawn = store.ages[name];
  return Number.isFinite(drawn?.age_ms) ? drawn : { age_ms: sample?.latency_ms, bound_ms: store.sample?.clock_bound_ms };
}

/** One line of a caption, marked if a decided value has not been read back yet. */
function caption(element, differs, text, title) {
  setText(element, differs ? `◌ ${text}` : text);
  setAttribute(element, "data-differs", differs ? "" : null);
  setAttribute(element, "title", differs ? `pending: decided, not yet read back; ${title}` : title);
}

/** The decided values that have not been read back from the elements yet. @param {import("./store.js").Decision} decision */
export function unapplied({ on, sending, roi, width, height, kbps, fps, applied }) {
  const found = [];
  if (applied.sending !== undefined && applied.sending !== sending) found.push("sending");
  if (!on || !sending) return found;
  if (applied.bitrate !== undefined && applied.bitrate !== kbps) found.push("bitrate");
  if (applied.fps !== undefined && applied.fps !== fps) found.push("rate");
  const { size: appliedSize, roi: appliedRoi } = applied;
  if (appliedSize && (appliedSize.width !== width || appliedSize.height !== height)) found.push("size");
  if (appliedRoi && ["x", "y", "width", "height"].some((key) => appliedRoi[key] !== roi[key])) found.push("ROI");
  return found;
}

function onStatus({ camera: name, status }) {
  const part = tiles.get(name);
  if (!part) return;
  refreshStatus(name, part);
  refreshCaption(name, part);
  const said = `${displayName(name)} ${SHORT[status] ?? status} ${store.refused[name] ?? ""}`.trim();
  if (alertStatus(name, status) in ALARMS) speak(name, said);
}

/** Have alarms spoken together: a screen reader would drop all but the last of those that come at once. */
function speak(name, text) {
  if (!spoken.size) setTimeout(speakAll, TOGETHER_MS);
  spoken.delete(name); // the newest last
  spoken.set(name, text);
}

function speakAll() {
  announce([...spoken.values()].join(", "));
  spoken.clear();
}

export function startTiles() {
  listen("hello", build);
  listen("layout", () => draft || groupTiles());
  listen("state sample requests control socket theme selected straight crop", refreshAll);
  listen("status", onStatus);
  listen("view birdseye", groupTiles);
  listen("selected", moveFocus);
  listen("enlarged", (name) => {
    layOut();
    if (name && !wasHinted) publish("toast", { text: `${withKey("double click to go back", "back")}`, level: "hint" });
    wasHinted = true;
  });
  if (!canShowVideo) showNoVideo();
  const resized = new ResizeObserver(groupTiles);
  for (const element of [scene, area]) resized.observe(element); // alarms below the area may need a second line
  watchPixelRatio();
}

/** Let the focus follow a selection by another window: a focused tile selects its camera again when its window is activated. */
function moveFocus(name) {
  const focused = document.activeElement;
  if (!(focused instanceof HTMLElement) || !focused.classList.contains("tile") || focused.dataset.camera === name) return;
  focused.blur(); // also where this window does not show the camera
  focusTile(name);
}

/** Report sizes again on a screen with another scale: boxes keep their sizes in CSS pixels. */
function watchPixelRatio() {
  matchMedia(`(resolution: ${devicePixelRatio}dppx)`).addEventListener("change", () => { layOut(); watchPixelRatio(); }, { once: true });
}

/** Move the focus to the tile of a camera. */
export const focusTile = (name) => tiles.get(name)?.element.focus({ preventScroll: true });
