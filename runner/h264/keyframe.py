"""A grey IDR picture, for a decoder that joins a running stream and must start with an IDR. Pure.

With intra-refresh, a late viewer never receives an IDR: pictures become exact by refresh waves alone. The picture under
a wave does not matter, so any IDR of the right size will do. ITU-T H.264 (08/2021), clause 7.3.
"""

from __future__ import annotations

from typing import NamedTuple

NAL_IDR, NAL_SPS, NAL_PPS = 0x65, 0x67, 0x68  # with nal_ref_idc 3
OWN_PPS = 31  # id of the parameter set generated here; encoders use the lowest ones
# Profiles whose parameter set contains chroma format and bit depths (7.3.2.1.1).
HIGH_PROFILES = frozenset({100, 110, 122, 244, 44, 83, 86, 118, 128, 138, 139, 134, 135})
# CAVLC: ue(3) I_16x16 with DC prediction and nothing coded, ue(0) DC chroma prediction, se(0) QP, no DC coefficients.
_GREY_MACROBLOCK = "00100111"


class _Sps(NamedTuple):
    """The fields that determine the slice header and the picture size."""

    identity: int
    frame_num_bits: int
    order_type: int
    order_bits: int
    delta_always_zero: bool
    macroblocks: int


def grey_idr(unit: bytes) -> bytes | None:
    """An access unit in Annex B with the parameter sets of a given one, and an all-grey picture.

    It repeats all parameter sets, since the following units may have none.

    unit     an access unit in Annex B
    returns  None if it has no sequence parameter set, or an unsupported one (scaling lists, 4:4:4, fields)
    """
    nals = [nal.rstrip(b"\0") for nal in unit.split(b"\0\0\1")[1:]]
    sps = next((nal for nal in nals if nal and nal[0] & 0x1F == 7), None)
    parsed = _parse(sps[1:].replace(b"\0\0\3", b"\0\0")) if sps else None
    if sps is None or parsed is None:
        return None
    own = [nal for nal in nals if nal and nal[0] & 0x1F == 8]
    parts = (sps, *own, _nal(NAL_PPS, _pps(parsed)), _nal(NAL_IDR, _slice(parsed)))
    return b"".join(b"\0\0\0\1" + part for part in parts)


def _parse(payload: bytes) -> _Sps | None:
    """Sequence parameter set up to the size of the picture (7.3.2.1.1)."""
    read = Bits(payload)
    profile = read.u(24) >> 16
    identity = read.ue()
    if profile in HIGH_PROFILES:
        chroma_format = read.ue()
        if chroma_format != 1 or read.ue() or read.ue():  # browsers decode 4:2:0 with 8 bits
            return None
        read.u(1)
        if read.u(1):
            return None
    frame_num_bits = read.ue() + 4
    order_type, order_bits, always_zero = read.ue(), 0, True
    if order_type == 0:
        order_bits = read.ue() + 4
    elif order_type == 1:
        always_zero = bool(read.u(1))
        read.ue(), read.ue()
        for _ in range(read.ue()):
            read.ue()
    read.ue(), read.u(1)
    width, height = read.ue() + 1, read.ue() + 1
    if not read.u(1):
        return None
    return _Sps(identity, frame_num_bits, order_type, order_bits, always_zero, width * height)


def _pps(sps: _Sps) -> str:
    """Picture parameter set: CAVLC, one slice group, deblocking under control of the slice (7.3.2.2)."""
    return _ue(OWN_PPS) + _ue(sps.identity) + "00" + _ue(0) * 3 + "000" + _ue(0) * 3 + "100"


def _slice(sps: _Sps) -> str:
    """Slice header of an IDR picture (7.3.3) and its macroblocks."""
    header = _ue(0) + _ue(7) + _ue(OWN_PPS) + "0" * sps.frame_num_bits + _ue(1) + "0" * sps.order_bits
    if sps.order_type == 1 and not sps.delta_always_zero:
        header += _ue(0)
    return header + "00" + _ue(0) + _ue(1) + _GREY_MACROBLOCK * sps.macroblocks


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


class Bits:
    """Reads bits, most significant first; zeros past the end."""

    def __init__(self, data: bytes) -> None:
        self._bits = "".join(f"{byte:08b}" for byte in data)
        self._at = 0

    def u(self, count: int) -> int:
        """The next `count` bits as a number."""
        self._at += count
        return int(self._bits[self._at - count : self._at] or "0", 2)

    def ue(self) -> int:
        """An Exp-Golomb code (9.1)."""
        one = self._bits.find("1", self._at)
        zeros = max(0, one - self._at)
        self._at += zeros
        return self.u(zeros + 1) - 1
