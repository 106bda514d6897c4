"""The pictures of a camera in the video files of a drive: when each was captured, and which region it shows."""

from __future__ import annotations

import os
from bisect import bisect_right
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from hashlib import blake2b
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, Protocol, TypeVar

from runner.core.model import Camera, Roi
from runner.drive.captures import ReadVideo, RecordedVideo, UnitTimes, arrivals, files, matched, received, unfiled
from runner.drive.read import Drive, Side
from runner.errors import RunError
from runner.h264.access_unit import coded_picture, stated_region
from runner.rate_quality.metrics.interface import Luma
from runner.records.decisions import DecisionMade
from runner.records.vehicle import VehicleState
from runner.system.clocks import SECOND_NS

if TYPE_CHECKING:
    from runner.apply import Unit

T = TypeVar("T")
REPORT_S = 0.25  # between two reports of progress

Regions = Callable[["Unit", int], Roi]  # what a unit shows that was captured then, ns


class DecodeVideo(Protocol):
    """See `runner.gst.pictures.decode_video`."""

    def __call__(
        self, path: Path, size: tuple[int, int] | None, *, fitted: bool = False
    ) -> Iterator[tuple[int, Luma]]: ...


class Captured(NamedTuple):
    """When a picture was captured, ns since 1970 by the vehicle's clock, and the region of the full image in it."""

    ns: int
    region: Roi


FileTimes = tuple[RecordedVideo, Mapping[int, Captured]]  # a file, and its pictures by time as `decode_video` yields it


class Picture(NamedTuple):
    """A decoded picture, and the region of the full image that it shows."""

    luma: Luma
    region: Roi


class _FileUnit(NamedTuple):
    """An access unit: its time as `decode_video` yields it; digest of its coded picture."""

    after: int
    captured: Captured
    coded: bytes


@dataclass(frozen=True, slots=True)
class Videos:
    """The video files of a drive."""

    directory: Path
    read: ReadVideo
    decode: DecodeVideo

    def pictures(
        self, timed: Sequence[FileTimes], size: tuple[int, int] | None = None
    ) -> Iterator[tuple[int, Picture]]:
        """The decoded pictures of files, with their capture times.

        size  to which they are scaled; None: as they were coded
        """
        for file, times in timed:
            for after, luma in self.decode(self.directory / file.name, size) if times else ():
                if after in times:
                    yield times[after].ns, Picture(luma, times[after].region)

    def units(self, file: RecordedVideo, regions: Regions) -> list[_FileUnit]:
        """The access units of a file."""
        found = []
        for unit in () if file.is_outside else self.read(self.directory / file.name):
            ns = file.captured(unit.after_ns)
            coded = blake2b(coded_picture(unit.data, unit.codec), digest_size=16).digest()
            found.append(_FileUnit(unit.demuxed_ns, Captured(ns, regions(unit, ns)), coded))
        return found


@dataclass(frozen=True, slots=True)
class CameraVideo:
    """What both sides have recorded of a camera.

    sent, shown  files as sent and as received; capture times are those of identical pictures that were sent
    units        pictures that arrived, in the order of capture
    absent       those of them that are in no file
    """

    sent: Sequence[FileTimes]
    shown: Sequence[FileTimes]
    units: Sequence[UnitTimes]
    absent: frozenset[UnitTimes]

    def showing(self, region: Roi) -> frozenset[int]:
        """Capture times of the pictures, sent or received, that show a region, ns."""
        every = chain.from_iterable(times.values() for _, times in (*self.sent, *self.shown))
        return frozenset(captured.ns for captured in every if captured.region == region)

    def ends(self, began: int) -> tuple[float, float]:
        """The last pictures in the vehicle's files, and of those that arrived, s since `began`, ns; 0: none."""
        every = (self.captured, [unit.captured for unit in self.units])
        sent, arrived = ((max(times, default=began) - began) / SECOND_NS for times in every)
        return sent, arrived

    @property
    def captured(self) -> list[int]:
        """Capture times of the pictures that were sent, ns."""
        return [captured.ns for _, times in self.sent for captured in times.values()]


