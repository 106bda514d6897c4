/** Whether this page draws enough of the pictures that come. Pure; ms. */

const OVER_MS = 2000;
const ENOUGH = 10; // pictures a second, on which a driver can judge movement
const SHARE = 0.8; // of the pictures of a camera that sends fewer

/** The pictures of one camera, counted: those that came to be drawn, and those that were. */
export class Pace {
  /** @type {{time: number, due: number, drawn: number}[]} */
  counts = [];

  /** @param {number} time  @param {number} due  @param {number} drawn so far */
  add(time, due, drawn) {
    this.counts.push({ time, due, drawn });
    while (this.counts.length > 1 && time - this.counts[1].time >= OVER_MS) this.counts.shift();
  }

  /** Whether fewer than 10 pictures a second were drawn over the last two seconds though more came; false at first. */
  get slow() {
    const [first, last] = [this.counts[0], this.counts[this.counts.length - 1]];
    if (!first || last.time - first.time < OVER_MS) return false;
    const perSecond = (key) => (1000 * (last[key] - first[key])) / (last.time - first.time);
    return perSecond("drawn") < Math.min(ENOUGH, SHARE * perSecond("due"));
  }
}
