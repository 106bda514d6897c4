"""Quality of what the operator saw: the displayed picture at each moment compared with the scene at that moment.

For a moment t, the displayed picture is the newest one captured by t that had arrived by t + DEADLINE_S. So a frozen,
lost or late picture is compared with a scene that has moved on. Pictures are compared at the full size of the camera,
after scaling, as a screen shows them, damage included.

The scene is the clip that the camera's source plays, if it does: losses by scaling and encoding are included. For
other sources only the stream as sent is known, so these losses are not included.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

from runner.core.model import Camera
from runner.drive.captures import SAME_NS, UnitTimes
from runner.drive.quality_file import DeliveredQuality
from runner.drive.read import Drive, Side
from runner.drive.scenes import lookup, scenes
from runner.drive.videos import CameraVideo, Videos, each_camera
from runner.rate_quality.metrics.mssim import metric
from runner.records.operator import Sample
from runner.records.vehicle import VehicleState
from runner.system.clocks import SECOND_NS

T = TypeVar("T")
DEADLINE_S = 0.3  # a later picture is useless for driving
EVERY_S = 0.5  # between two moments that are compared


def measure(
    drive: Drive,
    videos: Videos,
    cameras: Mapping[str, Camera],
    clips: Mapping[str, Path],
    on_progress: Callable[[float], None] = lambda done: None,
    on_warning: Callable[[str], None] = lambda what: None,
) -> dict[str, DeliveredQuality]:
    """Measure all cameras whose video both sides recorded; see `each_camera`.

    clips  by camera, the clip that its source played; cameras not listed are compared with the stream as sent
    """

    def one(camera: Camera, video: CameraVideo) -> tuple[DeliveredQuality, list[str]]:
        return _camera(drive, camera, videos, video, clips.get(camera.name))

    return each_camera(drive, videos, cameras, one, on_progress, on_warning)


def cropped_by_view(drive: Drive) -> list[str]:
    """The cameras of which only what the driver saw was sent at some time."""
    states = drive.sides["operator"].of(VehicleState)
    return list(dict.fromkeys(name for state in states for name, own in state.cameras.items() if own.chosen))


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


def _camera(
    drive: Drive, camera: Camera, videos: Videos, video: CameraVideo, clip: Path | None
) -> tuple[DeliveredQuality, list[str]]:
    """The quality of one camera, and lines about what its files lack."""
    vehicle, captured, whole = drive.sides["vehicle"], video.captured, video.showing(camera.full_roi)
    filed = [unit for unit in video.units if unit not in video.absent]
    moments = _moments(captured, filed, last_sample_ns(drive.sides["operator"]), whole)
    numbers = displayed_units(moments, video.units, round(DEADLINE_S * SECOND_NS))
    displayed = [(moment, video.units[number]) for moment, number in zip(moments, numbers, strict=True) if number >= 0]
    pairs = [(moment, unit.captured) for moment, unit in displayed if unit not in video.absent]
    pairs = [(moment, displayed) for moment, displayed in pairs if displayed in whole]
    size = (camera.width, camera.height)
    scene_at = lookup(scenes(camera, videos, video.sent, [moment for moment, _ in pairs], clip, size))
    meter = metric().meter(size, camera.fps)
    shown = videos.pictures(video.shown, size) if pairs else ()
    for number, picture in at_captures([displayed for _, displayed in pairs], shown):
        if (scene := scene_at(pairs[number][0])) is not None:
            meter.add(number, scene.luma, picture.luma)
    scores = meter.close()
    began = round(vehicle.began_s * SECOND_NS)
    unknown = [(moment - began) / SECOND_NS for moment, unit in displayed if unit in video.absent]
    stale = [moment - displayed > SAME_NS for moment, displayed in pairs]
    found = DeliveredQuality(
        t=tuple((pairs[number][0] - began) / SECOND_NS for number in scores),
        mssim=tuple(scores.values()),
        stale=sum(stale) / len(stale) if stale else 0.0,
        clip=clip is not None,
    )
    return found, list(lacking(len(displayed), unknown, *video.ends(began)))


def lacking(moments: int, unknown: Sequence[float], sent_end: float, received_end: float) -> Iterator[str]:
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


def at_captures(captures: Sequence[int], pictures: Iterable[tuple[int, T]]) -> Iterator[tuple[int, T]]:
    """By index, the pictures with these capture times; where the decoder dropped it, the last one before it.

    captures  ns, never decreasing, as are those of the pictures
    """
    waiting = deque(enumerate(captures))
    last: T | None = None
    for ns, picture in pictures:
        while waiting and last is not None and waiting[0][1] < ns:
            yield waiting.popleft()[0], last
        last = picture
    while waiting and last is not None:
        yield waiting.popleft()[0], last


def last_sample_ns(operator: Side) -> int:
    """Time of the operator's last sample, ns since 1970 by the vehicle's clock."""
    return round((operator.began_s + max((sample.t for sample in operator.of(Sample)), default=0.0)) * SECOND_NS)


def _moments(sent: Sequence[int], units: Sequence[UnitTimes], until: int, whole: Collection[int]) -> list[int]:
    """Capture times of the vehicle's pictures, EVERY_S apart, from the first one received until the operator's end."""
    found: list[int] = []
    for ns in sent:
        in_time = units and units[0].captured <= ns <= until - DEADLINE_S * SECOND_NS
        if in_time and ns in whole and (not found or ns - found[-1] >= EVERY_S * SECOND_NS):
            found.append(ns)
    return found
