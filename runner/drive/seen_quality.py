"""Quality of what the driver saw: what windows displayed of each camera, at px of the screen.

Every half second, the picture on the screen is the newest one that had arrived by then. It is compared with the scene
at its capture: both are cropped and scaled as the page does it, what was not sent is black. How old the picture was is
a figure of its own: compared with the scene at the moment, a late picture would look best small and blurred.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from itertools import accumulate
from pathlib import Path
from typing import NamedTuple

import numpy as np

from runner.core.model import Camera
from runner.core.view import Seen
from runner.drive.captures import SAME_NS, UnitTimes
from runner.drive.delivered import EVERY_S, at_captures, lacking, last_sample_ns
from runner.drive.read import Drive
from runner.drive.scenes import lookup, scenes
from runner.drive.seen_file import Ages, Scores, SeenCamera
from runner.drive.videos import CameraVideo, Picture, Videos, each_camera
from runner.drive.views import Views, seen_of
from runner.rate_quality.metrics.interface import Luma, Metric, PictureSize, QualityMeter
from runner.rate_quality.screen import Kernel, on_screen
from runner.records.decisions import CameraDecision, DecisionMade
from runner.settings import FROZEN_INTERVALS, FROZEN_MS
from runner.system.clocks import SECOND_NS

AGE_EVERY_NS = 10_000_000  # between two looks at the age of a picture


class Looks(NamedTuple):
    """How a drive is looked at.

    metrics  that score pictures
    late_ms  age on arrival above which the page marks a picture as late
    kernel   by which the page enlarges pictures
    """

    views: Views
    metrics: Sequence[Metric]
    late_ms: float
    kernel: Kernel = "linear"


def measure_seen(
    drive: Drive,
    videos: Videos,
    cameras: Mapping[str, Camera],
    clips: Mapping[str, Path],
    looks: Looks,
    on_progress: Callable[[float], None] = lambda done: None,
    on_warning: Callable[[str], None] = lambda what: None,
) -> dict[str, SeenCamera]:
    """Measure what was seen of all cameras whose video both sides recorded; see `each_camera`.

    clips  by camera, the clip that its source played; cameras not listed are compared with the stream as sent
    """

    def one(camera: Camera, video: CameraVideo) -> tuple[SeenCamera, list[str]]:
        return _camera(drive, camera, videos, video, looks, clips.get(camera.name))

    return each_camera(drive, videos, cameras, one, on_progress, on_warning)


class _Look(NamedTuple):
    """What is on the screen of a camera at a moment.

    at    ns since 1970 by the vehicle's clock
    unit  that is displayed; None: the vehicle sends nothing
    """

    at: int
    seen: Seen
    unit: UnitTimes | None


def _camera(
    drive: Drive, camera: Camera, videos: Videos, video: CameraVideo, looks: Looks, clip: Path | None
) -> tuple[SeenCamera, list[str]]:
    began = round(drive.sides["vehicle"].began_s * SECOND_NS)
    until = last_sample_ns(drive.sides["operator"])
    sent = _Decided.of(drive, camera)
    found = list(_looks(camera, video.units, looks.views, sent, began, until))
    filed = [look for look in found if look.unit and look.unit not in video.absent]
    scores = _scores(camera, videos, video, looks, filed, clip)
    unknown = [(look.at - began) / SECOND_NS for look in found if look.unit in video.absent]

    def scored(metric: Metric) -> Scores:
        known = scores[metric.name]
        return tuple(known.get((each.unit.captured, each.seen)) if each.unit else 0.0 for each in found)

    camera_seen = SeenCamera(
        t=tuple(round((look.at - began) / SECOND_NS, 3) for look in found),
        px=tuple(look.seen.screen_width * look.seen.screen_height for look in found),
        scores={metric.name: scored(metric) for metric in looks.metrics},
        age=_ages(camera, video.units, looks, sent, began, until),
        scene=clip is not None,
    )
    return camera_seen, list(lacking(len(found), unknown, *video.ends(began)))


@dataclass(frozen=True, slots=True)
class _Decided:
    """How a camera was sent over time: since when, ns, each decision is in force."""

    since: Sequence[int]
    decisions: Sequence[CameraDecision]

    @classmethod
    def of(cls, drive: Drive, camera: Camera) -> _Decided:
        vehicle = drive.sides["vehicle"]
        lines = [line for line in vehicle.of(DecisionMade) if camera.name in line.cameras]
        since = [round((vehicle.began_s + line.t) * SECOND_NS) for line in lines]
        return cls(since, [line.cameras[camera.name] for line in lines])

    def at(self, ns: int) -> CameraDecision | None:
        number = bisect_right(self.since, ns) - 1
        return self.decisions[number] if number >= 0 else None


def _looks(
    camera: Camera, units: Sequence[UnitTimes], views: Views, sent: _Decided, began: int, until: int
) -> Iterator[_Look]:
    """Every EVERY_S, from the first picture to the operator's end, while the camera is on and on the screen."""
    arrived, newest = _newest(units)
    step = round(EVERY_S * SECOND_NS)
    for at in range(began, until + 1, step):
        number, view, decision = bisect_right(arrived, at) - 1, views.at((at - began) / SECOND_NS), sent.at(at)
        if number < 0 or not view or decision is None or not decision.on:
            continue
        seen = seen_of(view, camera)
        if not seen.is_empty and seen.screen_width and seen.screen_height:
            yield _Look(at, seen, newest[number] if decision.sending else None)


