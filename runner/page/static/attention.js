/** Whether the operator can see this page, it draws enough pictures, and its keys reach it. Pure; ms. */

const REPORTED_MS = 500; // a shorter absence, such as for a browser dialog, is not reported

/** Absences of the operator, from the events of page and window. */
export class Attention {
  hidden = false;
  focused = true;
  elsewhere = false; // whether another window of this page has the keyboard focus
  covered = false; // whether another window of this page is hidden
  /** @type {number|null} since when the page is hidden or out of focus */
  away_since = null;
  was_visible = true; // whether the page was visible all that time
  slow = false; // whether too few pictures are drawn

  /**
   * Update the state: the page is hidden, focused, has its focus in another window (elsewhere), has a hidden window
   * (covered), or draws too few pictures.
   * @param {{hidden: boolean, focused: boolean, elsewhere?: boolean, covered?: boolean, slow?: boolean}} page
   * @param {number} now
   * @returns {string|null} message for an operator who has just returned
   */
  update({ hidden, focused, elsewhere = false, covered = false, slow = false }, now) {
    Object.assign(this, { hidden, focused, elsewhere, covered, slow });
    if (hidden || !(focused || elsewhere)) {
      if (this.away_since === null) Object.assign(this, { away_since: now, was_visible: true });
      this.was_visible &&= !hidden;
      return null;
    }
    const away = this.away_since === null ? 0 : now - this.away_since;
    this.away_since = null;
    if (away < REPORTED_MS) return null;
    const seconds = `${Math.max(1, Math.round(away / 1000))} s`;
    return this.was_visible ? `No key reached this page for ${seconds}` : `This page was hidden for ${seconds}: check every picture`;
  }

  /**
   * The state as reported to the vehicle.
   * @returns {"watching"|"unfocused"|"slow"|"hidden"}
   */
  get state() {
    if (this.hidden) return "hidden";
    if (this.slow) return "slow";
    return this.focused ? "watching" : "unfocused";
  }

  /** Warning for an operator who may still see the page; null: none. */
  get warning() {
    if (this.hidden) return null;
    const warnings = [
      !this.focused && !this.elsewhere && "OUT OF FOCUS: keys do not reach this page; click it",
      this.covered && "HIDDEN: another window of this page cannot be seen",
      this.slow && "SLOW: this computer is too busy to draw all pictures that arrive; close other windows and programs",
    ];
    return warnings.filter(Boolean).join(" · ") || null;
  }
}
