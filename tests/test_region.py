"""The region that an encoded picture states of itself: written, read back, and where it stands in the stream."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from runner.core.budget import REGION_BYTES
from runner.core.model import Roi
from runner.h264.access_unit import nal_units, read_unit
from runner.h264.region import MARK, MOST_BYTES, region_of, region_unit, with_region

AUD, SPS, PPS, RECOVERY = b"\x09\xf0", b"\x67\x42\xc0\x1e\xd9", b"\x68\xce\x3c\x80", b"\x06\x06\x01\xc4\x80"
IDR, SLICE = b"\x65\x88\x84\x21", b"\x41\x9a\x24\x6c"
REGION = Roi(640, 0, 480, 270)


def annex_b(*units: bytes, start: bytes = b"\0\0\0\1") -> bytes:
    return b"".join(start + unit for unit in units)


def avc(*units: bytes) -> bytes:
    return b"".join(len(unit).to_bytes(4, "big") + unit for unit in units)


def kinds(data: bytes) -> list[int]:
    return [header & 0x1F for header, _ in nal_units(data)]


@given(st.integers(0, 65519), st.integers(0, 65519), st.integers(16, 65535), st.integers(16, 65535))
def test_a_region_is_read_back_as_it_was_stated_and_needs_no_escapes(x: int, y: int, width: int, height: int) -> None:
    unit = region_unit(Roi(x, y, width, height))
    assert region_of(unit[1:]) == Roi(x, y, width, height)
    assert len(unit) <= 1 + MOST_BYTES + 1
    assert not any(unit[at : at + 2] == b"\0\0" and unit[at + 2] <= 3 for at in range(len(unit) - 2))


@pytest.mark.parametrize(("region", "length"), [(Roi(0, 0, 16, 16), 11), (Roi(200, 100, 640, 360), 14), (REGION, 14)])
def test_it_is_small(region: Roi, length: int) -> None:
    assert len(region_unit(region)) == length


def test_what_is_counted_of_the_uplink_is_enough() -> None:
    assert 2 + len(region_unit(Roi(16383, 16383, 16383, 16383))) <= REGION_BYTES


@pytest.mark.parametrize("start", [b"\0\0\0\1", b"\0\0\1"])
@pytest.mark.parametrize(
    "units", [(AUD, SPS, PPS, IDR), (AUD, SLICE), (SLICE,), (AUD, RECOVERY, SLICE), (SLICE, SLICE)]
)
def test_it_stands_in_front_of_the_first_slice(units: tuple[bytes, ...], start: bytes) -> None:
    data = annex_b(*units, start=start)
    placed, bare = with_region(data, REGION), read_unit(data, None, 0)
    first = next(at for at, unit in enumerate(units) if unit in (IDR, SLICE))
    assert kinds(placed) == [*kinds(data)[:first], 6, *kinds(data)[first:]]
    unit = read_unit(placed, None, 0)
    assert bare and unit == bare._replace(data=placed, region=REGION)
    assert bare.region is None


def test_it_is_stated_where_units_have_lengths_too() -> None:
    found = with_region(avc(AUD, SPS, PPS, IDR), REGION, prefixed=True)
    assert found == avc(AUD, SPS, PPS, region_unit(REGION), IDR)


def test_a_picture_without_a_slice_stays_as_it_is() -> None:
    for data in (b"", annex_b(AUD, SPS), avc(SPS)):
        assert with_region(data, REGION) == data
    assert with_region(avc(SPS), REGION, prefixed=True) == avc(SPS)


@pytest.mark.parametrize(
    "message",
    [
        b"",
        RECOVERY[1:],
        b"\x05" + region_unit(REGION)[2:],  # another type
        b"\x04\x08\xb5\x00\x31GA94\x03",  # closed captions
        bytes([4, 5]) + MARK + b"\x00\x00",  # two numbers
        bytes([4, 8]) + MARK + b"\x00\x00\x10\x10\x10",  # five
        bytes([4, 7]) + MARK + b"\x00\x00\x00\x10",  # empty
        bytes([4, 7]) + MARK + b"\xff\xff\xff\xff",  # without end
    ],
)
def test_other_messages_state_none(message: bytes) -> None:
    assert region_of(message) is None


def test_damaged_pictures_keep_their_region() -> None:
    assert read_unit(with_region(annex_b(AUD, SLICE), REGION), None, 0, damaged=True) is None
