/** Periodic checks that something still arrives. */

/**
 * Check every so many ms, except just after the page itself has stalled: what arrived meanwhile is still queued.
 * @param {number} every_ms  @param {(now: number) => void} check
 */
export function checkRegularly(every_ms, check) {
  let checkedAt = performance.now();
  setInterval(() => {
    const now = performance.now();
    const hasStalled = now - checkedAt > 2 * every_ms;
    checkedAt = now;
    if (!hasStalled) check(now);
  }, every_ms);
}
