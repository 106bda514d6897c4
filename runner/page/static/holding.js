/** Notices that control was taken from this page, that a release has not been received, or that the vehicle has lost its operator. Pure. */

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

const RETURN_MS = 2000; // by then a vehicle that comes online, perhaps newly started, has heard of its operator

/** Notices that the vehicle no longer has an operator in control although its state arrives: one direction of the link has failed. Pure. */
export class Hearing {
  #hadOperator = false; // whether any state has named one
  #wasOnline = false;
  #excusedUntil = 0; // ms
  /** Whether the vehicle receives nothing from this station. */
  isLost = false;

  /**
   * To be called with each state, and a few times a second.
   * @param {{online: boolean, operator?: string}|null} state of the vehicle; null: unknown
   * @param {number} now ms
   * @returns {boolean} whether it has just been lost
   */
  update(state, now) {
    const isOnline = state?.online === true;
    const isNamed = isOnline && state?.operator !== undefined;
    if (isOnline && !this.#wasOnline) this.#excusedUntil = now + RETURN_MS;
    if (isNamed) this.#excusedUntil = now;
    this.#hadOperator ||= isNamed;
    this.#wasOnline = isOnline;
    const wasLost = this.isLost;
    this.isLost = isOnline && !isNamed && this.#hadOperator && now >= this.#excusedUntil;
    return this.isLost && !wasLost;
  }
}
