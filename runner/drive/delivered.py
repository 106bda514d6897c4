"""Quality of what the operator saw: the picture on show at each moment against the scene that the camera saw then.

For a picture captured at time t, what counts is the newest picture captured by then that had arrived DEADLINE_S after.
So one that was frozen, lost or late is compared with a scene that has moved on. Pictures are compared at the full size
of the camera, after scaling, as a screen shows them, damage included.

The scene is the camera's rendered clip, if its source has one: what scaling and encoding lost is included. Of
other sources only the stream as sent is known: what it lost against the scene is not included.
"""

from __future__ import annotations

import os
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from runner.core.model import Camera
from runner.drive.captures import (
    SAME_NS,
    SECOND_NS,
    FilmedFile,
    ReadVideo,
    UnitTimes,
    arrivals,
    files,
    matched,
    received,
)
from runner.drive.quality_file import DeliveredQuality
from runner.drive.read import Drive, Side
from runner.errors import RunError
from runner.h264.access_unit import coded_picture
from runner.rate_quality.metrics.interface import Luma
from runner.rate_quality.metrics.mssim import metric
from runner.records import DecisionMade, Sample

if TYPE_CHECKING:
    from runner.apply import Unit

DEADLINE_S = 0.3  # a later picture is of no use for driving
EVERY_S = 0.5  # between two moments that are compared
TELL_S = 0.25  # between two reports of progress
BLOCKS = 32  # along the shorter side of a picture

DecodeVideo = Callable[[Path, int, int], Iterator[tuple[int, Luma]]]
FileTimes = tuple[
    FilmedFile, Mapping[int, int]
]  # a file; by time as `decode_video` gives it, when each was captured, ns


def measure(
    drive: Drive,
    cameras: Mapping[str, Camera],
    clips: Mapping[str, Path],
    read_video: ReadVideo,
    decode_video: DecodeVideo,
    progress: Callable[[float], None] = lambda done: None,
    on_warning: Callable[[str], None] = lambda what: None,
) -> dict[str, DeliveredQuality]:
    """Measure all cameras whose video both sides have kept, on all processors.

    clips       by camera, the clip that its source repeated; others are left out
    progress    called a few times a second, by this thread, with the share of the cameras done
    on_warning  called with a line about each camera that is left out, since its files cannot be read
    """
    vehicle, operator = drive.sides["vehicle"], drive.sides["operator"]
    sent, came = files(vehicle), files(operator)
    names = [name for name in cameras if name in sent and name in came]
    videos = _Videos(drive.path, read_video, decode_video)

    def one(name: str) -> DeliveredQuality:
        return _camera(cameras[name], videos, vehicle, operator, sent[name], came[name], clips.get(name))

    pool = ThreadPoolExecutor(os.cpu_count())
    try:
        work = {name: pool.submit(one, name) for name in names}
        while not all(each.done() for each in work.values()):
            progress(sum(each.done() for each in work.values()) / len(work))
            wait(work.values(), TELL_S)
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
    for name, each in work.items():
        if isinstance(error := each.exception(), RunError):
            on_warning(f"{name} is left out: {error}")
    return {name: each.result() for name, each in work.items() if not isinstance(each.exception(), RunError)}


def due(moments: Sequence[int], units: Sequence[UnitTimes], deadline_ns: int) -> list[int]:
    """By moment, the number of the unit whose picture stands for it; -1: none had arrived.

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
    """An access unit: its time as `decode_video` gives it, when it was captured, ns; digest of its coded picture."""

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

    def units(self, file: FilmedFile) -> list[_FileUnit]:
        """The access units of a file."""
        found = () if file.lies_outside else self.read(self.directory / file.name)
        return [_FileUnit(unit.demuxed_ns, file.captured(unit.after_ns), _digest(unit)) for unit in found]

    def pictures(self, timed: Sequence[FileTimes], size: tuple[int, int]) -> Iterator[tuple[int, Luma]]:
        """The decoded pictures of some files, with their capture times."""
        for file, times in timed:
            for after, picture in self.decode(self.directory / file.name, *size) if times else ():
                if after in times:
                    yield times[after], picture


def _matched(
    videos: _Videos, sent: Sequence[FilmedFile], came: Sequence[FilmedFile], log: Sequence[UnitTimes]
) -> tuple[list[FileTimes], list[FileTimes], list[UnitTimes]]:
    """Files as sent and as received, with the vehicle's own times of capture, and when each received unit arrived."""
    exact: list[FileTimes] = []
    alike: dict[bytes, list[int]] = {}
    for file in sent:
        found = videos.units(file)
        exact.append((file, {unit.after: unit.captured for unit in found}))
        for unit in found:
            alike.setdefault(unit.coded, []).append(unit.captured)
    shown: list[FileTimes] = []
    own: list[int] = []
    for file in came:
        found = videos.units(file)
        times = list(matched(alike, [unit.coded for unit in found], [unit.captured for unit in found]))
        shown.append((file, {unit.after: ns for unit, ns in zip(found, times, strict=True)}))
        own += times
    return exact, shown, arrivals(sorted(own), log)


