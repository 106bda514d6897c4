/** Whether the operator can see this page and its keys reach it. Pure; ms. */

const NOTICED_MS = 500; // a shorter absence, as of a dialog of the browser, is not worth a word

/** Absences of the operator, from the events of page and window. */
export class Attention {
  hidden = false;
  focused = true;
  /** @type {number|null} since when the page is hidden or out of focus */
  since = null;
  saw = true; // whether the page was visible all that time

  /**
   * The page is hidden or not, and in focus or not.
   * @returns {string|null} what to tell an operator who has just returned
   */
  changed({ hidden, focused }, now) {
    Object.assign(this, { hidden, focused });
    if (hidden || !focused) {
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

  /** What to tell an operator who may still see the page; null: all is well. */
  warning() {
    return !this.hidden && !this.focused ? "OUT OF FOCUS: keys do not reach this page; click it" : null;
  }
}
