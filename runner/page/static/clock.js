/** The station's clock, seen from this page. */

const KEPT = 20; // echoes; one a second

/** Milliseconds since the epoch, by the page's own steady clock. */
export const now = () => performance.timeOrigin + performance.now();

/**
 * Offset between the station's clock and the page's. An echo bounds it to within half its delay; the bounds of the
 * fastest recent echo apply, so that slow echoes of a busy start do not move the clock.
 */
export class Clock {
  echoes = [];
  offset = 0;
  bound = Infinity; // by how much the offset may be wrong, ms

  /** @param {number} sent when the page asked (page clock)  @param {number} server the station's clock */
  heard(sent, server) {
    const received = now();
    this.echoes.push({ delay: received - sent, offset: server - (sent + received) / 2 });
    if (this.echoes.length > KEPT) this.echoes.shift();
    const best = this.echoes.reduce((a, b) => (b.delay < a.delay ? b : a));
    this.bound = best.delay / 2;
    this.offset = Math.min(Math.max(this.offset, best.offset - best.delay / 2), best.offset + best.delay / 2);
  }

  /** A page time converted to the station's clock. */
  server(page) {
    return page + this.offset;
  }
}
