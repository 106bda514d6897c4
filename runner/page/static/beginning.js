/** A picture's first second: until it was live for that long it is synchronising, whatever else it may be. Pure; ms. */

const FIRST_MS = 1000;
export const AT_MOST_MS = 3000; // from the start to a first unit, and from the first picture to an alarm
const HELD = ["live", "late", "damaged", "frozen"];

/** Of a stream that starts: the page was opened, or the camera switched on. One that was lost and returns begins no more. */
export class Beginning {
  isOver = false;
  /** @type {number|null} */
  #drawn_at = null; // when its first picture was judged
  /** @type {number|null} */
  #live_since = null;

  /**
   * The status to show.
   * @template {string} S
   * @param {S} status as judged from times alone
   * @param {boolean} drawn whether a picture was drawn since the start
   * @param {number} now
   * @returns {S|"synchronising"}
   */
  shown(status, drawn, now) {
    if (this.isOver || !drawn) return status;
    this.isOver = status === "lost";
    if (!HELD.includes(status)) return status;
    this.#drawn_at ??= now;
    this.#live_since = status === "live" ? (this.#live_since ?? now) : null;
    this.isOver = now - (this.#live_since ?? now) >= FIRST_MS || now - this.#drawn_at >= AT_MOST_MS;
    return this.isOver ? status : "synchronising";
  }
}
