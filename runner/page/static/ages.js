/** The age of the pictures on show, from the times at which each passed: ms on the station's clock. Pure. */

const LAST = 15; // pictures whose median counts
const MOVING = ["live", "late", "damaged"];

/** @typedef {[captured: number, arrived: number, received: number, decoded: number, drawn: number]} Times */

/**
 * The median age of the last pictures drawn, and of its parts on this page: from the station to the page, through the
 * decoder, and until drawn. null: unknown.
 * @param {Times[]} pictures
 */
export function ageOf(pictures) {
  const last = pictures.slice(-LAST);
  const age_ms = Number.isFinite(last.at(-1)?.[0]) ? median(last.map(([captured, , , , drawn]) => drawn - captured)) : null;
  const part = (from, to) => median(last.map((times) => times[to] - times[from]));
  return { age_ms: age_ms === null ? null : Math.max(0, age_ms), parts_ms: { page: part(1, 2), decode: part(2, 3), draw: part(3, 4) } };
}

/**
 * Time between the captures of the oldest and of the newest picture on show; null: fewer than two move.
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
