"""Size of the pictures of a stream by its sequence parameter set: ITU-T H.264, 7.3.2.1; H.265, 7.3.2.2. Pure."""

from __future__ import annotations

from runner.h264.access_unit import nal_units
from runner.h264.sps import GREY, SPS, YUV420, YUV444, Bits, read_sps

H265_SPS = 33  # NAL unit type
MOST_H265 = 16_888  # px, width or height at any level but 8.5 (A.4.1)


def picture_size(unit: bytes, codec: str) -> tuple[int, int] | None:
    """Width and height in px that an access unit in Annex B states; None: it states none, or is damaged there."""
    for header, at in nal_units(unit):
        if codec == "h264" and header & 0x1F == SPS:
            return _h264_size(_content(unit, at))
        if codec == "h265" and header >> 1 & 0x3F == H265_SPS:
            return _h265_size(_content(unit, at + 1))  # its header has two bytes
    return None


def _content(unit: bytes, at: int) -> bytes:
    """A NAL unit from an offset to its end."""
    end = unit.find(b"\0\0\1", at)
    return unit[at:end] if end >= 0 else unit[at:]


def _h264_size(content: bytes) -> tuple[int, int] | None:
    sps = read_sps(content)
    if sps is None:
        return None
    fields = 1 if sps.frames_only else 2
    across, down = (1 if sps.chroma in (GREY, YUV444) else 2), (2 if sps.chroma == YUV420 else 1) * fields
    return _cropped(sps.columns * 16, sps.rows * 16 * fields, sps.cropped, across, down)


def _h265_size(content: bytes) -> tuple[int, int] | None:
    read = Bits(content)
    read.u(4)
    layers = read.u(3)
    read.u(1 + 88 + 8)  # general profile and level
    present = [(read.u(1), read.u(1)) for _ in range(layers)]
    read.u(2 * (8 - layers) if layers else 0)
    for profile, level in present:
        read.u(88 * profile + 8 * level)
    try:
        read.ue(15)
        chroma = read.ue(YUV444)
        if chroma == YUV444:
            read.u(1)
        width, height = read.ue(MOST_H265), read.ue(MOST_H265)
        cropped = read.cropped()
    except ValueError:
        return None
    return _cropped(width, height, cropped, 1 if chroma in (GREY, YUV444) else 2, 2 if chroma == YUV420 else 1)


def _cropped(
    width: int, height: int, cropped: tuple[int, int, int, int], across: int, down: int
) -> tuple[int, int] | None:
    """The size without what is cropped, in units of so many px."""
    left, right, top, bottom = cropped
    width, height = width - across * (left + right), height - down * (top + bottom)
    return (width, height) if width > 0 and height > 0 else None
