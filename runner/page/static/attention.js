/** Whether the operator can see this page, it draws enough pictures, and its keys reach it. Pure; ms. */

const NOTICED_MS = 500; // a shorter absence, as of a dialog of the browser, is not worth a word

/** Absences of the operator, from the events of page and window. */
export class Attention {
  hidden = false;
  focused = true;
  elsewhere = false; // whether keys reach another window of this page
  /** @type {number|null} since when the page is hidden or out of focus */
  since = null;
  saw = true; // whether the page was visible all that time
  slow = false; // whether too few pictures are drawn

  /**
   * The page is hidden or not, in focus or not, as one of its other windows is or not, and draws too few pictures or not.
   * @param {{hidden: boolean, focused: boolean, elsewhere?: boolean, slow?: boolean}} page
   * @param {number} now
   * @returns {string|null} what to tell an operator who has just returned
   */
  changed({ hidden, focused, elsewhere = false, slow = false }, now) {
    Object.assign(this, { hidden, focused, elsewhere, slow });
    if (hidden || !(focused || elsewhere)) {
      if (this.since === null) Object.assign(this, { since: now, saw: true });
      this.saw &&= !hidden;
      return null;
    }
    const away = this.since === null ? 0 : now - this.since;
    this.since = null;
    if (away < NOTICED_MS) return null;
    const seconds = `${Math.max(1, Math.round(away / 1000))} s`;
    return this.saw ? `No key reached this page for ${seconds}` : `This page was hidden for ${seconds}: look at every picture`;
  }

  /**
   * In one word, as the vehicle is told it.
   * @returns {"watching"|"unfocused"|"slow"|"hidden"}
   */
  get state() {
    if (this.hidden) return "hidden";
    if (this.slow) return "slow";
    return this.focused ? "watching" : "unfocused";
  }

  /** What to tell an operator who may still see the page; null: all is well. */
  get warning() {
    if (this.state === "slow") return "SLOW: this page draws fewer than 10 pictures a second";
    return this.state === "unfocused" && !this.elsewhere ? "OUT OF FOCUS: keys do not reach this page; click it" : null;
  }
}
