/** The station's clock, seen from this page. */

const KEPT = 20; // echoes; one a second
const DRIFT_MS = 2; // between two clocks in that time

/** Milliseconds since the epoch, by the page's own steady clock. */
export const now = () => performance.timeOrigin + performance.now();

/**
 * Offset between the station's clock and the page's. An echo bounds it to within half its delay; the bounds of the
 * fastest recent echo apply, so that slow echoes of a busy start do not move the clock.
 */
export class Clock {
  echoes = [];
  offset = 0;
  bound = Infinity; // error bound of the offset, ms

  /** @param {number} sent when the page sent the request (page clock)  @param {number} server the station's clock */
  onEcho(sent, server) {
    const received = now();
    const echo = { delay: received - sent, offset: server - (sent + received) / 2 };
    this.echoes.push(echo);
    if (this.echoes.length > KEPT) this.echoes.shift();
    // An older echo that the newest one contradicts predates a clock change.
    const agreeing = this.echoes.filter((e) => Math.abs(e.offset - echo.offset) <= (e.delay + echo.delay) / 2 + DRIFT_MS);
    const best = agreeing.reduce((a, b) => (b.delay < a.delay ? b : a));
    this.offset = Math.min(Math.max(this.offset, best.offset - best.delay / 2), best.offset + best.delay / 2);
    this.bound = best.delay / 2 + Math.abs(this.offset - best.offset);
  }

  /** Convert a page time to the station's clock. */
  toStation(pageTime) {
    return pageTime + this.offset;
  }
}
