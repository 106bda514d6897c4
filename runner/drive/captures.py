"""Capture times of the pictures in the video files of a drive. Pure."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from runner.drive.read import Side
from runner.records.lines import VideoBegan, VideoShifted
from runner.records.operator import Sample
from runner.system.clocks import SECOND_NS

if TYPE_CHECKING:
    from runner.apply import Unit

# A frame of the file and one of the log are different if further apart; less than most cameras' frame interval.
SAME_NS = 20_000_000
ROUNDING_NS = 1_000_000  # of times in the file, which count in 1/90000 s
UNCERTAIN_NS = 150_000_000  # error of the clock difference in the first seconds

ReadVideo = Callable[[Path], Iterator["Unit"]]


class UnitTimes(NamedTuple):
    """When an access unit was captured and when it arrived, ns since 1970 by the vehicle's clock."""

    captured: int
    arrived: int


@dataclass(frozen=True, slots=True)
class RecordedVideo:
    """A video file of a drive.

    name   relative to the directory of the drive
    times  (file time since the first frame, capture time), ns: from each of these frames on, both advance equally
    """

    camera: str
    name: str
    times: tuple[tuple[int, int], ...]

    def captured(self, after_ns: int) -> int:
        """Capture time of a frame, ns since 1970."""
        at = bisect_right(self.times, after_ns + ROUNDING_NS, key=itemgetter(0)) - 1
        after, captured = self.times[max(0, at)]
        return captured + after_ns - after

    @property
    def is_outside(self) -> bool:
        """Whether its path leads out of the drive's directory: a drive may come from anyone."""
        return Path(self.name).is_absolute() or ".." in Path(self.name).parts


def files(side: Side) -> dict[str, list[RecordedVideo]]:
    """By camera, its video files, in the order of their first frames."""
    shifts: dict[str, list[tuple[int, int]]] = {}
    for shift in side.of(VideoShifted):
        shifted = (round(shift.after_s * SECOND_NS), round(side.corrected(shift.captured, shift.t) * SECOND_NS))
        shifts.setdefault(shift.file, []).append(shifted)
    found: dict[str, list[RecordedVideo]] = {}
    began = ((side.corrected(line.captured, line.t), line) for line in side.of(VideoBegan))
    for captured, line in sorted(began, key=itemgetter(0)):
        times = ((0, round(captured * SECOND_NS)), *sorted(shifts.get(line.file, [])))
        found.setdefault(line.camera, []).append(RecordedVideo(line.camera, line.file, times))
    return found


def received(side: Side, camera: str) -> list[UnitTimes]:
    """Times of a camera's received frames, in the order of capture; empty if they were not logged."""
    found = (
        UnitTimes(*(round((arrived - ago) * SECOND_NS) for ago in (ms / 1000, 0.0)))
        for sample in side.of(Sample)
        if camera in sample.cameras
        for t, ms in sample.cameras[camera].arrivals
        if ms is not None
        for arrived in (side.corrected(side.began.time + t + (sample.clock_ahead_ms or 0.0) / 1000, sample.t),)
    )
    return sorted(found)


def matched(sent: Mapping[bytes, Sequence[int]], pictures: Sequence[bytes], file_times: Sequence[int]) -> Iterator[int]:
    """Capture times of received pictures, ns since 1970, from identical pictures that were sent.

    A receiver's own times are off by what its jitter buffer adds and removes, up to a second after an outage. A damaged
    picture, to which no sent one is identical, gets the correction of the one before it.

    sent        by coded picture, capture times of such pictures, increasing
    pictures    coded pictures as received
    file_times  their capture times according to the receiver's file
    """
    off = 0
    for picture, ns in zip(pictures, file_times, strict=True):
        identical = sent.get(picture)
        if identical:
            off = min(identical, key=lambda capture: abs(capture - ns - off)) - ns
        yield ns + off


def arrivals(captured: Sequence[int], log: Sequence[UnitTimes]) -> list[UnitTimes]:
    """When pictures arrived, according to the log; pictures not in it are left out.

    The log's capture times are as uncertain as the difference of the clocks, which may be more than a frame interval in
    the first seconds. After that it changes slowly, so each picture is searched for near the match of the previous one.

    captured  capture times, ns since 1970, increasing
    """
    known, off, found = [unit.captured for unit in log], 0, []
    for ns in captured:
        at = bisect_left(known, ns + off)
        nearest = min(log[max(0, at - 1) : at + 1], key=lambda unit: abs(unit.captured - ns - off), default=None)
        if nearest is not None and abs(nearest.captured - ns - off) <= (UNCERTAIN_NS if off == 0 else SAME_NS):
            off = nearest.captured - ns
            found.append(UnitTimes(ns, nearest.arrived))
    return found


def unfiled(units: Sequence[UnitTimes], log: Sequence[UnitTimes]) -> list[UnitTimes]:
    """Pictures that arrived according to the log, and are in no file: it was cut off, or the disk was too slow.

    units  of the files, as `arrivals` found them in the log
    log    in the order of capture
    """
    filed = {unit.arrived: unit.captured for unit in units}
    captured, off, found = [unit.captured for unit in units], 0, []
    for unit in log:
        if unit.arrived in filed:
            off = unit.captured - filed[unit.arrived]
            continue
        at = bisect_left(captured, unit.captured - off)
        if all(abs(ns - unit.captured + off) > SAME_NS for ns in captured[max(0, at - 1) : at + 1]):
            found.append(UnitTimes(unit.captured - off, unit.arrived))
    return found
