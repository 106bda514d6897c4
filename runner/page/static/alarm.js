/** Which tone a change of a picture's status triggers, and how often. Pure; times in ms. */

const TOGETHER_MS = 1000; // a link that fails takes eight pictures with it: one tone
const REPEAT_MS = 2000; // a picture that flickers does not sound each time
const KINDS = { lost: "lost", frozen: "lost", unsupported: "lost", late: "late", damaged: "late" };
const never = () => ({ lost: -Infinity, late: -Infinity });

/** The tone for the worst of these statuses; null: none is needed. @param {string[]} statuses @returns {"lost"|"late"|null} */
export function worstKind(statuses) {
  const kinds = statuses.map((status) => KINDS[status]);
  return kinds.includes("lost") ? "lost" : kinds.includes("late") ? "late" : null;
}

/** When the last tone of this kind or of a worse one was. */
const latest = (tones, kind) => Math.max(tones.lost, kind === "late" ? tones.late : -Infinity);

export class Alarm {
  #last = never();
  #ofCamera = {}; // the last tones that announced each camera

  /**
   * @param {string} camera
   * @param {string} status new
   * @param {number} now
   * @returns {"lost"|"late"|null} the tone that is due
   */
  due(camera, status, now) {
    const kind = KINDS[status];
    const own = (this.#ofCamera[camera] ??= never());
    if (!kind || now - latest(own, kind) < REPEAT_MS) return null;
    const tone = latest(this.#last, kind);
    const announced = now - tone < TOGETHER_MS;
    own[kind] = announced ? tone : now;
    if (announced) return null;
    this.#last[kind] = now;
    return kind;
  }
}
