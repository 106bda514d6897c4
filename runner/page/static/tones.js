/** Plays tones. Browsers allow sound only after a click or key press; whether they are muted is the same in all windows. */

const KEY = "tod-muted";
/** Hz, one after the other */
const TONES = { lost: [880, 587, 880, 587], late: [659], asked: [784, 784], passed: [523, 784, 1047], stop: [988, 988, 988] };
const TONE_S = 0.15;
const VOLUME = 0.3;

/** @typedef {keyof typeof TONES} Kind */

/** @type {AudioContext|null} */
let context = null;

export const isMuted = () => localStorage.getItem(KEY) === "yes";
export const setMuted = (muted) => localStorage.setItem(KEY, muted ? "yes" : "no");
/** Whether a change of the storage is that tones were muted or not. @param {StorageEvent} event */
export const isOfMuting = ({ key }) => key === KEY;
export const isBlocked = () => context?.state !== "running";

/**
 * Create or resume the audio context if needed; it stays blocked until a click or key press.
 * @param {() => void} onChange called when sound is blocked or allowed
 */
export function unlock(onChange) {
  if (!context) {
    context = new AudioContext();
    context.onstatechange = onChange;
  }
  if (isBlocked()) context.resume().catch(onChange);
}

/** @param {Kind} kind */
export function play(kind) {
  if (!context || isMuted() || isBlocked()) return;
  for (const [i, frequency] of TONES[kind].entries()) {
    const from = context.currentTime + i * TONE_S;
    const oscillator = new OscillatorNode(context, { type: "square", frequency });
    oscillator.connect(new GainNode(context, { gain: VOLUME })).connect(context.destination);
    oscillator.start(from);
    oscillator.stop(from + 0.8 * TONE_S);
  }
}
