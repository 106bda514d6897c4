"""Quality of what the operator saw: the displayed picture at each moment compared with the scene at that moment.

For a moment t, the displayed picture is the newest one captured by t that had arrived by t + DEADLINE_S. So a frozen,
lost or late picture is compared with a scene that has moved on. Pictures are compared at the full size of the camera,
after scaling, as a screen shows them, damage included.

The scene is the camera's rendered clip, if its source has one: losses by scaling and encoding are included. For other
sources only the stream as sent is known, so these losses are not included.
"""

from __future__ import annotations

import os
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from hashlib import blake2b
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from runner.core.model import Camera
from runner.drive.captures import (
    SAME_NS,
    ReadVideo,
    RecordedVideo,
    UnitTimes,
    arrivals,
    files,
    matched,
    received,
    unfiled,
)
from runner.drive.quality_file import DeliveredQuality
from runner.drive.read import Drive, Side
from runner.errors import RunError
from runner.h264.access_unit import coded_picture
from runner.rate_quality.metrics.interface import Luma
from runner.rate_quality.metrics.mssim import metric
from runner.records.decisions import DecisionMade
from runner.records.operator import Sample
from runner.system.clocks import SECOND_NS

if TYPE_CHECKING:
    from runner.apply import Unit

DEADLINE_S = 0.3  # a later picture is useless for driving
EVERY_S = 0.5  # between two moments that are compared
REPORT_S = 0.25  # between two reports of progress
BLOCKS = 32  # along the shorter side of a picture

DecodeVideo = Callable[[Path, int, int], Iterator[tuple[int, Luma]]]
FileTimes = tuple[
    RecordedVideo, Mapping[int, int]
]  # a file, and its capture times, ns, by time as `decode_video` yields it


def measure(
    drive: Drive,
    cameras: Mapping[str, Camera],
    clips: Mapping[str, Path],
    read_video: ReadVideo,
    decode_video: DecodeVideo,
    on_progress: Callable[[float], None] = lambda done: None,
    on_warning: Callable[[str], None] = lambda what: None,
) -> dict[str, DeliveredQuality]:
    """Measure all cameras whose video both sides recorded, on all processors.

    clips       by camera, the clip that its source played; cameras not listed are compared with the stream as sent
    on_progress called a few times a second, from this thread, with the share of the cameras done
    on_warning  called with a line about each camera that is left out, since nothing was received or files cannot be
                read, and about each whose files lack pictures, so that it is scored only where they do not
    """
    vehicle, operator = drive.sides["vehicle"], drive.sides["operator"]
    sent, received_files = files(vehicle), files(operator)
    names = [name for name in cameras if name in sent and name in received_files]
    for name in [name for name in cameras if names and name in sent and name not in received_files]:
        on_warning(f"{name} is left out: no picture of it was received, so mean and worst are too high")
    videos = _Videos(drive.path, read_video, decode_video)

    def one(name: str) -> tuple[DeliveredQuality, list[str]]:
        return _camera(cameras[name], videos, vehicle, operator, sent[name], received_files[name], clips.get(name))

    pool = ThreadPoolExecutor(os.cpu_count())
    try:
        work = {name: pool.submit(one, name) for name in names}
        while not all(each.done() for each in work.values()):
            on_progress(sum(each.done() for each in work.values()) / len(work))
            wait(work.values(), REPORT_S)
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
    found: dict[str, DeliveredQuality] = {}
    for name, each in work.items():
        if isinstance(error := each.exception(), RunError):
            on_warning(f"{name} is left out: {error}")
            continue
        found[name], lacking = each.result()
        for line in lacking:
            on_warning(f"{name}: {line}")
    return found


