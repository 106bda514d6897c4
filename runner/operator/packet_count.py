"""Counts what arrived of all cameras between two times: what the link they share carried in between."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterable
from itertools import accumulate
from math import inf
from typing import NamedTuple

from runner.records.reception import ArrivedPacket

KEPT = 4096  # packets, those of a second at 40 Mbit/s: a frame that takes longer to arrive is not counted


class Count(NamedTuple):
    """Of packets, and of their bytes without headers."""

    packets: int = 0
    bytes: int = 0


class PacketCount:
    """Packets of all cameras in order of arrival. Those that arrived at the same time count together."""

    def __init__(self) -> None:
        self._packets: list[ArrivedPacket] = []
        self._bytes = [0]  # that arrived before each packet, and in all
        self._forgotten = 0  # packets before the first one
        self._last, self._carried = -inf, Count()  # the newest time asked for, and what had been counted up to it

    def add(self, arrived: Iterable[ArrivedPacket]) -> None:
        """Add packets, in any order: a camera's thread may handle its own later than others handle newer ones."""
        self._forget()
        new = sorted(arrived)
        start = bisect_left(self._packets, new[0]) if new else len(self._packets)
        self._packets[start:] = sorted([*self._packets[start:], *new])
        self._bytes[start:] = accumulate((size for _, size in self._packets[start:]), initial=self._bytes[start])

    def between(self, first: float, last: float) -> Count:
        """What arrived after one time and until another; nothing if the former is too long ago."""
        if not self._packets or first < self._packets[0][0]:
            return Count()
        return _difference(self._until(first), self._until(last))

    def carried(self, at: float) -> Count:
        """What arrived since the time last asked for and until this one, of which nothing is counted twice or left out.

        Packets that were added too late for the time in which they arrived count with the next. A frame may be late in
        the same way: nothing arrived between a time and an earlier one.
        """
        if at <= self._last:
            return Count()
        before, self._carried, self._last = self._carried, self._until(at), at
        return _difference(before, self._carried)

    def _until(self, at: float) -> Count:
        index = bisect_right(self._packets, (at, inf))
        return Count(self._forgotten + index, self._bytes[index])

    def _forget(self) -> None:
        excess = max(0, len(self._packets) - KEPT)
        del self._packets[:excess], self._bytes[:excess]
        self._forgotten += excess


def _difference(before: Count, after: Count) -> Count:
    return Count(after.packets - before.packets, after.bytes - before.bytes)
