/** The side panel of the selected camera: decided values and why, values read back, and what the operator may set. */

import { camera, decisionOf, inControl, listen, mode, store, whyUndecided } from "./store.js";
import { pending, request, showProblem, whyNoControl } from "./requests.js";
import { AS_ENCODED, chosenRegion, fullRegion, isCropped, isLocked, isPart, sendRegion, shownRegion, toggleLocked } from "./roi.js";
import { RegionFrame } from "./region_frame.js";
import { SMALLEST } from "./region.js";
import { makeSlider } from "./slider.js";
import { EXPLAINED, SHAPES, STALE, switchCamera, unapplied } from "./tiles.js";
import { canStraighten } from "./straight.js";
import { isStraight, toggleStraight } from "./straighten.js";
import { withKey } from "./hints.js";
import { Kept } from "./kept.js";
import { cropWords, reasonWords, regionWords, setterWords } from "./reasons.js";
import { colourOf } from "./colours.js";
import { byId, capital, factor, KBPS, latency, make, rate, region, setAttribute, setText, size, tenth, whole } from "./format.js";

const SIDES = ["x", "y", "width", "height"];
const BY_HAND = "; choose S to set it.";

/** The selected camera; "" before the first hello, when nothing is shown here. */
const name = () => store.selected ?? "";
const whyNot = () => (!decisionOf(name()) ? whyUndecided(name()) : inControl() ? null : `${capital(whyNoControl())}.`);
const isPredicted = () => Number.isFinite(store.sample?.predicted_kbps);
const whyNotByHand = () => whyNot() ?? setBy();

/** What sets the bitrate; null: the operator does. */
function setBy() {
  const info = camera(name());
  if (info?.passed && !info.settable) return `${capital(AS_ENCODED)}. This page alone shows a region of it.`;
  if (mode() === "automatic") return `${setterWords(store.state, isPredicted())}${BY_HAND}`;
  return mode() === "collective" ? `Shared from the total${BY_HAND}` : null;
}

// --- parts ------------------------------------------------------------------------------------------------------------

const title = make("h2");
const swatch = make("span", { class: "swatch", "aria-hidden": "true" });
const status = make("span", { class: "status" });
const on = make("button", { class: "switch", role: "switch", "data-control": "on", onclick: () => switchCamera(name()) });
const straight = make("button", {
  "data-control": "straight", "data-key": "straighten", onclick: () => toggleStraight(),
  "data-title": "straighten the picture of this fisheye, or show the original",
}, "Straighten");
const reason = make("span");
const formula = make("p", { class: "muted" });
const byHand = make("p", { class: "why" });
const bitrate = makeSlider({
  label: "bitrate",
  data: "kbps",
  control: () => `kbps:${name()}`,
  target: name,
  send: (kbps, target) => configure("kbps", kbps, rate(kbps), target),
});
const choices = make("span", { class: "choices", role: "group", "aria-label": "factors of this camera" });
const free = number("scaling", "factor", { min: 0.01, max: 1, step: "any" });
const weight = number("weight", "weight", { min: 0, step: "any" });
const weightNote = make("span", { class: "muted" });
const sides = Object.fromEntries(SIDES.map((side) => [side, number(`roi-${side}`, `ROI ${side}, px`, { step: 1, min: 0 })]));
const apply = make("button", { "data-control": "roi-apply", onclick: sendSides }, "Set ROI");
const full = make("button", { "data-control": "roi-full", onclick: () => sendFull() }, "Full image");
const locked = make("button", {
  "data-control": "roi-aspect", onclick: toggleLocked, title: "dragged regions keep the aspect ratio of the full image",
}, "Lock aspect");
const part = make("p", { class: "why", id: "region-part" });
const frame = new RegionFrame();
const differing = make("th", { class: "differing", scope: "col" });
const rows = new Map();
const STAGES = {
  capture: ["Capture", "on the vehicle, to the encoder: conversion, region and scaling"],
  encode: ["Encode", "through the encoder"],
  link: ["Link", "from the encoder to the station; accurate to within the error bound of the clocks"],
  buffer: ["Jitter buffer", "wait for late, reordered or retransmitted packets"],
  page: ["To this page", "from the station to this page"],
  decode: ["Decode", "in this browser; on a page without video, at the station"],
  draw: ["Draw", "until the picture is drawn; the screen adds its own delay"],
};
const latencies = new Map(); // by stage
const age = make("td", { class: "sum" });
const origin = new Kept();
let edited = new Set(); // inputs that the operator is editing: not to be overwritten

