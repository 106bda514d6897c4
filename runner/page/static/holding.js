/** Notices that this page has gained control, passed it on, or lost it. Pure. */

const RETURN_MS = 2000; // by then a vehicle that comes online, perhaps newly started, has heard of its operator

/** What a page knows of its control. */
export class Holding {
  /** @type {boolean|null} whether this page had control; null: it has just opened */
  #had = null;
  #excusedUntil = Infinity; // ms
  /** Whether this page has lost control without releasing it, and has not got it back. */
  isLost = false;

  /** Whether the vehicle has had time to hear of its operators since it came online. @param {number} now ms */
  isSettled = (now) => now >= this.#excusedUntil;

  /**
   * To be called with each change of who drives, and a few times a second.
   * @param {import("./driving.js").Who} who drives
   * @param {"offered"|"released"|null} given how this page's operator has given up control, by the vehicle's account
   * @param {number} now ms
   * @returns {"gained"|"passed"|"lost"|null} what has just happened
   */
  update(who, given, now) {
    if (who === "unknown") {
      this.#excusedUntil = Infinity;
      return null;
    }
    if (this.#excusedUntil === Infinity) this.#excusedUntil = now + RETURN_MS;
    if (who === "you") return this.#onGained(now);
    this.#had ??= false;
    if (!this.#had || (["free", "unheard"].includes(who) && !given && !this.isSettled(now))) return null;
    this.#had = false;
    this.isLost = given === null;
    if (this.isLost) return "lost";
    return who === "operator" ? "passed" : null;
  }

  #onGained(now) {
    const had = this.#had;
    this.#had = true;
    this.isLost = false;
    this.#excusedUntil = Math.min(this.#excusedUntil, now);
    return had === false ? "gained" : null;
  }
}
