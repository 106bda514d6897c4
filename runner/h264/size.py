"""Size of the pictures of a stream by its sequence parameter set: ITU-T H.264, 7.3.2.1; H.265, 7.3.2.2. Pure."""

from __future__ import annotations

from runner.h264.access_unit import nal_units
from runner.h264.keyframe import HIGH_PROFILES, Bits

H264_SPS, H265_SPS = 7, 33  # NAL unit types
SPS_BYTES = 256  # enough for everything before the size and its cropping


def picture_size(unit: bytes, codec: str) -> tuple[int, int] | None:
    """Width and height in px that an access unit in Annex B states; None: it states none."""
    for header, at in nal_units(unit):
        if codec == "h264" and header & 0x1F == H264_SPS:
            return _h264_size(_bits(unit, at))
        if codec == "h265" and header >> 1 & 0x3F == H265_SPS:
            return _h265_size(_bits(unit, at + 1))  # its header has two bytes
    return None


def _bits(unit: bytes, at: int) -> Bits:
    return Bits(unit[at : at + SPS_BYTES].replace(b"\0\0\3", b"\0\0"))


def _h264_size(read: Bits) -> tuple[int, int]:
    profile = read.u(24) >> 16
    read.ue()
    chroma = 1
    if profile in HIGH_PROFILES:
        chroma = read.ue()
        if chroma == 3:
            read.u(1)
        read.ue(), read.ue(), read.u(1)
        if read.u(1):
            _skip_scaling_lists(read, 12 if chroma == 3 else 8)
    read.ue()
    order_type = read.ue()
    if order_type == 0:
        read.ue()
    elif order_type == 1:
        read.u(1), read.ue(), read.ue()
        for _ in range(read.ue()):
            read.ue()
    read.ue(), read.u(1)
    width, map_height, frames = (read.ue() + 1) * 16, (read.ue() + 1) * 16, read.u(1)
    if not frames:
        read.u(1)
    read.u(1)
    across, down = (1 if chroma in (0, 3) else 2), (2 if chroma == 1 else 1) * (2 - frames)
    return _cropped(read, width, map_height * (2 - frames), across, down)


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


def _h265_size(read: Bits) -> tuple[int, int]:
    read.u(4)
    layers = read.u(3)
    read.u(1 + 88 + 8)  # general profile and level
    present = [(read.u(1), read.u(1)) for _ in range(layers)]
    read.u(2 * (8 - layers) if layers else 0)
    for profile, level in present:
        read.u(88 * profile + 8 * level)
    read.ue()
    chroma = read.ue()
    if chroma == 3:
        read.u(1)
    width, height = read.ue(), read.ue()
    return _cropped(read, width, height, 2 if chroma in (1, 2) else 1, 2 if chroma == 1 else 1)


def _cropped(read: Bits, width: int, height: int, across: int, down: int) -> tuple[int, int]:
    """The size without what is cropped, in units of so many px; the fields are the same in both."""
    if not read.u(1):
        return width, height
    left, right, top, bottom = (read.ue() for _ in range(4))
    return width - across * (left + right), height - down * (top + bottom)
