/** The age of the displayed pictures, from the time at which each passed each stage: ms on the station's clock. Pure. */

import { MOVING } from "./status.js";

const RECENT_MS = 500; // of pictures drawn, for a median
const SLACK_MS = 5; // beyond the error bound
const NEAR = 0.75; // of the limit

/** @typedef {[captured: number, arrived: number, received: number, decoded: number, drawn: number]} Times */

/**
 * The median age of the pictures drawn in the last half second, and of its parts on this page: from the station to the
 * page, through the decoder, and until drawn. null: unknown, also if it would be negative by more than the error bound: a
 * clock has been set, and its difference is not known again yet.
 * @param {Times[]} pictures
 * @param {number} [bound_ms]
 */
export function ageOf(pictures, bound_ms = Infinity) {
  const newest = pictures.at(-1)?.[4] ?? 0;
  const last = pictures.slice(pictures.findLastIndex(([, , , , drawn]) => Math.abs(newest - drawn) > RECENT_MS) + 1);
  const age_ms = Number.isFinite(last.at(-1)?.[0]) ? median(last.map(([captured, , , , drawn]) => drawn - captured)) : null;
  const part = (from, to) => median(last.map((times) => times[to] - times[from]));
  const isKnown = age_ms !== null && age_ms >= -bound_ms - SLACK_MS;
  return { age_ms: isKnown ? Math.max(0, age_ms ?? 0) : null, parts_ms: { page: part(1, 2), decode: part(2, 3), draw: part(3, 4) } };
}

const PARTS = { capture: "capture", encode: "encode", link: "link", buffer: "link", page: "page", decode: "decode", draw: "draw" };

/**
 * Where most of a latency arises; "": nowhere, or unknown.
 * @param {Record<string, number|null>} parts ms by stage
 */
export function mostOf(parts) {
  const known = Object.keys(PARTS).map((stage) => ({ at: PARTS[stage], ms: parts[stage] ?? 0 }));
  const all = known.reduce((sum, { ms }) => sum + ms, 0);
  const share = (at) => known.filter((part) => part.at === at).reduce((sum, { ms }) => sum + ms, 0);
  return known.map(({ at }) => at).find((at) => share(at) > all / 2) ?? "";
}

/** @typedef {{camera: string, status: string, age_ms: number|null, bound_ms: number}} Picture */

/**
 * The moving picture that may be oldest: a late one if there is any, then the one whose age plus error bound is the
 * largest. `level` is "late" if its status is, or where that exceeds the limit, "near" where it exceeds 75 % of it;
 * "unknown" if the age of any moving picture is unknown; "none" if no picture moves.
 * @param {Picture[]} pictures
 * @param {number} late_ms
 * @returns {{camera: string|null, age_ms: number|null, bound_ms: number|null, level: "fine"|"near"|"late"|"unknown"|"none"}}
 */
export function worstOf(pictures, late_ms) {
  const moving = pictures.filter(({ status }) => MOVING.includes(status));
  const unknown = moving.find(({ age_ms, bound_ms }) => !Number.isFinite(age_ms) || !Number.isFinite(bound_ms));
  const none = { age_ms: null, bound_ms: null };
  if (unknown) return { camera: unknown.camera, ...none, level: "unknown" };
  if (!moving.length) return { camera: null, ...none, level: "none" };
  const upperBound = ({ age_ms, bound_ms }) => (age_ms ?? 0) + bound_ms;
  const late = moving.filter(({ status }) => status === "late"); // its median may be below the limit
  const worst = (late.length ? late : moving).reduce((a, b) => (upperBound(b) > upperBound(a) ? b : a));
  const level = late.length || upperBound(worst) > late_ms ? "late" : upperBound(worst) > NEAR * late_ms ? "near" : "fine";
  return { camera: worst.camera, age_ms: worst.age_ms, bound_ms: worst.bound_ms, level };
}

/**
 * Time between the captures of the oldest and the newest displayed picture; null: fewer than two move.
 * @param {{status: string, captured: number}[]} shown
 */
export function skewOf(shown) {
  const captured = shown.filter(({ status }) => MOVING.includes(status)).map((each) => each.captured).filter(Number.isFinite);
  return captured.length > 1 ? Math.max(...captured) - Math.min(...captured) : null;
}

function median(values) {
  const known = values.filter(Number.isFinite).sort((a, b) => a - b);
  return known.length ? known[known.length >> 1] : null;
}
