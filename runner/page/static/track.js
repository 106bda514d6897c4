/** The drive so far on a flat map: places in metres, and colours by what was received. Pure. */

const EARTH_M = 6371000;
const RADIANS = Math.PI / 180;
const VIRIDIS = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]]; // as the map of the Configure view
const COMPASS = ["N", "NE", "E", "SE", "S", "SW", "W", "NW"];

/**
 * Positions in metres east and north of the first one; on the scale of a drive the earth is flat. null: there is none.
 * @param {{lat: (number|null)[], lon: (number|null)[], actual_kbps: (number|null)[]}} series
 */
export function metres({ lat, lon, actual_kbps }) {
  const known = lat.flatMap((each, i) => (each === null || lon[i] === null ? [] : [i]));
  if (!known.length) return null;
  const from = { lat: lat[known[0]] ?? 0, lon: lon[known[0]] ?? 0 };
  return {
    x: known.map((i) => ((lon[i] ?? 0) - from.lon) * RADIANS * EARTH_M * Math.cos(from.lat * RADIANS)),
    y: known.map((i) => ((lat[i] ?? 0) - from.lat) * RADIANS * EARTH_M),
    kbps: known.map((i) => actual_kbps[i]),
  };
}

/** The smallest and the largest of some rates; null: none is known. @param {(number|null)[]} rates @returns {[number, number]|null} */
export function rangeOf(rates) {
  const known = rates.flatMap((each) => each ?? []);
  return known.length ? [Math.min(...known), Math.max(...known)] : null;
}

/** The colour of a rate within a range. @param {number} rate  @param {[number, number]} range */
export function colourOfRate(rate, [low, high]) {
  const at = (high > low ? (rate - low) / (high - low) : 1) * (VIRIDIS.length - 1);
  const i = Math.min(Math.floor(at), VIRIDIS.length - 2);
  const mixed = VIRIDIS[i].map((value, channel) => Math.round(value + (at - i) * (VIRIDIS[i + 1][channel] - value)));
  return `rgb(${mixed.join()})`;
}

/** A direction in words: 44 -> "NE 44°". @param {number} deg clockwise from north */
export const headingText = (deg) => `${COMPASS[Math.round(deg / 45) % 8]} ${Math.round(deg) % 360}°`;
