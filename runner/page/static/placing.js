/** Changes of the Drive view's places: a camera goes to another place, and the one there takes its own. Pure. */

/** @typedef {"front"|"left"|"right"|"rear"} Single a place for one camera */
/** @typedef {{front: string, left?: string|null, right?: string|null, rear?: string|null, row?: string[]}} Places names of cameras */
/** @typedef {{width: number, height: number}} Size px */

/** @type {Single[]} */
const SINGLES = ["front", "left", "right", "rear"];
const SIDE = 0.15; // share of the area's width at either side for the neighbours
const BELOW = 0.12; // share of the height for the row
const MIRROR = 0.3; // share of the width, in the middle of the band, for the mirror

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
 * The place at a point where no picture is, or only the front camera's, whose edges stand for the places around it.
 * @param {number} x  @param {number} y  @param {Size} area  @param {number} band height of the band at the top
 * @returns {Single|"row"}
 */
export function placeAt(x, y, { width, height }, band) {
  if (y < band) return "rear";
  if (y > height * (1 - BELOW)) return "row";
  return x < width * SIDE ? "left" : x > width * (1 - SIDE) ? "right" : "front";
}

/**
 * The part of the area that stands for a place without a picture.
 * @param {Single|"row"} place  @param {Size} area  @param {number} band
 * @returns {import("./arrange.js").Box}
 */
export function boxOf(place, { width, height }, band) {
  const [side, below] = [width * SIDE, height * BELOW];
  const middle = { y: band, height: height - band - below };
  if (place === "rear") return { x: (width * (1 - MIRROR)) / 2, y: 0, width: width * MIRROR, height: band };
  if (place === "row") return { x: 0, y: height - below, width, height: below };
  if (place === "front") return { x: side, width: width - 2 * side, ...middle };
  return { x: place === "left" ? 0 : width - side, width: side, ...middle };
}

/** What a place is called. @param {Required<Places>} places  @param {string} name */
export function placeText(places, name) {
  const place = placeOf(places, name);
  return { front: "middle", left: "left", right: "right", rear: "mirror", row: `row, number ${places.row.indexOf(name) + 1}` }[place];
}

/** The places as they are saved: those that are taken. @param {Required<Places>} places  @returns {Places} */
export const stated = (places) => /** @type {Places} */ (Object.fromEntries(Object.entries(places).filter(([, value]) => value?.length)));
