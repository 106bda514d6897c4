/** The little of H.264 (Annex B) that a page has to know: the codec string that WebCodecs asks for. */

const SPS = 7;

/**
 * The sequence parameter set of a key unit, without its header; another one is another stream, for a decoder set up anew.
 * @param {Uint8Array} unit one access unit, Annex B
 * @returns {Uint8Array|null} null where the unit holds none
 */
export function spsOf(unit) {
  const starts = [];
  for (let i = 0; i + 3 < unit.length && starts.length < 8; i++) {
    if (unit[i] === 0 && unit[i + 1] === 0 && unit[i + 2] === 1) starts.push(i + 3);
  }
  const at = starts.findIndex((start) => (unit[start] & 0x1f) === SPS);
  return at < 0 ? null : unit.slice(starts[at] + 1, at + 1 < starts.length ? starts[at + 1] - 3 : unit.length);
}

/** Codec string, "avc1.PPCCLL": profile, constraints and level are the first three bytes of the parameter set. */
export const codecOf = (sps) => `avc1.${[...sps.subarray(0, 3)].map((byte) => byte.toString(16).padStart(2, "0")).join("")}`;