def each_camera(
    drive: Drive,
    videos: Videos,
    cameras: Mapping[str, Camera],
    measured: Callable[[Camera, CameraVideo], tuple[T, Sequence[str]]],
    on_progress: Callable[[float], None],
    on_warning: Callable[[str], None],
) -> dict[str, T]:
    """What is measured of each camera whose video both sides recorded, on all processors.

    measured     what is found of one camera, and lines about what its files lack
    on_progress  called a few times a second, from this thread, with the share of the cameras done
    on_warning   called with a line about each camera that is left out, since nothing was received or files cannot be
                 read, and about each whose files lack pictures, so that it is scored only where they do not
    """
    sent, shown = files(drive.sides["vehicle"]), files(drive.sides["operator"])
    names = [name for name in cameras if name in sent and name in shown]
    for name in [name for name in cameras if names and name in sent and name not in shown]:
        on_warning(f"{name} is left out: no picture of it was received, so mean and worst are too high")

    def one(name: str) -> tuple[T, Sequence[str]]:
        return measured(cameras[name], _camera_video(drive, videos, cameras[name], sent[name], shown[name]))

    pool = ThreadPoolExecutor(os.cpu_count())
    try:
        work = {name: pool.submit(one, name) for name in names}
        while not all(each.done() for each in work.values()):
            on_progress(sum(each.done() for each in work.values()) / len(work))
            wait(work.values(), REPORT_S)
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
    found: dict[str, T] = {}
    for name, each in work.items():
        if isinstance(error := each.exception(), RunError):
            on_warning(f"{name} is left out: {error}")
            continue
        found[name], lacking = each.result()
        for line in lacking:
            on_warning(f"{name}: {line}")
    return found


def _camera_video(
    drive: Drive, videos: Videos, camera: Camera, sent: Sequence[RecordedVideo], received_files: Sequence[RecordedVideo]
) -> CameraVideo:
    """The video of one camera.

    raises  RunError if a file cannot be read
    """
    regions = _regions(camera, drive.sides["vehicle"], drive.sides["operator"])
    sent_units = [videos.units(file, regions) for file in sent]
    received_units = [videos.units(file, regions) for file in received_files]
    _drop_cut_off(sent_units, received_units)
    capture_times: dict[bytes, list[int]] = {}
    for unit in chain.from_iterable(sent_units):
        capture_times.setdefault(unit.coded, []).append(unit.captured.ns)
    exact = [(file, {each.after: each.captured for each in own}) for file, own in zip(sent, sent_units, strict=True)]
    shown: list[FileTimes] = []
    own: list[int] = []
    for file, found in zip(received_files, received_units, strict=True):
        times = list(matched(capture_times, [each.coded for each in found], [each.captured.ns for each in found]))
        shown.append((file, {u.after: u.captured._replace(ns=ns) for u, ns in zip(found, times, strict=True)}))
        own += times
    log = received(drive.sides["operator"], camera.name)
    units = arrivals(sorted(own), log)
    absent = frozenset(unfiled(units, log))
    return CameraVideo(exact, shown, sorted([*units, *absent]), absent)


def _drop_cut_off(*sides: Sequence[list[_FileUnit]]) -> None:
    """Drop the last unit of a file, which may have been cut off, unless the other side has the same."""
    known = [{unit.coded for units in side for unit in units} for side in sides]
    for side, other in zip(sides, reversed(known), strict=True):
        for units in side:
            if units and units[-1].coded not in other:
                units.pop()


def _regions(camera: Camera, vehicle: Side, operator: Side) -> Regions:
    """What pictures show: as they say themselves, otherwise as it was decided when they were captured."""
    states = (state.cameras[camera.name] for state in operator.of(VehicleState) if camera.name in state.cameras)
    if any(state.placed is True for state in states):
        return lambda unit, _: stated_region(unit.data) or camera.full_roi
    decisions = [line for line in vehicle.of(DecisionMade) if camera.name in line.cameras]
    times = [round((vehicle.began_s + line.t) * SECOND_NS) for line in decisions]

    def decided(_: Unit, ns: int) -> Roi:
        at = bisect_right(times, ns) - 1
        return decisions[at].cameras[camera.name].roi if at >= 0 else camera.full_roi

    return decided