def _newest(units: Sequence[UnitTimes]) -> tuple[list[int], list[UnitTimes]]:
    """Times at which pictures arrived, ns, and the newest picture from each of them on."""
    order = sorted(units, key=lambda unit: unit.arrived)
    return [unit.arrived for unit in order], list(accumulate(order, max))


# --- scores -----------------------------------------------------------------------------------------------------------

_Key = tuple[int, Seen]  # a picture, by the time of its capture, ns, as it was seen


def _scores(
    camera: Camera,
    videos: Videos,
    video: CameraVideo,
    looks: Looks,
    found: Sequence[_Look],
    clip: Path | None,
) -> dict[str, dict[_Key, float]]:
    """By metric, the score of each picture as it was seen, unless no file has it or its scene is unknown."""
    scored = {(look.unit.captured, look.seen) for look in found if look.unit}
    # A metric that also compares neighbouring pictures gets the one before each.
    before = dict(zip(times := [unit.captured for unit in video.units], [0, *times], strict=False))
    shown = scored | {(before[captured], seen) for captured, seen in scored if before[captured]}
    by_capture: dict[int, list[Seen]] = {}
    for captured, seen in sorted(shown, key=lambda key: key[0]):
        by_capture.setdefault(captured, []).append(seen)
    captures = list(by_capture)
    of_sent = _nearest(sorted(video.captured), captures)
    scene_at = lookup(scenes(camera, videos, video.sent, [ns for ns in of_sent if ns is not None], clip))
    meters = _Meters(looks.metrics, looks.kernel, camera.fps, scored, by_capture)
    try:
        for number, picture in at_captures(captures, videos.pictures(video.shown) if captures else ()):
            sent = of_sent[number]
            scene = None if sent is None else scene_at(sent)
            if scene is not None:
                meters.add(captures[number], scene, picture)
    finally:
        meters.close()
    return meters.scores


def _nearest(sent: Sequence[int], captures: Sequence[int]) -> list[int | None]:
    """By picture that arrived, the capture time of the one that was sent: that of a damaged one is inexact."""
    found: list[int | None] = []
    for ns in captures:
        at = bisect_left(sent, ns)
        nearest = min(sent[max(0, at - 1) : at + 1], key=lambda each: abs(each - ns), default=None)
        found.append(nearest if nearest is not None and abs(nearest - ns) <= SAME_NS else None)
    return found


