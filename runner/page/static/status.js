/** The status of a tile's stream, judged from times alone so that it can be tested without video. */

import { AT_MOST_MS } from "./beginning.js";

export const MOVING = ["live", "late", "damaged"];
export const STALLED = ["frozen", "lost"]; // no new pictures although they are due

const LOST_MS = 1000;
const WAVE_S = 1.5; // a refresh wave, if its length is unknown
const DECODER_MS = 2000; // a decoder's time until its first picture
const LONGEST_MS = 15_000; // however long the wave is
export const INTERVALS = 1.3; // this many frame intervals without a picture are more than jitter

/**
 * @typedef {object} Times the known state of a stream
 * @property {boolean} connected
 * @property {boolean} [ended] whether the station has ended in order
 * @property {boolean} online
 * @property {boolean|null} on
 * @property {boolean|null} sending
 * @property {boolean} [unopened] whether the vehicle cannot open the source
 * @property {boolean} [declined] whether the vehicle refuses the station its pictures
 * @property {string} refused why there is no decoder, "" if there is one
 * @property {boolean} drawn whether a picture was drawn since the stream last started
 * @property {number} [waits_since] page time since which units arrive and none was drawn
 * @property {number|null} wave_s length of a refresh wave, or time between key frames; null: unknown
 * @property {number|null} stood_since page time of the last picture before the decoder restarted in the middle of the
 *   stream; null: it did not
 * @property {boolean} faulty whether the source has a fault: it may repeat old pictures
 * @property {boolean} begins whether it has not had its first second yet, see `Beginning`
 * @property {boolean} damaged whether the picture shows that packets were lost
 * @property {number} arrived page time of the newest unit, or of the start of the stream
 * @property {number} decoded likewise
 * @property {number} late_until page time
 * @property {number} fps
 *
 * @param {Times} s
 * @param {{frozen_ms: number}} limits
 * @param {number} now page time
 * @returns {"ended"|"off"|"paused"|"lost"|"refused"|"unsupported"|"frozen"|"damaged"|"late"|"synchronising"|"live"}
 */
export function judge(s, limits, now) {
  if (s.ended) return "ended";
  const reachable = s.connected && s.online;
  if (reachable && s.on === false) return "off";
  if (reachable && s.sending === false) return s.unopened ? "lost" : "paused";
  if (reachable && s.declined) return "refused";
  if (!reachable || now - s.arrived > (s.begins ? AT_MOST_MS : LOST_MS)) return "lost";
  if (s.refused) return "unsupported";
  if (!s.drawn && s.stood_since === null) return now - (s.waits_since ?? now) > synchronisedAfter(s.wave_s) ? "frozen" : "synchronising";
  const limit = frozenAfter(limits, s.fps);
  if (s.faulty || now - Math.min(s.arrived, s.drawn ? s.decoded : (s.stood_since ?? 0)) > limit) return "frozen";
  if (s.damaged) return "damaged";
  return now < s.late_until ? "late" : "live";
}

/** How long a stream may take to its first picture, ms: two refresh waves, since units of the first may be lost. */
const synchronisedAfter = (wave_s) => Math.min(2000 * (wave_s ?? WAVE_S) + DECODER_MS, LONGEST_MS);

/** How long a picture may stand until it is frozen, ms. @param {{frozen_ms: number}} limits  @param {number} fps */
export const frozenAfter = (limits, fps) => Math.max(limits.frozen_ms, (INTERVALS * 1000) / fps);

/** The text of a note: "12 of 40 Hz". @param {number} slow_fps  @param {number} fps */
export const slowText = (slow_fps, fps) => `${slow_fps} of ${Math.round(100 * fps) / 100} Hz`;

/** The text while a camera that encodes by itself has sent no picture to begin with. @param {number} since_ms */
export const keyText = (since_ms) => `WAITING FOR KEY PICTURE ${Math.floor(since_ms / 1000)} s`;

/**
 * The text of an alarm: "FROZEN 0.4 s", "LATE 310 ms", "LOST 3 s".
 * @param {string} status
 * @param {number} since_ms since the newest unit, or since the source failed
 * @param {number} age_ms of the last late picture
 */
export function alarmText(status, since_ms, age_ms) {
  if (status === "frozen") return `FROZEN ${(Math.floor(since_ms / 100) / 10).toFixed(1)} s`;
  if (status === "late") return `LATE ${Math.round(age_ms / 10) * 10} ms`;
  if (status === "lost") return since_ms < 1e8 ? `LOST ${Math.floor(since_ms / 1000)} s` : "LOST";
  if (status === "unsupported") return "NO PICTURE";
  return status.toUpperCase();
}