def _camera(
    camera: Camera,
    videos: _Videos,
    vehicle: Side,
    operator: Side,
    sent: Sequence[FilmedFile],
    came: Sequence[FilmedFile],
    clip: Path | None,
) -> DeliveredQuality:
    exact, shown, units = _matched(videos, sent, came, received(operator, camera.name))
    whole = _whole(vehicle, camera)
    moments = _moments([ns for _, times in exact for ns in times.values()], units, _last(operator), whole)
    numbers = due(moments, units, round(DEADLINE_S * SECOND_NS))
    pairs = [(moment, units[number].captured) for moment, number in zip(moments, numbers, strict=True) if number >= 0]
    pairs = [(moment, on_show) for moment, on_show in pairs if whole(on_show)]
    scenes = _scenes(camera, videos, exact, [moment for moment, _ in pairs], clip)
    size = (camera.width, camera.height)
    meter = metric().meter(size, camera.fps)
    for number, picture in _on_show(pairs, videos.pictures(shown, size) if pairs else ()):
        if pairs[number][0] in scenes:
            meter.add(number, scenes[pairs[number][0]], picture)
    scores = meter.close()
    began = round(vehicle.began.time * SECOND_NS)
    stale = [moment - on_show > SAME_NS for moment, on_show in pairs]
    return DeliveredQuality(
        t=tuple((pairs[number][0] - began) / SECOND_NS for number in scores),
        mssim=tuple(scores.values()),
        stale=sum(stale) / len(stale) if stale else 0.0,
        clip=clip is not None,
    )


def _on_show(pairs: Sequence[tuple[int, int]], pictures: Iterable[tuple[int, Luma]]) -> Iterator[tuple[int, Luma]]:
    """By number of the moment, the picture on show; where the decoder left it out, the last one before it.

    pairs  moments, and the capture time of what was on show, neither ever decreasing
    """
    waiting = deque(enumerate(on_show for _, on_show in pairs))
    last: Luma | None = None
    for ns, picture in pictures:
        while waiting and last is not None and waiting[0][1] < ns:
            yield waiting.popleft()[0], last
        last = picture
    while waiting and last is not None:
        yield waiting.popleft()[0], last


def _last(operator: Side) -> int:
    """When the operator's side measured for the last time, ns since 1970 by the vehicle's clock."""
    return round((operator.began_s + max((sample.t for sample in operator.of(Sample)), default=0.0)) * SECOND_NS)


def _moments(sent: Sequence[int], units: Sequence[UnitTimes], until: int, counts: Callable[[int], bool]) -> list[int]:
    """Capture times of the vehicle's pictures, EVERY_S apart, from the first one received until the operator's end."""
    found: list[int] = []
    for ns in sent:
        received_then = units and units[0].captured <= ns <= until - DEADLINE_S * SECOND_NS
        if received_then and counts(ns) and (not found or ns - found[-1] >= EVERY_S * SECOND_NS):
            found.append(ns)
    return found


def _whole(vehicle: Side, camera: Camera) -> Callable[[int], bool]:
    """Whether the whole image was sent at a time, ns since 1970; a region is not compared."""
    decisions = [line for line in vehicle.of(DecisionMade) if camera.name in line.cameras]
    times = [round((vehicle.began.time + line.t) * SECOND_NS) for line in decisions]

    def whole(ns: int) -> bool:
        at = bisect_right(times, ns) - 1
        return at >= 0 and decisions[at].cameras[camera.name].roi == camera.full_roi

    return whole


def _scenes(
    camera: Camera,
    videos: _Videos,
    sent: Sequence[FileTimes],
    moments: Sequence[int],
    clip: Path | None,
) -> dict[int, Luma]:
    """The scene at each moment."""
    wanted = set(moments)
    if not wanted:
        return {}
    if clip is None:
        size = (camera.width, camera.height)
        return {ns: picture for ns, picture in videos.pictures(sent, size) if ns in wanted}
    crop = camera.in_source
    width, height = camera.source_size
    window = np.s_[crop.y : crop.y + crop.height, crop.x : crop.x + crop.width]
    clipped = [_thumbnail(picture[window]) for _, picture in videos.decode(clip, width, height)]
    numbers = {
        ns: _nearest(clipped, _thumbnail(picture))
        for ns, picture in videos.pictures(sent, (camera.width, camera.height))
        if ns in wanted
    }
    needed = set(numbers.values())  # a whole clip would not fit into memory
    scenes = {n: p[window] for n, (_, p) in enumerate(videos.decode(clip, width, height)) if n in needed}
    return {ns: scenes[number] for ns, number in numbers.items()}


def _thumbnail(picture: Luma) -> NDArray[np.float32]:
    """The picture in blocks, enough to recognise it in a clip."""
    side = max(1, min(picture.shape) // BLOCKS)
    height, width = (length // side for length in picture.shape)
    blocks = picture[: height * side, : width * side].reshape(height, side, width, side)
    small: NDArray[np.float32] = blocks.mean(axis=(1, 3), dtype=np.float32)
    return small


def _nearest(candidates: Sequence[NDArray[np.float32]], picture: NDArray[np.float32]) -> int:
    return int(np.argmin([np.square(candidate - picture).sum() for candidate in candidates]))
