/** Which tone a change of a picture's status triggers, and how often. Pure; times in ms. */

const REPEAT_MS = 2000; // a link that fails takes eight pictures with it: play one tone
const KINDS = { lost: "lost", frozen: "lost", unsupported: "lost", late: "late", damaged: "late" };

export class Alarm {
  last = { lost: -Infinity, late: -Infinity };

  /** @param {string} status the picture's new status  @param {number} now  @returns {"lost"|"late"|null} the tone that is due */
  due(status, now) {
    const kind = KINDS[status];
    const since = now - Math.max(this.last.lost, kind === "late" ? this.last.late : -Infinity);
    if (!kind || since < REPEAT_MS) return null;
    this.last[kind] = now;
    return kind;
  }
}
