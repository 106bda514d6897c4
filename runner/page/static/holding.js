/** Notices that another page has taken control from this one, or that a release has not been received. Pure. */

export class Holding {
  #had = false; // whether this page had control
  /** Whether this page has lost control without releasing it, and has not got it back. */
  isLost = false;
  /** Whether this page has released control, and the station has not named another holder yet. */
  isReleasing = false;

  /** This page releases control by itself. */
  onRelease() {
    this.#had = false;
    this.isReleasing = true;
  }

  /** This page asks for control. */
  onTake() {
    this.isReleasing = false;
  }

  /**
   * The station names the holder.
   * @param {string} holder you, another or nobody
   * @returns {boolean} whether control has just been lost
   */
  update(holder) {
    if (holder !== "you") this.isReleasing = false;
    const lost = this.#had && holder !== "you";
    this.#had = holder === "you" && !this.isReleasing;
    this.isLost = !this.#had && (lost || this.isLost);
    return lost;
  }
}
