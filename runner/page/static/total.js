/** The total bitrate: where it comes from in each mode, and the operator's slider for mode C. */

import { inControl, listen, mode, store } from "./store.js";
import { pending, request, showProblem, whyNoControl } from "./requests.js";
import { makeSlider } from "./slider.js";
import { believedWords, furtherReasons } from "./believed.js";
import { limitWords, setterWords } from "./reasons.js";
import { copiesWords, ofWords, sliderValue, totalsOf } from "./totals.js";
import { showUplinks, uplinkLines } from "./uplinks.js";
import { byId, capital, KBPS, make, rate, setText, whole } from "./format.js";

const BY_HAND = "; choose C to set it.";

const figure = make("b", { class: "large" });
const requested = make("span", { class: "muted" }); // the total before rules lowered it
const copies = make("span", { class: "muted" });
const prediction = make("b", { class: "large" });
const why = make("p", { class: "why" });
const believed = make("p", { class: "why", id: "believed" });
const uplinks = make("div", { id: "uplinks", role: "group", "aria-label": "Uplinks" });
const slider = makeSlider({
  label: "total bitrate",
  data: "total",
  id: "total-kbps",
  control: () => "total",
  send,
});

/** What all cameras could use, in all copies. */
const maxTotal = () =>
  (totalsOf(store.state)?.copies ?? 1) * (store.hello?.cameras ?? []).reduce((sum, { b_full_kbps }) => sum + b_full_kbps, 0);

/** Why the operator cannot set the total; null: they can. */
function whyNot() {
  const now = mode();
  if (!now) return "The vehicle is offline.";
  if (now === "single") return `Sum of the cameras${BY_HAND}`;
  if (now === "automatic") return `${setterWords(store.state, Number.isFinite(store.sample?.predicted_kbps))}${BY_HAND}`;
  return inControl() ? null : `${capital(whyNoControl())}.`;
}

function send(kbps) {
  request("total", { event: "total_set", kbps }, `total ${rate(kbps)}`);
}

/** Scale the total, or the one already requested; a reduction starts from what the rules have left of it. */
export function scaleTotal(scale) {
  const reason = whyNot();
  if (reason) return showProblem(reason);
  const totals = totalsOf(store.state);
  const from = pending("total")?.event.kbps ?? (scale < 1 ? totals?.total : totals?.wanted);
  send(Math.max(1, Math.min(maxTotal(), Math.round(scale * from))));
}

function refresh() {
  const totals = totalsOf(store.state);
  const reason = whyNot();
  setText(figure, whole(totals?.total));
  setText(requested, ofWords(totals));
  setText(copies, copiesWords(totals));
  setText(prediction, whole(store.sample?.predicted_kbps));
  const words = believedWords(mode() ? store.state?.believed : undefined);
  const lines = uplinkLines(store.state, store.sample);
  const limits = ofWords(totals) ? limitsWords(words, lines.length > 0) : "";
  show(why, [reason ?? "Shared among the cameras by demand and weight.", limits].filter(Boolean).join(" "));
  show(believed, words);
  showUplinks(uplinks, lines);
  slider.update({ value: sliderValue(totals, mode()), inForce: totals?.total, max: maxTotal(), why: reason });
}

/** What limits the total, without what the words on the link say. @param {string} words  @param {boolean} hasUplinks */
function limitsWords(words, hasUplinks) {
  const reasons = limitReasons();
  const all = furtherReasons(reasons, words).map(limitWords).join("; ");
  const text = reasons.length ? all : hasUplinks ? "limited by the uplinks" : "limited by a rule";
  return text && `${capital(text)}.`;
}

function show(line, text) {
  setText(line, text);
  line.hidden = !text;
}

/** Why the total is limited. */
export const limitReasons = () => commonReasons("total ");
/** Why no camera is sent; undefined: no rule stops them. */
export const pauseReason = () => commonReasons("not sending: ").at(-1);

/** The parts of the reason that concern all cameras. @param {string} beginning */
function commonReasons(beginning) {
  const [camera] = Object.values(store.state?.cameras ?? {}).filter(({ on }) => on);
  return camera?.reason.split("; ").filter((part) => part.startsWith(beginning)) ?? [];
}

export function startTotal() {
  const unit = () => make("span", { class: "muted" }, ` ${KBPS}`);
  const predicted = make("div", { class: "prediction" }, make("span", {}, "Predicted "), prediction, unit());
  const inForce = make("div", {}, make("span", {}, "Total "), figure, requested, unit(), copies);
  byId("total-panel").append(make("div", { class: "figures" }, inForce, predicted), slider.element, why, believed, uplinks);
  listen("hello state sample control requests socket", refresh);
  refresh();
}
