/** Arithmetic of a slider for bitrates. */

export const STEPS = 1000;
const SPAN = 200; // ratio of the right end to the left end; lower rates can only be typed

// Equal steps are equal ratios: small changes matter at low rates, and no single key press drops a high rate to none.

/** The bitrate at a step of a slider that ends at `max`, kbit/s. */
export const toKbps = (step, max) => Math.max(1, Math.round(max * SPAN ** (step / STEPS - 1)));

/** The nearest step to a bitrate, on a slider that ends at `max`, kbit/s. */
export const toStep = (kbps, max) => Math.round(STEPS * Math.min(1, Math.max(0, 1 + Math.log(kbps / max) / Math.log(SPAN))));

/**
 * Call immediately, then at most every `wait` ms; the last value is always passed on.
 * @template T
 * @param {(value: T) => void} call
 * @param {number} wait
 * @returns {(value: T) => void}
 */
export function throttle(call, wait) {
  /** @type {any} */
  let timer = null;
  /** @type {T|null} */
  let next = null;
  const onTimer = () => {
    timer = null;
    if (next === null) return;
    const value = next;
    next = null;
    timer = setTimeout(onTimer, wait);
    call(value);
  };
  return (value) => {
    next = value;
    if (timer === null) onTimer();
  };
}
