"""Presentation times stored in an MPEG-TS file. GStreamer's demuxer mistakes gaps for a new clock and shortens them."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from runner.system.clocks import SECOND_NS

PACKET, SYNC = 188, 0x47  # bytes of a packet, and its first (ISO/IEC 13818-1, section 2.4.3)
STARTS, ADAPTED, FILLED = 0x40, 0x20, 0x10  # a payload unit starts in it; an adaptation field comes first; a payload
PID, COUNTER = (
    np.array([0x1F, 0xFF], np.uint8),
    0x0F,
)  # which stream it belongs to, of the second and third byte; a count
VIDEO, TIMED = 0xE0, 0x80  # stream number of video, in the upper four bits; a presentation time is given
HZ, WRAP = 90_000, 1 << 33
SAME_NS = 1_000_000


def stream_times(path: Path) -> list[int]:
    """Presentation times of all video units of a file, in order, ns since the first; empty if it is not MPEG-TS.

    raises  OSError
    """
    packets = _packets(path)
    found: list[int] = []
    for packet in packets[_starts(packets)]:
        time = _time(packet.tobytes())
        if time is not None:
            found.append(time if not found else found[-1] + (time - found[-1] + WRAP // 2) % WRAP - WRAP // 2)
    return [(time - found[0]) * SECOND_NS // HZ for time in found]


def joined_units(path: Path) -> int:
    """How many video units an MPEG-TS file has that was joined from several files; 0: any other file.

    At a seam the counter of the packets jumps, which GStreamer 1.28 takes for a loss: it leaves out the unit behind it.
    A seam where the counter happens to go on is a seam for nobody.

    raises  OSError
    """
    packets = _packets(path)
    starts = _starts(packets)
    video = next((packet for packet in packets[starts] if _time(packet.tobytes()) is not None), None)
    if video is None:
        return 0
    same = ((packets[:, 1:3] ^ video[1:3]) & PID == 0).all(axis=1) & (packets[:, 3] & FILLED != 0)
    counters, begins = packets[same, 3] & COUNTER, starts[same]
    jumps = (np.diff(counters) & COUNTER > 1) & begins[1:]
    return int(begins.sum()) if jumps.any() else 0


def _packets(path: Path) -> NDArray[np.uint8]:
    data = np.memmap(path, np.uint8, "r") if path.stat().st_size else np.empty(0, np.uint8)
    return data[: len(data) // PACKET * PACKET].reshape(-1, PACKET)


def _starts(packets: NDArray[np.uint8]) -> NDArray[np.bool_]:
    found: NDArray[np.bool_] = (packets[:, 0] == SYNC) & (packets[:, 1] & STARTS != 0)
    return found


def _time(packet: bytes) -> int | None:
    """The presentation time in the header of a video unit; None if another kind of unit starts (section 2.4.3.6)."""
    begin = 4 + (1 + packet[4] if packet[3] & ADAPTED else 0)
    header = packet[begin : begin + 14]
    if len(header) < 14 or header[:3] != b"\0\0\1" or header[3] & 0xF0 != VIDEO or not header[7] & TIMED:
        return None
    first, second, third = header[9], int.from_bytes(header[10:12], "big"), int.from_bytes(header[12:14], "big")
    return (first >> 1 & 0x07) << 30 | second >> 1 << 15 | third >> 1


class RestoredTimes:
    """Maps the demuxer's times, which are right except for gaps, to those stored in the file.

    stated  `stream_times`
    """

    def __init__(self, stated: Sequence[int]) -> None:
        self._stated, self._at, self._demuxed = stated, 0, 0

    def next(self, demuxed: int) -> int:
        """The stored time of a unit that the demuxer places `demuxed` ns after the first one."""
        if demuxed == 0 or not self._stated:
            return demuxed
        wanted = self._stated[self._at] + demuxed - self._demuxed
        at = bisect_left(self._stated, wanted - SAME_NS, self._at + 1)
        if at == len(self._stated) or abs(self._stated[at] - wanted) > SAME_NS:
            at = min(self._at + 1, len(self._stated) - 1)  # the demuxer has shortened a gap
        self._at, self._demuxed = at, demuxed
        return self._stated[at]
