"""Sequence parameter sets of H.264 and H.265: sizes, and damaged ones, which end no reader."""

from __future__ import annotations

import random

import pytest

from runner.h264.keyframe import grey_idr
from runner.h264.size import picture_size

BASELINE, HIGH = 66, 100


def ue(value: int) -> str:
    digits = f"{value + 1:b}"
    return "0" * (len(digits) - 1) + digits


WHOLE = {"profile": BASELINE, "samples": "", "order": ue(2), "size": ue(19) + ue(14), "frames": "1", "cropped": "0"}
LISTS = "1" + ue(16) + "0" * 7  # of scaling: the first one is that of the standard


def unit(**parts) -> bytes:
    """A sequence parameter set of 320x240, or with other parts, each as bits."""
    given = WHOLE | parts
    bits = f"{given['profile']:08b}{0:08b}{30:08b}" + ue(0) + given["samples"] + ue(0) + given["order"] + ue(1) + "0"
    bits += given["size"] + given["frames"] + ("1" if given["frames"] == "1" else "01") + given["cropped"] + "01"
    bits += "0" * (-len(bits) % 8)
    return b"\0\0\0\1\x67" + int(bits, 2).to_bytes(len(bits) // 8).replace(b"\0\0\0", b"\0\0\3\0")


def order(count: int, follow: int) -> str:
    """A picture order of type 1 that states `count` offsets, of which so many follow."""
    return ue(1) + "1" + ue(0) * 2 + ue(count) + ue(0) * follow


@pytest.mark.parametrize(
    ("parts", "size", "starts"),
    [
        ({}, (320, 240), True),
        ({"order": order(2, 2)}, (320, 240), True),
        ({"order": order(255, 255)}, (320, 240), True),
        ({"order": order(256, 256)}, None, False),  # more than the standard permits (7.4.2.1.1)
        ({"order": order(2**32 - 2, 0)}, None, False),
        ({"cropped": "1" + ue(0) + ue(2) + ue(1) + ue(3)}, (316, 232), True),
        ({"cropped": "1" + ue(0) + ue(160) + ue(0) * 2}, None, True),
        ({"size": ue(2**31) + ue(14)}, None, False),
        ({"frames": "0"}, (320, 480), False),
        ({"profile": HIGH, "samples": ue(1) + ue(0) * 2 + "01" + LISTS}, (320, 240), True),
        ({"profile": HIGH, "samples": ue(1) + ue(2) * 2 + "00"}, (320, 240), False),
        ({"profile": HIGH, "samples": ue(3) + "0" + ue(0) * 2 + "00"}, (320, 240), False),
    ],
)
def test_a_parameter_set_states_the_size(parts, size, starts):
    data = unit(**parts)
    assert picture_size(data, "h264") == size
    assert (grey_idr(data) is not None) == starts


def test_damaged_parameter_sets_are_read_to_an_end():
    """What is read from them is a size that a picture may have, or nothing."""
    rng = random.Random(7)
    for _ in range(3000):
        data = bytes(rng.choice((0, 0, rng.randrange(256))) for _ in range(rng.randrange(40)))
        for header, codec in ((b"\x67", "h264"), (b"\x42\x01", "h265")):
            size = picture_size(b"\0\0\1" + header + data, codec)
            assert size is None or 0 < min(size) <= max(size) < 2**22
