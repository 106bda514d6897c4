"""Capture times of the pictures in the video files of a drive. Pure."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from runner.drive.read import Side
from runner.records import Sample, VideoBegan

if TYPE_CHECKING:
    from runner.apply import Unit

SECOND_NS = 1_000_000_000
# A frame of the file and one of the log further apart than this differ; less than most cameras' frame interval.
SAME_NS = 20_000_000

ReadVideo = Callable[[Path], Iterator["Unit"]]


class UnitTimes(NamedTuple):
    """When an access unit was captured and when it arrived, ns since 1970 by the vehicle's clock."""

    captured: int
    arrived: int


def files(side: Side) -> dict[str, list[VideoBegan]]:
    """By camera, its video files, in the order of their first frames."""
    found: dict[str, list[VideoBegan]] = {}
    for line in sorted(side.of(VideoBegan), key=lambda line: line.captured):
        found.setdefault(line.camera, []).append(line)
    return found


def lies_outside(line: VideoBegan) -> bool:
    """Whether a file is not in the directory of its drive, which may come from anywhere."""
    return Path(line.file).is_absolute() or ".." in Path(line.file).parts


def received(side: Side, camera: str) -> list[UnitTimes]:
    """Times of a camera's received frames, in the order of capture; empty if they were not logged."""
    found = (
        UnitTimes(*(round((side.began.time + at + _ahead_s(sample)) * SECOND_NS) for at in (t - ms / 1000, t)))
        for sample in side.of(Sample)
        if camera in sample.cameras
        for t, ms in sample.cameras[camera].arrivals
        if ms is not None
    )
    return sorted(found)


def _ahead_s(sample: Sample) -> float:
    """How far the vehicle's clock was ahead. In older logs latencies are the difference of both clocks."""
    return 0.0 if sample.clock_bound_ms is None else (sample.clock_ahead_ms or 0.0) / 1000


def captured(known: Sequence[int], first: int, after: Iterable[int]) -> Iterator[int]:
    """Capture times of the frames of a file, ns since 1970, increasing.

    known  capture times from the log, increasing; empty for the vehicle's own file, whose times are exact
    first  that of the file's first frame, as its receiver stated it
    after  times since the first frame, by the file
    """
    offset, last = 0, -1
    for ns in after:
        offset = follow(known, first + ns, offset)
        last = max(first + ns + offset, last + 1)
        yield last


def matched(sent: Mapping[bytes, Sequence[int]], pictures: Sequence[bytes], logged: Sequence[int]) -> Iterator[int]:
    """Capture times of received pictures, by those that were sent alike, ns since 1970.

    The log's own times are as uncertain as the difference of the clocks, which may be more than a frame interval in
    the first seconds. A picture that was damaged, so that none was sent alike, is as far off as the one before it.

    sent      by coded picture, when such pictures were captured, increasing
    pictures  coded pictures as received
    logged    their capture times by the log
    """
    off = 0
    for picture, ns in zip(pictures, logged, strict=True):
        alike = sent.get(picture)
        if alike:
            off = min(alike, key=lambda capture: abs(capture - ns - off)) - ns
        yield ns + off


def follow(known: Sequence[int], ns: int, offset: int) -> int:
    """The offset to add to a frame's time in a file, ns, to get its capture time.

    known   capture times from the log, increasing, ns
    ns      the frame's time by the file alone
    offset  that of the previous frame

    A receiver smooths times, and slowly removes the delay of the first frame: 0.1 s and more. Frames missing in file or
    log do not lead to a wrong match, as each frame is searched for near the match of the previous one.
    """
    wanted = ns + offset
    at = bisect_left(known, wanted)
    nearest = min(known[max(0, at - 1) : at + 1], key=lambda capture: abs(capture - wanted), default=None)
    return offset if nearest is None or abs(nearest - wanted) > SAME_NS else nearest - ns
