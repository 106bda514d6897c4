/** The part of H.264 and H.265 (Annex B) that a page needs: the codec string for WebCodecs. */

const HEADERS = { h264: 1, h265: 2 }; // bytes of a NAL unit's header
const TYPES = { h264: (byte) => byte & 0x1f, h265: (byte) => (byte >> 1) & 0x3f };
const SPS = { h264: 7, h265: 33 };
const NAMES = { h264: "H.264", h265: "H.265" };

export const nameOf = (codec) => NAMES[codec] ?? "video that is neither H.264 nor H.265";
export const isKnown = (codec) => codec in NAMES;

/**
 * The sequence parameter set of a key unit, without its header. If it changes, a new decoder is needed.
 * @param {Uint8Array} unit one access unit, Annex B
 * @param {"h264"|"h265"} codec
 * @returns {Uint8Array|null} null if the unit contains none
 */
export function spsOf(unit, codec) {
  const starts = [];
  for (let i = 0; i + 3 < unit.length && starts.length < 8; i++) {
    if (unit[i] === 0 && unit[i + 1] === 0 && unit[i + 2] === 1) starts.push(i + 3);
  }
  const at = starts.findIndex((start) => TYPES[codec](unit[start]) === SPS[codec]);
  return at < 0 ? null : unit.slice(starts[at] + HEADERS[codec], at + 1 < starts.length ? starts[at + 1] - 3 : unit.length);
}

const hex = (byte) => byte.toString(16).padStart(2, "0");

/** Codec strings that a browser plays if it plays the codec at all. */
export const USUAL = { h264: "avc1.42E01F", h265: "hev1.1.6.L93.B0" };

export const codecOf = (sps, codec) => (codec === "h265" ? hev1(sps) : avc1(sps));

/** "avc1.PPCCLL": profile, constraints and level are the first three bytes of the parameter set. */
const avc1 = (sps) => `avc1.${[...sps.subarray(0, 3)].map(hex).join("")}`;

/**
 * "hev1.PROFILE.COMPATIBILITY.LEVEL.CONSTRAINTS" (ISO/IEC 14496-15, annex E) from profile_tier_level, which follows the
 * first byte of the parameter set (ITU-T H.265, 7.3.2.2.1 and 7.3.3). Not "hvc1", since parameter sets are in-band.
 */
function hev1(sps) {
  const bytes = withoutEmulation(sps.subarray(0, 24));
  const space = ["", "A", "B", "C"][bytes[1] >> 6];
  const tier = bytes[1] & 0x20 ? "H" : "L";
  const flags = bytes.slice(2, 6).reduce((bits, byte) => bits * 256 + byte, 0);
  let reversed = 0;
  for (let i = 0; i < 32; i++) if ((flags / 2 ** i) & 1) reversed += 2 ** (31 - i);
  const constraints = [...bytes.slice(6, 12)];
  while (constraints.length && constraints.at(-1) === 0) constraints.pop();
  const parts = [space + (bytes[1] & 0x1f), reversed.toString(16), tier + bytes[12], ...constraints.map((byte) => byte.toString(16))];
  return `hev1.${parts.join(".")}`.toUpperCase().replace("HEV1", "hev1");
}

/** Without the emulation prevention bytes (7.4.1.1). */
const withoutEmulation = (data) => data.filter((byte, i) => !(byte === 3 && i > 1 && data[i - 1] === 0 && data[i - 2] === 0));
