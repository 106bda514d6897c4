/** Notices that another page has taken control from this one. Pure. */

export class Holding {
  #had = false; // whether this page had control
  /** Whether this page has lost control without releasing it, and has not got it back. */
  isLost = false;

  /** This page releases control by itself. */
  onRelease() {
    this.#had = false;
  }

  /**
   * The station names the holder.
   * @param {string} holder you, another or nobody
   * @returns {boolean} whether control has just been lost
   */
  update(holder) {
    const lost = this.#had && holder !== "you";
    this.#had = holder === "you";
    this.isLost = !this.#had && (lost || this.isLost);
    return lost;
  }
}
