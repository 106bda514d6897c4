/** Changes of the Drive view's places: a camera goes to another place, and the one there takes its own. Pure. */

/** @typedef {"front"|"left"|"right"|"rear"} Single a place for one camera */
/** @typedef {{front: string, left?: string|null, right?: string|null, rear?: string|null, row?: string[]}} Places names of cameras */

/** @type {Single[]} */
const SINGLES = ["front", "left", "right", "rear"];
/** @type {("left"|"right"|"rear"|"row")[]} */
const SLOTS = ["left", "right", "rear", "row"];

/**
 * The places of the cameras by their roles.
 * @param {import("./arrange.js").Roles} roles
 * @returns {Required<Places>}
 */
export function placesOf({ front, left, right, rear, others }) {
  const name = (camera) => camera?.name ?? null;
  return { front: name(front), left: name(left), right: name(right), rear: name(rear), row: others.map(name) };
}

/** Where a camera is. @param {Required<Places>} places  @param {string} name  @returns {Single|"row"} */
export const placeOf = (places, name) => SINGLES.find((place) => places[place] === name) ?? "row";

/**
 * The places after a camera has gone to another one. The front is never empty: what is there leaves only for another camera.
 * @param {Required<Places>} places  @param {string} name  @param {Single|"row"} to
 * @param {number} at place in the row, from 0
 * @returns {Required<Places>}
 */
export function moved(places, name, to, at = places.row.length) {
  const from = placeOf(places, name);
  if (to === "row" && from === "front") return places;
  if (to === "row") {
    const others = places.row.filter((other) => other !== name);
    return { ...without(places, from, name, null), row: inserted(others, name, at) };
  }
  const there = places[to];
  if (from === to || (from === "front" && !there)) return places;
  return { ...without(places, from, name, there), [to]: name };
}

/** The places with another camera, or none, where one was. */
function without(places, from, name, instead) {
  if (from !== "row") return { ...places, [from]: instead };
  return { ...places, row: places.row.flatMap((other) => (other !== name ? [other] : instead ? [instead] : [])) };
}

function inserted(row, name, at) {
  const i = Math.max(0, Math.min(row.length, at));
  return [...row.slice(0, i), name, ...row.slice(i)];
}

/** A place of a camera one step along the row. @param {Required<Places>} places  @param {string} name  @param {number} step */
export const shifted = (places, name, step) =>
  (placeOf(places, name) === "row" ? moved(places, name, "row", places.row.indexOf(name) + step) : places);

/**
 * The place at a point where no picture of another place is: the front camera's own wherever no slot is.
 * @param {number} x  @param {number} y  @param {import("./arrange.js").Slots} slots
 * @returns {Single|"row"}
 */
export function placeAt(x, y, slots) {
  const isInside = (box) => x >= box.x && x < box.x + box.width && y >= box.y && y < box.y + box.height;
  return SLOTS.find((place) => isInside(slots[place])) ?? "front";
}

/** What a place is called. @param {Required<Places>} places  @param {string} name */
export function placeText(places, name) {
  const place = placeOf(places, name);
  return { front: "middle", left: "left", right: "right", rear: "mirror", row: `row, number ${places.row.indexOf(name) + 1}` }[place];
}

/** The places as they are saved: those that are taken. @param {Required<Places>} places  @returns {Places} */
export const stated = (places) => /** @type {Places} */ (Object.fromEntries(Object.entries(places).filter(([, value]) => value?.length)));
