/** Why a camera is sent as it is, in words for a driver; the vehicle's own reason has the formula. Pure. */

import { capital, KBPS, rate, sameRegion, whole } from "./format.js";

const NAMED = { 1: "full size", 0.5: "half size", 0.25: "quarter size" };
const PARTS = [2, 4, 8, 16]; // of a size that has a name: 3/8
const AS_ENCODED = "as the camera encodes it";
const EXCESS = /, more than its b_full of [\d.]+/; // that camera sends more than is stated
const OVER = /, but it sends \d+/; // although it was asked for less
const PAUSED = "not sending: ";
const TOTAL = "total ";

/** A scaling factor as a size: half size, 3/8 size, 0.3 of full size. @param {number} factor */
export function sizeWords(factor) {
  const parts = PARTS.find((each) => Number.isInteger(each * factor));
  return NAMED[factor] ?? (parts ? `${parts * factor}/${parts} size` : `${Number(factor.toPrecision(2))} of full size`);
}

/**
 * What limits the total, without the totals: "total 3000 -> 1690: capacity of the link, believed to be 1690".
 * @param {string} reason
 */
export function limitWords(reason) {
  const words = reason.slice(reason.indexOf(": ") + 2);
  return /\d$/.test(words) ? `${words} ${KBPS}` : words;
}

/**
 * What limits the total, or raises it above what was predicted or set; null: nothing, "link": the link, as most rules say;
 * else what the rule says.
 * @param {string[]} reasons parts of a camera's
 * @param {{total_kbps: number, asked_kbps: number}} state
 */
function limitOf(reasons, { total_kbps, asked_kbps }) {
  if (total_kbps === asked_kbps) return null;
  const words = limitWords(reasons.filter((part) => part.startsWith(TOTAL)).at(-1) ?? "");
  return !words || /\blink\b/.test(words) ? "link" : words;
}

/** How much of its image a camera sends, 0 to 1. @param {import("./framing.js").Size} roi  @param {import("./framing.js").Size} full */
export const shareOf = (roi, full) => (roi.width * roi.height) / (full.width * full.height);

/** @param {number} share */
export const percent = (share) => `${share < 0.01 ? "less than 1" : whole(100 * share)} %`;

/**
 * What a region of interest costs.
 * @param {import("./records.js").CameraState} camera its decision
 * @param {boolean} isSingle whether the mode is S
 * @param {import("./framing.js").Size} full image
 * @param {string} end how to end it
 */
export function regionWords({ roi }, isSingle, full, end) {
  const share = percent(shareOf(roi, full));
  const bitrate = isSingle ? "Its bitrate stays as it is" : `It gets no sharper: the camera asks for ${share} of its bitrate`;
  return `Only ${share} of the image is sent, nobody sees the rest. ${bitrate}. ${end} ends this.`;
}

/** What a region costs that this page alone shows: nothing. Full image, region, and how to end it. */
export function cropWords(roi, full, end) {
  return `This page alone shows ${percent(shareOf(roi, full))} of the image, which is sent and recorded whole. ${end} ends this.`;
}

/**
 * Half size: 1181 of 6000 kbit/s, its share of the 6500 predicted.
 * @param {import("./records.js").CameraState|undefined} camera its decision
 * @param {import("./store.js").State|null} state of the vehicle
 * @param {import("./framing.js").Size} full image
 * @param {boolean} predicted whether there is a prediction
 */
export function reasonWords(camera, state, full, predicted) {
  if (!camera || !state) return "–";
  if (!camera.on) return "Switched off.";
  const [own, ...common] = camera.reason.split("; ");
  if (camera.scaling === null) return `No picture: ${own.replace(/^lost: /, "")}.`;
  if (!camera.sending) return `Paused: ${pauseWords(camera, state, common)}.`;
  const image = { x: 0, y: 0, width: full.width, height: full.height };
  const part = sameRegion(camera.roi, image) ? "" : ` of ${percent(shareOf(camera.roi, full))} of the image`;
  const words = sizeWords(camera.scaling);
  const most = Math.max(camera.kbps, camera.demand_kbps);
  const cause = `${rate(camera.kbps, most)}${causeWords(camera, state, predicted)}`;
  return `${capital(words)}${part}: ${cause}.${slowWords(camera)}`;
}

/** Why it has fewer pictures than its rate, where that is not the link. @param {import("./records.js").CameraState} camera */
const slowWords = ({ slow_fps }) => (slow_fps ? ` Only ${slow_fps} Hz: the camera is slow or the vehicle too busy, not the link.` : "");

function pauseWords({ weight }, { mode }, common) {
  const rule = common.find((part) => part.startsWith(PAUSED));
  if (rule) return rule.slice(PAUSED.length);
  return weight === 0 && mode !== "single" ? "its weight is 0" : "nothing of the total is left for it";
}

/** What limits its bitrate. */
function causeWords({ kbps, demand_kbps, reason }, state, predicted) {
  if (reason.includes(AS_ENCODED)) return `, ${AS_ENCODED}${reason.match(EXCESS)?.[0] ?? ""}`;
  const over = reason.match(OVER)?.[0] ?? "";
  return `${sharedWords(kbps, demand_kbps, reason, state, predicted)}${over && `${over} kbit/s`}`;
}

function sharedWords(kbps, demand_kbps, reason, state, predicted) {
  const { mode, total_kbps, asked_kbps } = state;
  const limit = mode !== "automatic" && total_kbps >= asked_kbps ? null : limitOf(reason.split("; "), state);
  if (mode === "single") return !limit ? "" : `, less than was set: ${limit === "link" ? "the link carries no more" : limit}`;
  if (kbps >= Math.floor(demand_kbps)) return ", all that it can use";
  const total = `, its share of the ${whole(total_kbps)}`;
  if (limit) return limit === "link" ? `${total} the link carries` : `${total} left: ${limit}`;
  return `${total} ${mode === "collective" ? "set" : predicted ? "predicted" : "at the start"}`;
}

/**
 * What sets the total in mode A.
 * @param {import("./store.js").State|null} state
 * @param {boolean} predicted whether there is a prediction
 */
export function setterWords(state, predicted) {
  const camera = Object.values(state?.cameras ?? {}).find(({ on }) => on);
  const limit = state && camera ? limitOf(camera.reason.split("; "), state) : null;
  if (limit) return limit === "link" ? "Set by what the link carries" : "Limited by a rule";
  return predicted ? "Set by the prediction" : "Set by the mode, without a prediction";
}
