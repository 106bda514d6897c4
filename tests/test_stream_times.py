"""Times that a demuxer has shortened by the length of gaps, as their file states them."""

from __future__ import annotations

from pathlib import Path

import pytest

from runner.gst.stream_times import HZ, PACKET, WRAP, RestoredTimes, joined_units, stream_times
from runner.system.clocks import SECOND_NS

pytestmark = pytest.mark.gst

MS = 1_000_000


def unit(time: int, stream: int = 0xE0, *, adapted: bool = False, counter: int = 0) -> bytes:
    """A packet in which a unit of a stream begins, with its presentation time."""
    stamp = bytes(
        [0x21 | time >> 29 & 0x0E, time >> 22 & 0xFF, time >> 14 & 0xFE | 1, time >> 7 & 0xFF, time << 1 & 0xFE | 1]
    )
    header = b"\0\0\1" + bytes([stream, 0, 0, 0x80, 0x80, 5]) + stamp
    front = b"\x47\x40\x41" + (bytes([0x30 | counter, 1, 0x40]) if adapted else bytes([0x10 | counter]))
    return (front + header).ljust(PACKET, b"\xff")


def test_times_of_video_units(tmp_path: Path) -> None:
    begin = WRAP - HZ
    others = b"\x47\x00\x41\x10".ljust(PACKET, b"\0"), unit(5, stream=0xC0), b"\x47\x40\x00\x10".ljust(PACKET, b"\0")
    times = [0, HZ // 10, HZ * 2, HZ * 7 + 1]  # it wraps around in between
    packets = [unit((begin + time) % WRAP, adapted=time > 0) for time in times]
    path = tmp_path / "video.ts"
    path.write_bytes(others[0] + packets[0] + b"".join(others[1:]) + b"".join(packets[1:]) + packets[0][:100])
    assert stream_times(path) == [0, SECOND_NS // 10, 2 * SECOND_NS, 7 * SECOND_NS + 11_111]


@pytest.mark.parametrize("content", [b"", b"short", b"\x47" * 1000])
def test_files_other_than_transport_streams_have_no_times(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "video.ts"
    path.write_bytes(content)
    assert stream_times(path) == []


def test_a_seam_of_joined_files_shows_in_the_counters(tmp_path: Path) -> None:
    first, rest = ([unit(HZ * n, counter=n % 16) for n in range(count)] for count in (20, 5))
    path = tmp_path / "video.ts"
    for units, expected in ((first, 0), ([*first[:4], first[3], *first[4:]], 0), ([*first, *rest], 25), ([], 0)):
        path.write_bytes(b"".join(units))
        assert joined_units(path) == expected


def restored(stated: list[int], demuxed: list[int]) -> list[int]:
    times = RestoredTimes([ms * MS for ms in stated])
    return [times.next(ms * MS) // MS for ms in demuxed]


def test_the_length_of_a_gap_is_restored() -> None:
    assert restored([0, 100, 200, 5200, 5300], [0, 100, 200, 700, 800]) == [0, 100, 200, 5200, 5300]


def test_units_that_the_demuxer_dropped_are_skipped() -> None:
    assert restored([0, 100, 200, 300, 5300, 5400], [0, 100, 300, 800, 900]) == [0, 100, 300, 5300, 5400]


def test_units_beyond_the_stated_ones_keep_the_last_offset() -> None:
    assert restored([0, 100], [0, 100, 200]) == [0, 100, 100]
    assert restored([], [0, 100]) == [0, 100]
