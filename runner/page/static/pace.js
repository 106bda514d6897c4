/** Whether this page draws enough of the pictures it receives. Pure; ms. */

const WINDOW_MS = 2000;
const ENOUGH = 10; // pictures per second, from which a driver can judge movement
const SHARE = 0.8; // of the pictures of a camera that sends fewer

/** Counts the pictures of one camera: due to be drawn, and drawn. */
export class Pace {
  /** @type {{time: number, due: number, drawn: number}[]} */
  counts = [];

  /** @param {number} time  @param {number} due  @param {number} drawn so far */
  add(time, due, drawn) {
    this.counts.push({ time, due, drawn });
    while (this.counts.length > 1 && time - this.counts[1].time >= WINDOW_MS) this.counts.shift();
  }

  /** Whether fewer than 10 pictures a second were drawn over the last two seconds although more were due; false at first. */
  get isSlow() {
    const [first, last] = [this.counts[0], this.counts[this.counts.length - 1]];
    if (!first || last.time - first.time < WINDOW_MS) return false;
    const perSecond = (key) => (1000 * (last[key] - first[key])) / (last.time - first.time);
    return perSecond("drawn") < Math.min(ENOUGH, SHARE * perSecond("due"));
  }
}