function number(control, label, limits) {
  const input = make("input", { type: "number", "data-control": control, "aria-label": label, ...limits });
  input.addEventListener("input", () => edited.add(input));
  input.addEventListener("revert", () => {
    edited.delete(input);
    refresh();
  });
  return input;
}

function field(label, ...content) {
  return make("div", { class: "field" }, make("span", { class: "label" }, label), ...content);
}

function comparison() {
  const body = make("tbody");
  for (const [key, label] of [["sending", "Sending"], ["bitrate", KBPS], ["rate", "Pictures/s"], ["size", "Size"], ["ROI", "ROI"]]) {
    const cells = [make("td"), make("td")];
    rows.set(key, { row: make("tr", {}, make("th", { scope: "row" }, label), ...cells), cells });
    body.append(rows.get(key).row);
  }
  const head = make("tr", {}, differing, ...["Decided", "Applied"].map((text) => make("th", { scope: "col" }, text)));
  const caption = make("caption", { class: "unseen" }, "decided and applied values");
  return make("table", { class: "facts" }, caption, make("thead", {}, head), body);
}

/** Two stages in each row, which leaves space for the charts beside it on a large screen. */
function stageTable() {
  const cells = Object.entries(STAGES).map(([stage, [label, what]]) => {
    latencies.set(stage, make("td"));
    return [make("th", { scope: "row", title: what }, label), latencies.get(stage)];
  });
  cells.push([make("th", { scope: "row", class: "sum", title: "capture to drawing" }, "Latency"), age]);
  const body = make("tbody");
  for (let i = 0; i < cells.length; i += 2) body.append(make("tr", {}, ...cells.slice(i, i + 2).flat()));
  return make("table", { class: "facts" }, make("caption", {}, "Latency, ms"), body);
}

// --- requests ---------------------------------------------------------------------------------------------------------

function configure(key, value, description, target = name()) {
  request(`${key}:${target}`, { event: "camera_configured", camera: target, [key]: value }, `${target} ${description}`);
}

function setFactor(value) {
  edited.delete(free);
  if (!(value > 0 && value <= 1)) return showProblem("the factor must be above 0 and at most 1");
  configure("scaling", value, `factor ${factor(value)}`);
}

function setWeight() {
  edited.delete(weight);
  const value = +weight.value;
  if (weight.value === "" || !(value >= 0)) return showProblem("the weight must be a number of at least 0");
  request(`weight:${name()}`, { event: "weights_set", weights: { [name()]: value } }, `${name()} weight ${value}`);
}

function sendSides() {
  const { width, height } = fullRegion(name());
  const roi = Object.fromEntries(SIDES.map((side) => [side, Math.round(+sides[side].value)]));
  const isInside = roi.x >= 0 && roi.y >= 0 && roi.x + roi.width <= width && roi.y + roi.height <= height;
  if (!isInside) return showProblem(`the ROI exceeds the ${width}×${height} image`);
  if (Math.min(roi.width, roi.height) < SMALLEST) return showProblem(`the ROI must be at least ${SMALLEST}×${SMALLEST} pixels`);
  sendRegion(name(), roi);
  edited = new Set();
}

/** Request the full image of the selected camera, or, if that sends it anyway, of every camera that sends a part. */
export function sendFull() {
  const others = (store.hello?.cameras ?? []).map((each) => each.name).filter(isPart);
  const names = others.includes(name()) ? [name()] : others;
  const why = names.every(isCropped) ? null : whyNot();
  if (why) return showProblem(why);
  if (!names.length) return showProblem("every camera sends its full image");
  for (const each of names) sendRegion(each, fullRegion(each));
  edited = new Set();
}

