/** Changes of a layout that is being edited: tiles move and grow on a grid, and others make room. Pure. */

import { covered } from "./layout.js";

export const MAX_SPAN = 12;
const MAX_INDEX = 40; // of rows and columns

/** @typedef {import("./layout.js").Place} Place */
/** @typedef {Record<string, Place>} Draft by camera */

/**
 * The places of all cameras, without rows and columns that no tile covers; cameras without a place are in rows below.
 * @param {{name: string}[]} cameras  @param {import("./layout.js").Places} places
 * @returns {Draft}
 */
export function completed(cameras, places) {
  const placed = cameras.flatMap(({ name }) => (places[name] ? [{ name, place: /** @type {Place} */ (places[name]) }] : []));
  const [rows, columns] = ["row", "column"].map((side) => covered(placed.map(({ place }) => place), side));
  const others = cameras.filter(({ name }) => !places[name]);
  const longest = Math.max(columns.length, Math.ceil(Math.sqrt(others.length)));
  const below = (i) => ({ row: rows.length + Math.floor(i / longest), column: i % longest, row_span: 1, column_span: 1 });
  return Object.fromEntries([
    ...placed.map(({ name, place }) => [name, { ...place, row: rows.indexOf(place.row), column: columns.indexOf(place.column) }]),
    ...others.map(({ name }, i) => [name, below(i)]),
  ]);
}

/**
 * A tile at another place. If a single other tile is in the way and fits where this one was, the two swap; otherwise the tiles
 * in the way move down.
 * @param {Draft} draft  @param {string} name  @param {number} row  @param {number} column
 * @returns {Draft}
 */
export function moved(draft, name, row, column) {
  const own = { ...draft[name], row: clamped(row, 0, MAX_INDEX), column: clamped(column, 0, MAX_INDEX) };
  const under = Object.keys(draft).filter((other) => other !== name && overlap(own, draft[other]));
  const { row: up, column: left } = draft[name];
  const given = Object.fromEntries(under.map((other) => [other, { ...draft[other], row: up, column: left }]));
  const swapped = { ...draft, [name]: own, ...given };
  const fits = under.length === 1 && isFree(swapped, under[0]) && isFree(swapped, name);
  return fits ? swapped : withoutOverlaps({ ...draft, [name]: own }, name);
}

/**
 * A resized tile; tiles that it covers move down.
 * @param {Draft} draft  @param {string} name  @param {number} row_span  @param {number} column_span
 * @returns {Draft}
 */
export function resized(draft, name, row_span, column_span) {
  const spans = { row_span: clamped(row_span, 1, MAX_SPAN), column_span: clamped(column_span, 1, MAX_SPAN) };
  return withoutOverlaps({ ...draft, [name]: { ...draft[name], ...spans } }, name);
}

/** Rows and columns up to the last one that a tile covers. */
export function sizeOf(draft) {
  const ends = (side) => Object.values(draft).map((place) => place[side] + place[`${side}_span`]);
  return { rows: Math.max(0, ...ends("row")), columns: Math.max(0, ...ends("column")) };
}

/** One tile stays; the others, from the top, move down as far as they must. */
function withoutOverlaps(draft, first) {
  const done = { [first]: draft[first] };
  const others = Object.keys(draft).filter((name) => name !== first);
  for (const name of others.sort((a, b) => draft[a].row - draft[b].row || draft[a].column - draft[b].column)) {
    const place = { ...draft[name] };
    while (Object.values(done).some((other) => overlap(place, other))) place.row++;
    done[name] = place;
  }
  return Object.fromEntries(Object.keys(draft).map((name) => [name, done[name]]));
}

const isFree = (draft, name) => Object.keys(draft).every((other) => other === name || !overlap(draft[name], draft[other]));

/** Whether two tiles cover the same row of the same column. */
function overlap(a, b) {
  const meet = (side) => a[side] < b[side] + b[`${side}_span`] && b[side] < a[side] + a[`${side}_span`];
  return meet("row") && meet("column");
}

const clamped = (value, least, most) => Math.max(least, Math.min(most, Math.round(value)));
