/** The steering angle at the time of a picture. Pure; rad, and ms on the station's clock. */

const VALID_MS = 300; // an older angle is stale
const KEPT_MS = 5000; // no picture is older
const SHOWN_MS = 1000; // the driver is told the last one for this long

export class Steering {
  /** @type {{at: number, rad: number, gear?: string}[]} rising in time */
  reported = [];

  /** @param {number} at when it was reported  @param {number} rad to the left  @param {string} [gear] */
  onReport(at, rad, gear) {
    this.reported = this.reported.filter((each) => each.at < at && at - each.at < KEPT_MS); // a clock may have been set back
    this.reported.push({ at, rad, gear });
  }

  /** The last report, if it is recent. @param {number} now */
  newest(now) {
    const last = this.reported.at(-1);
    return last && now - last.at <= SHOWN_MS ? last : null;
  }

  /**
   * The angle when a picture was captured: interpolated between two reports, and held for 300 ms after the last one.
   * @param {number} captured NaN if unknown
   * @returns {number|null}
   */
  angleAt(captured) {
    const after = this.reported.find(({ at }) => at >= captured);
    const before = this.reported.findLast(({ at }) => at < captured);
    if (after?.at === captured) return after.rad;
    if (!before || !(captured - before.at <= VALID_MS)) return null;
    if (!after || after.at - before.at > VALID_MS) return before.rad;
    return before.rad + ((after.rad - before.rad) * (captured - before.at)) / (after.at - before.at);
  }
}
