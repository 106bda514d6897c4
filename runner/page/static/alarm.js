/** Which tone a change of a picture's status triggers, and how often. Pure; times in ms. */

const TOGETHER_MS = 1000; // a link that fails takes eight pictures with it: one tone
const REPEAT_MS = 2000; // a picture that flickers does not sound each time
const PAUSED_MS = 1000; // a shorter pause, as until a vehicle hears of its operator, does not sound
/** The statuses that trigger a tone, the worst first, and its kind: "lost" where nothing moves. */
export const ALARMS = { lost: "lost", frozen: "lost", refused: "lost", unsupported: "lost", paused: "lost", damaged: "late", late: "late" };
const never = () => ({ lost: -Infinity, late: -Infinity });
/**
 * @typedef {object} Sounded what was sounded of a camera
 * @property {number} lost when its last tone of this kind was due
 * @property {number} late
 * @property {boolean} recovered whether there was no reason for a tone since
 * @property {boolean} moved whether it has moved since its last tone for standing still
 * @property {"lost"|"late"|null} waiting kind of its present status, if that came too soon to sound
 * @property {number} earliest when it may sound
 */

/** The tone for the worst of these statuses; null: none is needed. @param {string[]} statuses @returns {"lost"|"late"|null} */
export function worstKind(statuses) {
  const kinds = statuses.map((status) => ALARMS[status]);
  return kinds.includes("lost") ? "lost" : kinds.includes("late") ? "late" : null;
}

/** When the last tone of this kind or of a worse one was. */
const latest = (tones, kind) => Math.max(tones.lost, kind === "late" ? tones.late : -Infinity);

export class Alarm {
  #last = never();
  /** @type {Record<string, Sounded>} */
  #ofCamera = {};

  /**
   * @param {string} camera
   * @param {string} status new
   * @param {number} now
   * @returns {"lost"|"late"|null} the tone that is due
   */
  due(camera, status, now) {
    const kind = ALARMS[status];
    const own = (this.#ofCamera[camera] ??= { ...never(), recovered: false, moved: false, waiting: null, earliest: 0 });
    Object.assign(own, { waiting: null, earliest: status === "paused" ? now + PAUSED_MS : now });
    own.recovered ||= !kind;
    own.moved ||= kind !== "lost";
    if (!kind) return null;
    if (status === "paused") {
      own.waiting = kind;
      return null;
    }
    if (now - latest(own, kind) < REPEAT_MS) {
      if (own.recovered || (kind === "lost" && own.moved)) own.waiting = kind;
      return null;
    }
    return this.#sound(own, kind, now);
  }

  /**
   * The tone of a picture that failed or was paused too soon to sound, and has not recovered since; to be called a few
   * times a second.
   * @param {number} now
   */
  overdue(now) {
    const waiting = Object.values(this.#ofCamera).filter((own) => own.waiting && now >= own.earliest);
    const due = waiting.filter((own) => now - latest(own, own.waiting) >= REPEAT_MS);
    const tones = due.map((own) => this.#sound(own, own.waiting ?? "late", now));
    return tones.includes("lost") ? "lost" : tones.includes("late") ? "late" : null;
  }

  /** @param {Sounded} own  @param {"lost"|"late"} kind  @param {number} now */
  #sound(own, kind, now) {
    const tone = latest(this.#last, kind);
    const announced = now - tone < TOGETHER_MS;
    Object.assign(own, { [kind]: announced ? tone : now, recovered: false, moved: own.moved && kind !== "lost", waiting: null });
    if (announced) return null;
    this.#last[kind] = now;
    return kind;
  }
}
