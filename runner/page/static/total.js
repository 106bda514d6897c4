/** The total bitrate: where it comes from in each mode, and the operator's slider for mode C. */

import { inControl, listen, mode, store } from "./store.js";
import { complain, pending, request, whyNoControl } from "./requests.js";
import { makeSlider } from "./slider.js";
import { by, make, write, whole } from "./format.js";

const WHY = {
  single: "sum of the bitrates set in mode S; choose C to set it",
  automatic: "set by the prediction in mode A; choose C to set it",
};

const figure = make("b", { class: "large" });
const limited = make("span", { class: "muted" }); // what prediction or operator asked for, where it is more
const prediction = make("b", { class: "large" });
const why = make("p", { class: "why" });
const slider = makeSlider({
  label: "total bitrate",
  data: "total",
  id: "total-kbps",
  control: () => "total",
  send,
});

/** What the total is set to, which a rule may lower. */
const wished = () => (mode() ? (store.state?.asked_kbps ?? store.state?.total_kbps) : undefined);
const most = () => (store.hello?.cameras ?? []).reduce((sum, { b_full_kbps }) => sum + b_full_kbps, 0);

/** Why the operator cannot set it; null: they can. */
function whyNot() {
  const now = mode();
  return !now ? "the vehicle is offline" : WHY[now] ?? (inControl() ? null : whyNoControl());
}

function send(kbps) {
  request("total", { event: "total_set", kbps }, `total ${kbps} kbit/s`);
}

/** Set the total to so many times what it is about to be; a lower one to less than what a rule has left of it. */
export function changeTotal(times) {
  const reason = whyNot();
  if (reason) return complain(reason);
  const from = pending("total")?.event.kbps ?? (times < 1 ? store.state?.total_kbps : wished());
  send(Math.max(1, Math.min(most(), Math.round(times * from))));
}

function refresh() {
  const total = mode() ? store.state?.total_kbps : undefined;
  const asked = wished();
  const reason = whyNot();
  const less = total !== undefined && asked !== undefined && total < asked;
  write(figure, whole(total));
  write(limited, less ? ` of ${whole(asked)}` : "");
  write(prediction, whole(store.sample?.predicted_kbps));
  write(why, less ? whyLess().join("; ") || "limited by a rule" : reason ?? "shared among the cameras by demand and weight");
  slider.update({ value: asked, max: most(), why: reason });
}

/** Why the total is less than asked for: the parts of the reason that concern all cameras. */
export function whyLess() {
  const [camera] = Object.values(store.state?.cameras ?? {}).filter(({ on }) => on);
  return camera?.reason.split("; ").filter((part) => part.startsWith("total ")) ?? [];
}

export function startTotal() {
  const predicted = make("div", { class: "prediction" }, make("span", {}, "Prediction "), prediction, make("span", { class: "muted" }, " kbit/s"));
  const inForce = make("div", {}, make("span", {}, "Total "), figure, limited, make("span", { class: "muted" }, " kbit/s"));
  by("total-panel").append(make("div", { class: "figures" }, inForce, predicted), slider.element, why);
  listen("hello state sample control requests socket", refresh);
  refresh();
}
