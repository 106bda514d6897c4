"""Sequence parameter sets of H.264 (ITU-T H.264 (08/2021), 7.3.2.1.1), and the bits that they are made of. Pure."""

from __future__ import annotations

from typing import NamedTuple

SPS = 7  # NAL unit type
# Profiles whose parameter set contains chroma format and bit depths.
HIGH_PROFILES = frozenset({100, 110, 122, 244, 44, 83, 86, 118, 128, 138, 139, 134, 135})
GREY, YUV420, YUV444 = 0, 1, 3  # chroma formats (table 6-1)
MOST_MACROBLOCKS = 139_264  # of a frame, at any level (table A-1)


class Sps(NamedTuple):
    """The fields that determine slice headers and the size of the picture.

    depths   bits of a sample beyond 8: luma, chroma
    columns  of macroblocks
    rows     of macroblocks; of a field, where the stream may have fields
    cropped  at the left, right, top and bottom, in units of the chroma format
    """

    identity: int
    chroma: int
    depths: tuple[int, int]
    frame_num_bits: int
    order_type: int
    order_bits: int
    delta_always_zero: bool
    columns: int
    rows: int
    frames_only: bool
    cropped: tuple[int, int, int, int]


class Bits:
    """Reads bits, most significant first; zeros past the end.

    data  of a NAL unit, with emulation prevention (7.4.1)
    """

    def __init__(self, data: bytes) -> None:
        self._bits = "".join(f"{byte:08b}" for byte in data.replace(b"\0\0\3", b"\0\0"))
        self._at = 0

    def u(self, count: int) -> int:
        """The next `count` bits as a number."""
        self._at += count
        return int(self._bits[self._at - count : self._at] or "0", 2)

    def ue(self, most: int = 2**32 - 2) -> int:
        """An Exp-Golomb code (9.1).

        most    the largest value that the standard permits here
        raises  ValueError above it, or past the end
        """
        one = self._bits.find("1", self._at)
        zeros = max(0, one - self._at)
        self._at += zeros
        value = self.u(zeros + 1) - 1
        if not 0 <= value <= most:
            raise ValueError("a damaged parameter set")
        return value

    def cropped(self) -> tuple[int, int, int, int]:
        """A flag, and what is cropped if it is set; the same in H.264 and H.265."""
        return (self.ue(), self.ue(), self.ue(), self.ue()) if self.u(1) else (0, 0, 0, 0)


def read_sps(data: bytes) -> Sps | None:
    """A sequence parameter set; None: it is damaged. data: the NAL unit after its header"""
    try:
        return _read(Bits(data))
    except ValueError:
        return None


def _read(read: Bits) -> Sps:
    profile = read.u(24) >> 16
    identity = read.ue(31)
    chroma, depths = _samples(read) if profile in HIGH_PROFILES else (YUV420, (0, 0))
    frame_num_bits = read.ue(12) + 4
    order_type, order_bits, always_zero = read.ue(2), 0, True
    if order_type == 0:
        order_bits = read.ue(12) + 4
    elif order_type == 1:
        always_zero = bool(read.u(1))
        read.ue(), read.ue()
        for _ in range(read.ue(255)):
            read.ue()
    read.ue(), read.u(1)
    columns = read.ue(MOST_MACROBLOCKS - 1) + 1
    rows, frames_only = read.ue(MOST_MACROBLOCKS // columns - 1) + 1, bool(read.u(1))
    read.u(1 if frames_only else 2)
    size = columns, rows, frames_only, read.cropped()
    return Sps(identity, chroma, depths, frame_num_bits, order_type, order_bits, always_zero, *size)


def _samples(read: Bits) -> tuple[int, tuple[int, int]]:
    """Chroma format and depths of samples; skips scaling lists."""
    chroma = read.ue(YUV444)
    if chroma == YUV444:
        read.u(1)
    depths = read.ue(6), read.ue(6)
    read.u(1)
    if read.u(1):
        _skip_scaling_lists(read, 12 if chroma == YUV444 else 8)
    return chroma, depths


def _skip_scaling_lists(read: Bits, count: int) -> None:
    for index in range(count):
        if not read.u(1):
            continue
        last = following = 8
        for _ in range(16 if index < 6 else 64):
            if following:
                code = read.ue()
                following = (last + (code + 1) // 2 * (1 if code % 2 else -1)) % 256
            last = following or last