// --- what is shown ----------------------------------------------------------------------------------------------------

function refresh() {
  const info = camera(name());
  if (!info) return;
  const now = decisionOf(name());
  refreshHead(now);
  straight.hidden = !canStraighten(info);
  setAttribute(straight, "aria-pressed", isStraight(name()));
  refreshSettings(info, now);
  refreshComparison(now);
  frame.refresh(name());
  refreshStages();
}

function refreshHead(now) {
  const word = store.status[name()] ?? "synchronising";
  const requested = pending(`on:${name()}`);
  setText(title, name());
  swatch.style.background = colourOf(store.hello?.cameras.findIndex((each) => each.name === name()) ?? 0);
  setText(status, `${SHAPES[word]} ${word === "unsupported" ? "NO PICTURE" : word.toUpperCase()}`);
  setAttribute(status, "data-status", word);
  setAttribute(on, "aria-checked", now?.on === true);
  setAttribute(on, "aria-label", `${name()} on`);
  setAttribute(on, "data-pending", requested ? "" : null);
  on.disabled = Boolean(whyNot());
  on.title = whyNot() ?? withKey("switch this camera on or off", "switch");
  setText(on, requested ? (requested.event.on ? "on…" : "off…") : now?.on ? "on" : now ? "off" : "–");
  const words = reasonWords(now, store.state, fullRegion(name()), isPredicted());
  setText(reason, [EXPLAINED.includes(word) ? store.refused[name()] : "", words].filter(Boolean).join(" · "));
  setText(formula, now?.reason || "–");
}

function refreshSettings(info, now) {
  const why = whyNotByHand();
  const whyNoRoi = info.passed ? null : why; // the page crops its picture
  const ofRegion = info.passed ? "This page alone shows a region of it. " : "";
  setText(byHand, why ?? ofRegion + (now ? origin.words(name(), now) : ""));
  bitrate.update({ value: now?.kbps, max: info.b_full_kbps, why });
  const whyNoFactor = info.passed ? `${capital(AS_ENCODED)}.` : why;
  refreshFactors(info, now, whyNoFactor);
  fill(free, now?.scaling ?? "", whyNoFactor, pending(`scaling:${name()}`));
  const seen = info.passed ? shownRegion(name()) : chosenRegion(name());
  for (const side of SIDES) fill(sides[side], seen?.[side] ?? "", whyNoRoi, pending(`roi:${name()}`));
  setAttribute(locked, "aria-pressed", isLocked());
  apply.disabled = Boolean(whyNoRoi);
  const whyNotFull = isCropped(name()) ? null : whyNot();
  full.disabled = Boolean(whyNotFull) || !isPart(name());
  full.title = whyNotFull ?? withKey("full image", "full_image");
  part.hidden = !(now && isPart(name()));
  setText(part, part.hidden ? "" : partWords(info, now));
  apply.title = whyNoRoi ?? "send these numbers; a rectangle dragged on the picture does the same";
  fill(weight, now?.weight ?? info.weight, whyNot(), pending(`weight:${name()}`));
  const use = mode() === "single" ? "used in modes A and C only" : "scales this camera's share of the total";
  weight.title = whyNot() ?? use;
  setText(weightNote, whyNot() ?? use);
}

function partWords(info, now) {
  const end = withKey("Full image", "full_image");
  const seen = isCropped(name()) && shownRegion(name());
  return seen ? cropWords(seen, info, end) : regionWords(now, mode() === "single", info, end);
}

/** A number field shows the value in force, except while it is being edited or a request is pending. */
function fill(input, value, why, isPending) {
  input.disabled = Boolean(why);
  input.title = why ?? "";
  setAttribute(input, "data-pending", isPending ? "" : null);
  if (why) edited.delete(input);
  if (!edited.has(input) && !isPending && input.value !== String(value)) input.value = value;
}

