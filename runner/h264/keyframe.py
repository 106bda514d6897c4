"""A grey IDR picture, for a decoder that joins a running stream and must start with an IDR. Pure.

With intra-refresh, a late viewer never receives an IDR: pictures become exact by refresh waves alone. The picture under
a wave does not matter, so any IDR of the right size will do. ITU-T H.264 (08/2021), clause 7.3.
"""

from __future__ import annotations

from runner.h264.sps import SPS, YUV420, Sps, read_sps

NAL_IDR, NAL_SPS, NAL_PPS = 0x65, 0x67, 0x68  # with nal_ref_idc 3
OWN_PPS = 31  # id of the parameter set generated here; encoders use the lowest ones
# CAVLC: ue(3) I_16x16 with DC prediction and nothing coded, ue(0) DC chroma prediction, se(0) QP, no DC coefficients.
_GREY_MACROBLOCK = "00100111"


def grey_idr(unit: bytes) -> bytes | None:
    """An access unit in Annex B with the parameter sets of a given one, and an all-grey picture.

    It repeats all parameter sets, since the following units may have none.

    unit     an access unit in Annex B
    returns  None if it has no sequence parameter set, or a damaged or unsupported one (4:4:4, 10 bits, fields)
    """
    nals = [nal.rstrip(b"\0") for nal in unit.split(b"\0\0\1")[1:]]
    sps = next((nal for nal in nals if nal and nal[0] & 0x1F == SPS), None)
    parsed = read_sps(sps[1:]) if sps else None
    # Browsers decode 4:2:0 with 8 bits.
    if sps is None or parsed is None or parsed.chroma != YUV420 or any(parsed.depths) or not parsed.frames_only:
        return None
    own = [nal for nal in nals if nal and nal[0] & 0x1F == 8]
    parts = (sps, *own, _nal(NAL_PPS, _pps(parsed)), _nal(NAL_IDR, _slice(parsed)))
    return b"".join(b"\0\0\0\1" + part for part in parts)


def _pps(sps: Sps) -> str:
    """Picture parameter set: CAVLC, one slice group, deblocking under control of the slice (7.3.2.2)."""
    return _ue(OWN_PPS) + _ue(sps.identity) + "00" + _ue(0) * 3 + "000" + _ue(0) * 3 + "100"


def _slice(sps: Sps) -> str:
    """Slice header of an IDR picture (7.3.3) and its macroblocks."""
    header = _ue(0) + _ue(7) + _ue(OWN_PPS) + "0" * sps.frame_num_bits + _ue(1) + "0" * sps.order_bits
    if sps.order_type == 1 and not sps.delta_always_zero:
        header += _ue(0)
    return header + "00" + _ue(0) + _ue(1) + _GREY_MACROBLOCK * (sps.columns * sps.rows)


def _ue(value: int) -> str:
    """Exp-Golomb code (9.1). A signed zero is written as the same bit."""
    digits = f"{value + 1:b}"
    return "0" * (len(digits) - 1) + digits


def _nal(header: int, bits: str) -> bytes:
    """Trailing bits, bytes, and emulation prevention (7.4.1)."""
    bits += "1"
    bits += "0" * (-len(bits) % 8)
    payload = int(bits, 2).to_bytes(len(bits) // 8, "big")
    out = bytearray([header])
    for byte in payload:
        if byte <= 3 and out[-2:] == b"\0\0":
            out.append(3)
        out.append(byte)
    return bytes(out)