def displayed_units(moments: Sequence[int], units: Sequence[UnitTimes], deadline_ns: int) -> list[int]:
    """By moment, the index of the unit whose picture is displayed; -1: none had arrived.

    moments  capture times, ns
    units    in the order of capture, as they were received
    """
    times = [unit.captured for unit in units]
    found = []
    for moment in moments:
        number = bisect_right(times, moment + SAME_NS // 2) - 1
        while number >= 0 and units[number].arrived > moment + deadline_ns:
            number -= 1
        found.append(number)
    return found


class _FileUnit(NamedTuple):
    """An access unit: its time as `decode_video` yields it, its capture time, ns; digest of its coded picture."""

    after: int
    captured: int
    coded: bytes


def _digest(unit: Unit) -> bytes:
    return blake2b(coded_picture(unit.data, unit.codec), digest_size=16).digest()


@dataclass(frozen=True, slots=True)
class _Videos:
    """The video files of a drive."""

    directory: Path
    read: ReadVideo
    decode: DecodeVideo

    def units(self, file: RecordedVideo) -> list[_FileUnit]:
        """The access units of a file."""
        found = () if file.is_outside else self.read(self.directory / file.name)
        return [_FileUnit(unit.demuxed_ns, file.captured(unit.after_ns), _digest(unit)) for unit in found]

    def pictures(self, timed: Sequence[FileTimes], size: tuple[int, int]) -> Iterator[tuple[int, Luma]]:
        """The decoded pictures of files, with their capture times."""
        for file, times in timed:
            for after, picture in self.decode(self.directory / file.name, *size) if times else ():
                if after in times:
                    yield times[after], picture


def _matched(
    videos: _Videos, sent: Sequence[RecordedVideo], received_files: Sequence[RecordedVideo], log: Sequence[UnitTimes]
) -> tuple[list[FileTimes], list[FileTimes], list[UnitTimes]]:
    """Files as sent and as received, with capture times by the vehicle, and when each received unit arrived."""
    sent_units = [videos.units(file) for file in sent]
    received_units = [videos.units(file) for file in received_files]
    _drop_cut_off(sent_units, received_units)
    exact: list[FileTimes] = [
        (file, {unit.after: unit.captured for unit in found}) for file, found in zip(sent, sent_units, strict=True)
    ]
    capture_times: dict[bytes, list[int]] = {}
    for unit in chain.from_iterable(sent_units):
        capture_times.setdefault(unit.coded, []).append(unit.captured)
    shown: list[FileTimes] = []
    own: list[int] = []
    for file, found in zip(received_files, received_units, strict=True):
        times = list(matched(capture_times, [unit.coded for unit in found], [unit.captured for unit in found]))
        shown.append((file, {unit.after: ns for unit, ns in zip(found, times, strict=True)}))
        own += times
    return exact, shown, arrivals(sorted(own), log)


def _drop_cut_off(*sides: Sequence[list[_FileUnit]]) -> None:
    """Drop the last unit of a file, which may have been cut off, unless the other side has the same."""
    known = [{unit.coded for units in side for unit in units} for side in sides]
    for side, other in zip(sides, reversed(known), strict=True):
        for units in side:
            if units and units[-1].coded not in other:
                units.pop()


def _camera(
    camera: Camera,
    videos: _Videos,
    vehicle: Side,
    operator: Side,
    sent: Sequence[RecordedVideo],
    received_files: Sequence[RecordedVideo],
    clip: Path | None,
) -> tuple[DeliveredQuality, list[str]]:
    """The quality of one camera, and lines about what its files lack."""
    log = received(operator, camera.name)
    exact, shown, units = _matched(videos, sent, received_files, log)
    is_whole = _sends_whole(vehicle, camera)
    captured = [ns for _, times in exact for ns in times.values()]
    moments = _moments(captured, units, _last_sample_ns(operator), is_whole)
    absent = set(unfiled(units, log))
    units = sorted([*units, *absent])
    numbers = displayed_units(moments, units, round(DEADLINE_S * SECOND_NS))
    displayed = [(moment, units[number]) for moment, number in zip(moments, numbers, strict=True) if number >= 0]
    pairs = [(moment, unit.captured) for moment, unit in displayed if unit not in absent]
    pairs = [(moment, displayed) for moment, displayed in pairs if is_whole(displayed)]
    scene_at = _lookup(_scenes(camera, videos, exact, [moment for moment, _ in pairs], clip))
    size = (camera.width, camera.height)
    meter = metric().meter(size, camera.fps)
    for number, picture in _displayed(pairs, videos.pictures(shown, size) if pairs else ()):
        if (scene := scene_at(pairs[number][0])) is not None:
            meter.add(number, scene, picture)
    scores = meter.close()
    began = round(vehicle.began_s * SECOND_NS)
    unknown = [(moment - began) / SECOND_NS for moment, unit in displayed if unit in absent]
    ends = [(max(times, default=began) - began) / SECOND_NS for times in (captured, [unit.captured for unit in units])]
    stale = [moment - displayed > SAME_NS for moment, displayed in pairs]
    found = DeliveredQuality(
        t=tuple((pairs[number][0] - began) / SECOND_NS for number in scores),
        mssim=tuple(scores.values()),
        stale=sum(stale) / len(stale) if stale else 0.0,
        clip=clip is not None,
    )
    return found, list(_lacking(len(displayed), unknown, *ends))


def _lacking(moments: int, unknown: Sequence[float], sent_end: float, received_end: float) -> Iterator[str]:
    """What the files lack, in lines.

    unknown                 moments at which a picture was displayed that is in no file, s
    sent_end, received_end  the last pictures in the vehicle's files, and of those that arrived, s; 0: there is none
    """
    if unknown:
        lacks = f"the operator's video lacks pictures that arrived, from {unknown[0]:.1f} to {unknown[-1]:.1f} s"
        yield f"{lacks}: {len(unknown)} of {moments} moments are left out"
    if received_end - sent_end > EVERY_S:
        ends = f"the vehicle's video ends at {sent_end:.1f} s, what arrived at {received_end:.1f} s"
        yield f"{ends}: scored up to its end"


def _displayed(pairs: Sequence[tuple[int, int]], pictures: Iterable[tuple[int, Luma]]) -> Iterator[tuple[int, Luma]]:
    """By index of the moment, the displayed picture; where the decoder dropped it, the last one before it.

    pairs  moments, and capture times of the displayed pictures, neither ever decreasing
    """
    waiting = deque(enumerate(displayed for _, displayed in pairs))
    last: Luma | None = None
    for ns, picture in pictures:
        while waiting and last is not None and waiting[0][1] < ns:
            yield waiting.popleft()[0], last
        last = picture
    while waiting and last is not None:
        yield waiting.popleft()[0], last


def _last_sample_ns(operator: Side) -> int:
    """Time of the operator's last sample, ns since 1970 by the vehicle's clock."""
    return round((operator.began_s + max((sample.t for sample in operator.of(Sample)), default=0.0)) * SECOND_NS)


def _moments(sent: Sequence[int], units: Sequence[UnitTimes], until: int, counts: Callable[[int], bool]) -> list[int]:
    """Capture times of the vehicle's pictures, EVERY_S apart, from the first one received until the operator's end."""
    found: list[int] = []
    for ns in sent:
        in_time = units and units[0].captured <= ns <= until - DEADLINE_S * SECOND_NS
        if in_time and counts(ns) and (not found or ns - found[-1] >= EVERY_S * SECOND_NS):
            found.append(ns)
    return found


def _sends_whole(vehicle: Side, camera: Camera) -> Callable[[int], bool]:
    """Whether the whole image was sent at a time, ns since 1970; a region is not compared."""
    decisions = [line for line in vehicle.of(DecisionMade) if camera.name in line.cameras]
    times = [round((vehicle.began_s + line.t) * SECOND_NS) for line in decisions]

    def is_whole(ns: int) -> bool:
        at = bisect_right(times, ns) - 1
        return at >= 0 and decisions[at].cameras[camera.name].roi == camera.full_roi

    return is_whole


def _scenes(
    camera: Camera,
    videos: _Videos,
    sent: Sequence[FileTimes],
    moments: Sequence[int],
    clip: Path | None,
) -> Iterator[tuple[int, Luma]]:
    """Moments and their scenes, in the order of capture. All scenes of a drive would not fit into memory."""
    times = set(moments)
    if not times:
        return
    if clip is None:
        size = (camera.width, camera.height)
        yield from ((ns, picture) for ns, picture in videos.pictures(sent, size) if ns in times)
        return
    crop = camera.in_source
    width, height = camera.source_size
    window = np.s_[crop.y : crop.y + crop.height, crop.x : crop.x + crop.width]
    clipped = [_thumbnail(picture[window]) for _, picture in videos.decode(clip, width, height)]
    numbers = {
        ns: _nearest(clipped, _thumbnail(picture))
        for ns, picture in videos.pictures(sent, (camera.width, camera.height))
        if ns in times
    }
    needed = set(numbers.values())
    scenes = {n: p[window] for n, (_, p) in enumerate(videos.decode(clip, width, height)) if n in needed}
    yield from ((ns, scenes[number]) for ns, number in numbers.items())


def _lookup(scenes: Iterator[tuple[int, Luma]]) -> Callable[[int], Luma | None]:
    """A function that returns the scene at a moment, None if it is missing; moments must not decrease."""
    current: tuple[int, Luma] | None = None

    def at(moment: int) -> Luma | None:
        nonlocal current
        while current is None or current[0] < moment:
            current = next(scenes, None)
            if current is None:
                return None
        return current[1] if current[0] == moment else None

    return at


def _thumbnail(picture: Luma) -> NDArray[np.float32]:
    """The picture in blocks, enough to recognise it in a clip."""
    side = max(1, min(picture.shape) // BLOCKS)
    height, width = (length // side for length in picture.shape)
    blocks = picture[: height * side, : width * side].reshape(height, side, width, side)
    small: NDArray[np.float32] = blocks.mean(axis=(1, 3), dtype=np.float32)
    return small


def _nearest(candidates: Sequence[NDArray[np.float32]], picture: NDArray[np.float32]) -> int:
    return int(np.argmin([np.square(candidate - picture).sum() for candidate in candidates]))