function refreshFactors(info, now, why) {
  const text = info.scaling.join();
  if (choices.dataset.of !== text) {
    choices.dataset.of = text;
    const button = (value) => make("button", { "data-factor": value, onclick: () => setFactor(value) }, factor(value));
    choices.replaceChildren(...info.scaling.map(button));
  }
  const requested = pending(`scaling:${name()}`)?.event.scaling;
  for (const button of choices.querySelectorAll("button")) {
    const value = Number(button.dataset.factor);
    button.disabled = Boolean(why);
    setAttribute(button, "aria-pressed", now?.scaling === value);
    setAttribute(button, "data-pending", requested === value ? "" : null);
  }
}

const rateOf = (fps) => (fps === undefined ? "–" : `${Math.round(10 * fps) / 10}`);

function refreshComparison(now) {
  const applied = now?.applied ?? {};
  const yes = (value) => (value === undefined ? "–" : value ? "yes" : "no");
  const differs = now ? unapplied(now) : [];
  // An encoder that gets no frames keeps its last setting: that is not the sent bitrate.
  const kept = (value) => (applied.sending === false && value !== "–" ? `– (keeps ${value})` : value);
  const values = {
    sending: [yes(now?.sending), yes(applied.sending)],
    bitrate: [whole(now?.kbps), kept(whole(applied.bitrate))],
    rate: [rateOf(now?.fps), kept(rateOf(applied.fps))],
    size: [size(now?.width, now?.height), kept(size(applied.size?.width, applied.size?.height))],
    ROI: [region(now?.roi), region(applied.roi)],
  };
  rows.get("rate").row.hidden = now?.fps === undefined; // no rule sets it
  for (const [key, { row, cells }] of rows) {
    setText(cells[0], values[key][0]);
    setText(cells[1], differs.includes(key) ? `◌ ${values[key][1]}` : values[key][1]);
    setAttribute(row, "data-differs", differs.includes(key) ? "" : null);
  }
  setText(differing, differs.length ? "◌ pending" : "");
  differing.title = differs.length ? "decided, not yet read back" : "";
}

/** Latency by stage. Stages are sampled on different pictures, so their sum only approximates the latency. */
function refreshStages() {
  const isSilent = !store.connected || !decisionOf(name())?.sending || STALE.includes(store.status[name()]);
  const drawn = isSilent ? undefined : store.ages[name()];
  const stages = isSilent ? undefined : store.sample?.cameras[name()]?.stages_ms;
  const parts = { ...stages, ...(Number.isFinite(drawn?.age_ms) ? drawn?.parts_ms : {}) };
  for (const [stage, cell] of latencies) setText(cell, tenth(parts[stage]));
  setText(age, latency(drawn?.age_ms, drawn?.bound_ms));
}

function onSelected() {
  edited = new Set();
  bitrate.reset();
  refresh();
}

export function startPanel() {
  free.addEventListener("change", () => setFactor(+free.value));
  weight.addEventListener("change", setWeight);
  for (const side of SIDES) sides[side].addEventListener("keydown", ({ key }) => key === "Enter" && sendSides());
  const numbers = SIDES.map((side) => make("label", {}, make("span", {}, side), sides[side]));
  const controls = make(
    "div", { class: "controls" }, byHand,
    field("Bitrate", bitrate.element),
    field("Factor", choices, free),
    field("ROI", make("div", { class: "sides" }, ...numbers)),
    make("div", { class: "field" }, apply, full, locked),
    part,
    make("div", { class: "beside" }, field("Weight", weight, weightNote), frame.element),
  );
  const head = make("div", { class: "head" }, swatch, title, status, straight, on);
  const more = make("span", { class: "more", "aria-hidden": "true" }, "Why?"); // "disclosure triangle" in a screen reader
  const why = make("details", { class: "why-decided" }, make("summary", {}, reason, more), formula);
  byId("camera-panel").append(head, why, controls, comparison());
  byId("latency-panel").append(stageTable());
  listen("state", (state) => state.online && origin.update(state));
  listen("hello state sample control requests socket status theme straight aspect crop", refresh);
  listen("selected", onSelected);
}
