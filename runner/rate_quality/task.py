"""The unit of work: some lanes of one camera, encoded, decoded and scored in whichever process this runs."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING

from runner.core.model import Roi
from runner.errors import RunError
from runner.lanes import Lane, LaneSet
from runner.rate_quality.curves import Point

if TYPE_CHECKING:
    from runner.rate_quality.metrics import Luma, Mask, Metric, QualityMeter

SAME_S = 1e-4  # by which times may be rounded
OVERHEAD = 0.1  # cost of decoding and scoring a lane of any size, in encodings at full size


@dataclass(frozen=True, slots=True)
class Task:
    """The unit of work: some lanes of one camera, decoded once. Can be sent to other processes and machines.

    roi     part of the sequence's picture that is encoded
    frames  of the sequence
    stride  the metrics score every stride-th frame
    """

    lanes: tuple[Lane, ...]
    compiled: LaneSet
    roi: Roi
    frames: int
    stride: int
    metrics: tuple[Metric, ...]
    mask: Mask | None

    def scored(self, frame: int) -> bool:
        """Whether a frame is scored: starts in the middle of the first stride, since the first picture is atypical."""
        return frame % self.stride == self.stride // 2

    @property
    def cost(self) -> float:
        """Cost, in encodings at full size."""
        return sum(OVERHEAD + float(lane.scaling) ** 2 for lane in self.lanes)


class Cancelled(Exception):
    """The user has cancelled."""


def run_task(task: Task, on_progress: Callable[[float], None] = lambda share: None) -> list[Point]:
    """Encode, decode and score all lanes of a task.

    on_progress  called with the share done, a few times a second; an exception that it raises ends the task
    raises  RunError
    """
    from runner.apply import run_lanes

    scoring = [_Scoring(task, number) for number in range(len(task.lanes))]
    references = _References(task)
    try:
        encoded = run_lanes(
            task.compiled,
            references.put,
            lambda lane, frame, luma: scoring[lane].take(frame, luma, references),
            lambda frames: on_progress(frames / task.frames),
        )
        for one in scoring:
            one.finish(references)
        seconds = float(task.frames / task.compiled.fps)
        return [
            Point(
                scaling=lane.scaling,
                target_kbps=lane.kbps,
                actual_kbps=round(_kbps(sum(size for _, size in result.sent), seconds), 2),
                second_kbps=round(_kbps(_most_at_once(result.sent), min(1.0, seconds)), 2),
                encode_ms=round(1000 * result.encode_s / max(1, result.frames), 4),
                scores=one.close(),
            )
            for lane, result, one in zip(task.lanes, encoded, scoring, strict=True)
        ]
    except RunError as error:
        lanes = ", ".join(f"{float(lane.scaling):g} at {lane.kbps} kbit/s" for lane in task.lanes)
        raise RunError(f"encoding {lanes}: {error}") from None
    finally:
        for one in scoring:
            with suppress(RunError):
                one.close()


def _kbps(size: int, seconds: float) -> float:
    return 8 * size / 1000 / seconds


def _most_at_once(sent: Sequence[tuple[float, int]]) -> int:
    """Bytes of the second with the most. sent: times, s, and bytes."""
    size = most = begin = 0
    for at, new in sent:
        size += new
        while sent[begin][0] <= at - 1 + SAME_S:
            size -= sent[begin][1]
            begin += 1
        most = max(most, size)
    return most


class _References:
    """Frames of the sequence that are still needed for comparison with a lane."""

    def __init__(self, task: Task) -> None:
        self._task = task
        self._lock = threading.Lock()
        self._kept: dict[int, tuple[Luma, int]] = {}  # frame: picture, number of lanes that still need it
        self.every = any(metric.every_frame for metric in task.metrics)

    def is_needed(self, frame: int) -> bool:
        return self.every or self._task.scored(frame)

    def put(self, frame: int, luma: Luma) -> None:
        import numpy as np

        if not self.is_needed(frame):
            return
        roi = self._task.roi
        part = np.ascontiguousarray(luma[roi.y : roi.y + roi.height, roi.x : roi.x + roi.width])
        with self._lock:
            self._kept[frame] = (part, len(self._task.lanes))

    def take(self, frame: int) -> Luma:
        """The frame; to be called once by each lane."""
        with self._lock:
            luma, left = self._kept.pop(frame)
            if left > 1:
                self._kept[frame] = (luma, left - 1)
        return luma


class _Scoring:
    """Scores of one lane. A frame that the encoder dropped shows the previous picture, as on a screen."""

    def __init__(self, task: Task, number: int) -> None:
        size = (task.roi.width, task.roi.height)
        self._task, self._size, self._lane = task, size, task.lanes[number]
        self._meters: dict[str, QualityMeter] = {
            metric.name: metric.meter(size, task.compiled.fps, task.stride, task.mask) for metric in task.metrics
        }
        self._every = {metric.name: metric.every_frame for metric in task.metrics}
        self._shown: Luma | None = None
        self._next = 0

    def take(self, frame: int, luma: Luma, references: _References) -> None:
        """Score a decoded picture."""
        self._fill(frame, references)
        self._shown = luma
        self._fill(frame + 1, references)

    def finish(self, references: _References) -> None:
        self._fill(self._task.frames, references)

    def close(self) -> dict[str, tuple[float, ...]]:
        """By metric, the scores of the sampled frames in order."""
        found = {name: meter.close() for name, meter in self._meters.items()}
        return {name: tuple(scores[frame] for frame in sorted(scores)) for name, scores in found.items()}

    def _fill(self, end: int, references: _References) -> None:
        """Score all frames before `end` with the picture on the screen."""
        for frame in range(self._next, end):
            if references.is_needed(frame):
                self._score(frame, references.take(frame))
        self._next = max(self._next, end)

    def _score(self, frame: int, reference: Luma) -> None:
        if self._shown is None:
            raise RunError("the encoder dropped the first frame")
        picture = _enlarged(self._shown, self._size)
        for name, meter in self._meters.items():
            if self._every[name] or self._task.scored(frame):
                meter.add(frame, reference, picture)


def _enlarged(luma: Luma, size: tuple[int, int]) -> Luma:
    """A decoded picture at its original size, bicubic (paper, section III)."""
    import cv2
    import numpy as np

    cv2.setNumThreads(1)  # lanes already run in parallel
    if luma.shape == size[::-1]:
        return np.ascontiguousarray(luma)
    enlarged: Luma = cv2.resize(luma, size, interpolation=cv2.INTER_CUBIC)  # type: ignore[assignment]
    return enlarged
