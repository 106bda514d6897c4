/** What a list of vehicles says of each, from what its station says. Pure. */

import { latency, whole } from "./format.js";

/**
 * @typedef {object} Summary what a station says of its vehicle, see runner/operator/summary.py
 * @property {boolean} online
 * @property {string|null} fault why there is no control link
 * @property {string|null} mode
 * @property {string|null} driver id of the operator in control
 * @property {boolean} is_own whether that is this station's
 * @property {number|null} speed_mps
 * @property {number|null} latency_ms
 * @property {number|null} bound_ms
 * @property {number|null} total_kbps
 * @property {number} actual_kbps
 * @property {number|null} believed_kbps
 * @property {string[]} alarms
 * @property {string[]} cameras
 * @property {string[]} received
 *
 * @typedef {{name: string, fault: string|null, summary: Summary|null}} Row fault: why its station does not run
 * @typedef {{level: "fine"|"near"|"late"|"unknown", text: string}} Words
 */

/** Whether the vehicle can be reached, or why not. @param {Row} row @returns {Words} */
export function stateOf({ fault, summary }) {
  if (fault) return { level: "late", text: `✕ ${fault}` };
  if (!summary) return { level: "unknown", text: "its station is starting" };
  if (summary.online) return { level: "fine", text: "● online" };
  return summary.fault ? { level: "late", text: `✕ ${summary.fault}` } : { level: "unknown", text: "○ offline" };
}

/** Who drives it. @param {Row} row @returns {Words} */
export function driverOf({ summary }) {
  if (!summary?.online) return { level: "unknown", text: "–" };
  if (summary.is_own) return { level: "fine", text: "You drive" };
  return summary.driver ? { level: "near", text: `${summary.driver} drives` } : { level: "unknown", text: "Nobody drives" };
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
function linkWords({ received, actual_kbps, total_kbps, believed_kbps }) {
  const rate = received.length ? `${whole(actual_kbps)} of ${whole(total_kbps)}` : whole(total_kbps);
  return `${rate} kbit/s${believed_kbps === null ? "" : `, can carry ${whole(believed_kbps)}`}`;
}

/** @param {Row} row */
export const alarmsOf = ({ summary }) => summary?.alarms ?? [];

/**
 * The camera of the small picture: the one that looks ahead, by its name, otherwise the first that is on; null: none is.
 * @param {Row} row
 */
export function pictureOf({ summary }) {
  const cameras = summary?.online ? summary.cameras : [];
  const ahead = cameras.filter((name) => name.includes("front"));
  return ahead.find((name) => name.includes("cent")) ?? ahead[0] ?? cameras[0] ?? null;
}
