/** What a list of vehicles says of each, from what its station says. Pure. */

import { latency, rate, whole } from "./format.js";

/**
 * @typedef {object} Summary what a station says of its vehicle, see runner/operator/summary.py
 * @property {boolean} online
 * @property {string|null} fault why there is no control link
 * @property {string|null} mode
 * @property {"free"|"held"|"lost"|null} control
 * @property {string|null} holder id of the operator that is in control, or was until it was lost
 * @property {number} held_s
 * @property {string|null} offered to whom control is offered
 * @property {string[]} requested who asks for it
 * @property {boolean} is_own whether the holder is this station's operator
 * @property {number|null} speed_mps
 * @property {number|null} latency_ms
 * @property {number|null} bound_ms
 * @property {number|null} allocated_kbps
 * @property {number} actual_kbps
 * @property {number|null} believed_kbps
 * @property {string[]} alarms
 * @property {string[]} cameras
 * @property {string[]} received
 *
 * @typedef {{name: string, fault: string|null, summary: Summary|null, answer: string}} Row
 *   fault: why its station does not run; answer: why control was not released
 * @typedef {{level: "fine"|"near"|"late"|"unknown", text: string}} Words
 */

/** Whether the vehicle can be reached, or why not. @param {Row} row @returns {Words} */
export function stateOf({ fault, summary }) {
  if (fault) return { level: "late", text: `✕ ${fault}` };
  if (!summary) return { level: "unknown", text: "its station is starting" };
  if (summary.online) return { level: "fine", text: "● online" };
  return summary.fault ? { level: "late", text: `✕ ${summary.fault}` } : { level: "unknown", text: "○ offline" };
}

/** Who drives it, and who wants to. @param {Row} row @returns {Words} */
export function driverOf({ summary }) {
  if (!summary?.online || !summary.control) return { level: "unknown", text: "–" };
  const { control, holder, is_own, held_s, offered, requested } = summary;
  const further = [offered ? `; offered to ${offered}` : "", ...requested.map((name) => `; ${name} would like to`)].join("");
  const time = duration(held_s);
  if (control === "free") return { level: "unknown", text: `Nobody drives${further}` };
  const was = is_own ? "You were" : `${holder} was`;
  if (control === "lost") return { level: "late", text: `✕ ${was} in control: LOST for ${time}${further}` };
  if (is_own) return { level: "fine", text: `You drive, for ${time}${further}` };
  return { level: "near", text: `${holder} drives, for ${time}${further}` };
}

/** 45 s, 12 min, 3 h. @param {number} seconds */
function duration(seconds) {
  if (seconds < 60) return `${Math.floor(seconds)} s`;
  return seconds < 3600 ? `${Math.floor(seconds / 60)} min` : `${Math.floor(seconds / 3600)} h`;
}

/** @param {Row} row */
export function figuresOf({ summary }) {
  const known = summary?.online ? summary : null;
  const speed = known?.speed_mps ?? null;
  return {
    speed: speed === null ? "–" : `${whole(3.6 * speed)} km/h`,
    latency: known ? latency(known.latency_ms, known.bound_ms) : "–",
    link: known ? linkWords(known) : "–",
  };
}

/** What arrives here, of what the vehicle sends, or would. @param {Summary} summary */
function linkWords({ received, actual_kbps, allocated_kbps, believed_kbps }) {
  const arriving = received.length ? rate(actual_kbps, allocated_kbps) : rate(allocated_kbps);
  return `${arriving}${believed_kbps === null ? "" : `, can carry ${whole(believed_kbps)}`}`;
}

/** @param {Row} row */
export const alarmsOf = ({ summary, answer }) =>
  [...(summary?.alarms ?? []), ...(answer ? [`control was not released: ${answer}`] : [])];

/** A row as it is to somebody who only watches at this station, and is not its operator. @param {Row} row @returns {Row} */
export const toWatcher = (row) => ({ ...row, summary: row.summary && { ...row.summary, is_own: false }, answer: "" });

/** Whether control can be released here. @param {Row} row */
export const isHeldHere = ({ summary }) => Boolean(summary?.online && summary.is_own && summary.control === "held");

/**
 * The camera of the small picture: the one that looks ahead, by its name, otherwise the first that is on; null: none is.
 * @param {Row} row
 */
export function pictureOf({ summary }) {
  const cameras = summary?.online ? summary.cameras : [];
  const ahead = cameras.filter((name) => name.includes("front"));
  return ahead.find((name) => name.includes("cent")) ?? ahead[0] ?? cameras[0] ?? null;
}