@dataclass
class _Meters:
    """A meter for each metric and size on the screen, which lives until the last picture of that size.

    scored      what is to be scored
    by_capture  what is added, by capture time in ns, ascending
    """

    metrics: Sequence[Metric]
    kernel: Kernel
    fps: Fraction
    scored: set[_Key]
    by_capture: Mapping[int, Sequence[Seen]]
    scores: dict[str, dict[_Key, float]] = field(init=False)
    _open: dict[tuple[str, PictureSize], tuple[QualityMeter, list[_Key]]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.scores = {metric.name: {} for metric in self.metrics}
        self._last = {_size(seen): captured for captured, each in self.by_capture.items() for seen in each}

    def add(self, captured: int, scene: Picture, picture: Picture) -> None:
        for seen in self.by_capture[captured]:
            key, size = (captured, seen), _size(seen)
            wanted = [m for m in self.metrics if min(size) >= m.smallest_px and (m.every_frame or key in self.scored)]
            if not wanted:
                continue
            both = _displayed(scene, seen, self.kernel), _displayed(picture, seen, self.kernel)
            for metric in wanted:
                meter, keys = self._meter(metric, size)
                meter.add(len(keys), *both)
                keys.append(key)
        for size in [size for _, size in self._open if self._last[size] <= captured]:
            self._end(size)

    def close(self) -> None:
        for _, size in list(self._open):
            self._end(size)

    def _meter(self, metric: Metric, size: PictureSize) -> tuple[QualityMeter, list[_Key]]:
        if (metric.name, size) not in self._open:
            self._open[metric.name, size] = metric.meter(size, self.fps), []
        return self._open[metric.name, size]

    def _end(self, size: PictureSize) -> None:
        for name, its in [key for key in self._open if key[1] == size]:
            meter, keys = self._open.pop((name, its))
            found = {keys[number]: score for number, score in meter.close().items()}
            self.scores[name] |= {key: score for key, score in found.items() if key in self.scored}


def _size(seen: Seen) -> PictureSize:
    return seen.screen_width, seen.screen_height


def _displayed(picture: Picture, seen: Seen, kernel: Kernel) -> Luma:
    return np.ascontiguousarray(on_screen(picture.luma, picture.region, seen, kernel))


# --- ages -------------------------------------------------------------------------------------------------------------


def _ages(
    camera: Camera, units: Sequence[UnitTimes], looks: Looks, sent: _Decided, began: int, until: int
) -> Ages | None:
    """How old the picture on the screen was while the camera was sent, a hundred times a second."""
    times, newest = _newest(units)
    if not times:
        return None
    at = np.arange(times[0], until, AGE_EVERY_NS)
    since = [began + round(t * SECOND_NS) for t in looks.views.t]
    is_seen = [bool(view) and not seen_of(view, camera).is_empty for view in looks.views.views]
    is_sent = [decision.sending for decision in sent.decisions]
    at = at[_held(at, since, is_seen) & _held(at, sent.since, is_sent)]
    if not at.size:
        return None
    arrived, number = np.array(times), np.searchsorted(times, at, "right") - 1
    captured = np.array([unit.captured for unit in newest])[number]
    came = np.array([unit.arrived for unit in newest])[number]
    age_ms = (at - captured) / 1e6
    rates = [float(decision.fps or camera.fps) for decision in sent.decisions]
    limits_ms = _held(at, sent.since, [max(FROZEN_MS, 1000 * FROZEN_INTERVALS / rate) for rate in rates])
    frozen = (at - arrived[number]) / 1e6 > limits_ms
    late = ~frozen & ((came - captured) / 1e6 > looks.late_ms)
    mean_ms, p95_ms = float(age_ms.mean()), float(np.percentile(age_ms, 95))
    return Ages(round(mean_ms, 1), round(p95_ms, 1), round(float(frozen.mean()), 4), round(float(late.mean()), 4))


def _held(at: np.ndarray, since: Sequence[int], values: Sequence[float]) -> np.ndarray:
    """At each time, the value in force; False, or 0, before the first."""
    return np.array([False, *values])[np.searchsorted(np.array(since, dtype=np.int64), at, "right")]
