/** Whether this page draws enough of the pictures it receives. Pure; ms. */

const WINDOW_MS = 2000;
export const ENOUGH = 10; // pictures per second, from which a driver can judge movement
const SHARE = 0.8; // of the pictures of a camera that sends fewer

/** Counts the pictures of one camera: due to be drawn, and drawn. */
export class Pace {
  /** @type {{time: number, due: number, drawn: number, moves: boolean}[]} */
  counts = [];

  /** @param {number} fps that the camera sends */
  constructor(fps) {
    this.fps = fps;
  }

  /** Count from now on. */
  restart() {
    this.counts = [];
  }

  /** @param {number} time  @param {number} due  @param {number} drawn so far  @param {boolean} moves whether the picture moves now */
  add(time, due, drawn, moves) {
    this.counts.push({ time, due, drawn, moves });
    while (this.counts.length > 1 && time - this.counts[1].time >= WINDOW_MS) this.counts.shift();
  }

  /**
   * Whether fewer than 10 pictures a second were drawn over the last two seconds, or of a slower camera less than 80 % of
   * those that were due; false at first. While a picture is paused or lost, none are due.
   */
  get isSlow() {
    const [first, last] = [this.counts[0], this.counts[this.counts.length - 1]];
    if (!first || last.time - first.time < WINDOW_MS) return false;
    const perSecond = (key) => (1000 * (last[key] - first[key])) / (last.time - first.time);
    const isSteady = this.fps * SHARE >= ENOUGH && this.counts.every(({ moves }) => moves);
    return perSecond("drawn") < (isSteady ? ENOUGH : Math.min(ENOUGH, SHARE * perSecond("due")));
  }
}
