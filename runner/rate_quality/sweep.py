"""Measure the points that a plan asks for: sets of lanes behind a standard executor, results kept by content."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor, wait
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from fractions import Fraction
from multiprocessing import get_context
from typing import TYPE_CHECKING

from runner.errors import RunError
from runner.graph import Plan
from runner.model import Roi
from runner.rate_quality.cache import Cache, digest, point_from_json, point_to_json
from runner.rate_quality.curves import Point
from runner.rate_quality.lanes import Lane, LaneSet, compile_lanes, fragment
from runner.rate_quality.sequence import Sequence as Clip

if TYPE_CHECKING:
    from runner.rate_quality.metrics import Luma, Mask, Meter, Metric

LANES_VERSION = 2  # raise it with every change that changes scores
SCHEDULER_S = 10  # a Dask scheduler that has not answered by then is not there
OVERHEAD = 0.1  # of an encoding at full size: what a lane costs whatever its size, decoding and looking at pictures


@dataclass(frozen=True, slots=True)
class Task:
    """The unit of work: some lanes of one camera, decoded once. Travels to other processes and machines.

    roi     part of the sequence's picture that is encoded
    frames  of the sequence
    stride  the metrics look at every so many frames
    """

    lanes: tuple[Lane, ...]
    compiled: LaneSet
    roi: Roi
    frames: int
    stride: int
    metrics: tuple[Metric, ...]
    mask: Mask | None

    def scored(self, frame: int) -> bool:
        """Whether a frame is scored: from the middle of the first stride on, since the very first picture is no sample
        of the others."""
        return frame % self.stride == self.stride // 2

    @property
    def cost(self) -> float:
        """In encodings at full size."""
        return sum(OVERHEAD + float(lane.scaling) ** 2 for lane in self.lanes)


class Cancelled(Exception):
    """The person has had enough."""


# --- one task, in whatever process it runs ----------------------------------------------------------------------------


def run_task(task: Task, told: Callable[[float], None] = lambda share: None) -> list[Point]:
    """Encode, decode and score all lanes of a task.

    told    the share that is done, a few times a second; what it raises ends the task
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
            lambda frames: told(frames / task.frames),
        )
        for one in scoring:
            one.finish(references)
        seconds = task.frames / task.compiled.fps
        return [
            Point(
                scaling=lane.scaling,
                target_kbps=lane.kbps,
                actual_kbps=round(8 * result.bytes / 1000 / float(seconds), 2),
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


class _References:
    """Frames of the sequence that a lane may still have to be compared with."""

    def __init__(self, task: Task) -> None:
        self._task = task
        self._lock = threading.Lock()
        self._kept: dict[int, tuple[Luma, int]] = {}  # frame: picture, lanes that have not asked for it yet
        self.every = any(metric.every_frame for metric in task.metrics)

    def wanted(self, frame: int) -> bool:
        return self.every or self._task.scored(frame)

    def put(self, frame: int, luma: Luma) -> None:
        import numpy as np

        if not self.wanted(frame):
            return
        roi = self._task.roi
        part = np.ascontiguousarray(luma[roi.y : roi.y + roi.height, roi.x : roi.x + roi.width])
        with self._lock:
            self._kept[frame] = (part, len(self._task.lanes))

    def take(self, frame: int) -> Luma:
        """To be asked once by each lane."""
        with self._lock:
            luma, left = self._kept.pop(frame)
            if left > 1:
                self._kept[frame] = (luma, left - 1)
        return luma


class _Scoring:
    """Scores of one lane. A frame that the encoder left out shows what was there before, as it does on a screen."""

    def __init__(self, task: Task, number: int) -> None:
        size = (task.roi.width, task.roi.height)
        self._task, self._size, self._lane = task, size, task.lanes[number]
        self._meters: dict[str, Meter] = {
            metric.name: metric.meter(size, task.compiled.fps, task.stride, task.mask) for metric in task.metrics
        }
        self._every = {metric.name: metric.every_frame for metric in task.metrics}
        self._shown: Luma | None = None
        self._next = 0

    def take(self, frame: int, luma: Luma, references: _References) -> None:
        """A decoded picture."""
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
        """Score all frames before `end` with what is on the screen."""
        for frame in range(self._next, end):
            if references.wanted(frame):
                self._score(frame, references.take(frame))
        self._next = max(self._next, end)

    def _score(self, frame: int, reference: Luma) -> None:
        if self._shown is None:
            raise RunError("the encoder leaves out the first frame")
        picture = _enlarged(self._shown, self._size)
        for name, meter in self._meters.items():
            if self._every[name] or self._task.scored(frame):
                meter.add(frame, reference, picture)


def _enlarged(luma: Luma, size: tuple[int, int]) -> Luma:
    """A decoded picture at its original size, bicubic (paper, section III)."""
    import cv2
    import numpy as np

    cv2.setNumThreads(1)  # lanes run beside each other anyway
    if luma.shape == size[::-1]:
        return np.ascontiguousarray(luma)
    enlarged: Luma = cv2.resize(luma, size, interpolation=cv2.INTER_CUBIC)  # type: ignore[assignment]
    return enlarged


# --- many tasks -------------------------------------------------------------------------------------------------------


@dataclass
class Sweep:
    """Measures points of one camera's sequence.

    plan     the camera at the form of the sequence
    name     of the camera, for progress
    encoder  versions of what encodes: part of what a point is kept by
    """

    name: str
    clip: Clip
    plan: Plan
    roi: Roi
    metrics: tuple[Metric, ...]
    stride: int
    mask: Mask | None
    mask_digest: str
    encoder: dict[str, str]
    cache: Cache
    executor: Executor
    parallel: int
    encoded: int = 0
    found: int = 0
    _keys: dict[Lane, str] = field(default_factory=dict)

    def measure(self, lanes: Sequence[Lane], told: Callable[[float], None]) -> list[Point]:
        """Points of some lanes, from the cache or measured; each is kept as soon as its task is done.

        told    the share of the work that is done, never falling
        raises  RunError; what is finished by then stays in the cache
        """
        points = [point for lane in lanes if (point := self._kept(lane))]
        self.found += len(points)
        have = {(point.scaling, point.target_kbps) for point in points}
        missing = [lane for lane in lanes if (lane.scaling, lane.kbps) not in have]
        for point in self._run(self._tasks(missing), told):
            self.cache.store(self._key(Lane(point.scaling, point.target_kbps)), self._json(point))
            points.append(point)
            self.encoded += 1
        return points

    def _run(self, tasks: list[Task], told: Callable[[float], None]) -> Iterator[Point]:
        """Points as their tasks end."""
        done = Done([task.cost for task in tasks], told)
        own_process = isinstance(self.executor, ThreadPoolExecutor)
        futures: dict[Future[list[Point]], int] = {}
        for number, task in enumerate(tasks):
            tell = (lambda share, n=number: done.tell(n, share),) if own_process else ()
            futures[self.executor.submit(run_task, task, *tell)] = number
        try:
            waiting = set(futures)
            while waiting:
                ended, waiting = wait(waiting, return_when=FIRST_COMPLETED)
                for future in ended:
                    yield from future.result()
                    done.tell(futures[future], 1.0)
        finally:
            done.cancelled = True
            for future in futures:
                future.cancel()

    def _tasks(self, lanes: Sequence[Lane]) -> list[Task]:
        """Lanes in sets that share their decoder, none much larger than the encodings at full size alone."""
        by_factor: dict[Fraction, list[Lane]] = {}
        for lane in sorted(lanes, key=lambda lane: lane.scaling, reverse=True):
            by_factor.setdefault(lane.scaling, []).append(lane)
        tasks = [self._task(group) for group in by_factor.values()]
        if not tasks:
            return []
        limit = max(tasks[0].cost, sum(task.cost for task in tasks) / (2 * self.parallel))
        sets: list[list[Lane]] = []
        for task in tasks:
            if sets and self._task(sets[-1]).cost + task.cost <= limit:
                sets[-1] += task.lanes
            else:
                sets.append(list(task.lanes))
        return [self._task(one) for one in sets]

    def _task(self, lanes: Sequence[Lane]) -> Task:
        compiled = compile_lanes(self.plan, self.clip.decode, self.plan.camera.full_roi, lanes)
        return Task(tuple(lanes), compiled, self.roi, self.clip.frames, self.stride, self.metrics, self.mask)

    # --- what a point is kept by --------------------------------------------------------------------------------------

    def _key(self, lane: Lane) -> str:
        if lane not in self._keys:
            text = fragment(self.plan, self.plan.camera.full_roi, lane)
            parts = (self.clip.sha256, str(self.clip.fps), text, self.encoder, self.stride, self.mask_digest)
            self._keys[lane] = digest("point", LANES_VERSION, *parts)
        return self._keys[lane]

    def _kept(self, lane: Lane) -> Point | None:
        document = self.cache.load(self._key(lane))
        return None if document is None else point_from_json(lane.scaling, lane.kbps, document, self._identities)

    def _json(self, point: Point) -> dict[str, object]:
        before = self.cache.load(self._key(Lane(point.scaling, point.target_kbps))) or {}
        document = point_to_json(point, self._identities)
        return document | {"scores": before.get("scores", {}) | document["scores"]}

    @property
    def _identities(self) -> dict[str, str]:
        return {metric.name: metric.identity for metric in self.metrics}


class Done:
    """How much of some tasks is done, told from any of their threads."""

    def __init__(self, costs: Sequence[float], told: Callable[[float], None]) -> None:
        self._costs, self._shares, self._told = costs, [0.0] * len(costs), told
        self._lock = threading.Lock()
        self.cancelled = False

    def tell(self, number: int, share: float) -> None:
        """raises Cancelled where nobody waits for the task any more"""
        if self.cancelled:
            raise Cancelled
        with self._lock:
            self._shares[number] = max(share, self._shares[number])
            done = sum(cost * share for cost, share in zip(self._costs, self._shares, strict=True))
            self._told(done / sum(self._costs))


def parallel_tasks(wanted: int | None) -> int:
    """How many tasks run at once on this machine; each has many threads of its own."""
    return wanted or max(1, (os.cpu_count() or 1) // 2)


@contextmanager
def open_executor(workers: str, scheduler: str | None, parallel: int) -> Iterator[Executor]:
    """Where tasks run.

    workers  threads or processes of this machine, or dask: a cluster
    raises   RunError where Dask is not installed or its scheduler does not answer
    """
    if workers == "dask":
        with _dask(scheduler, parallel) as executor:
            yield executor
        return
    # GStreamer's threads do not survive a fork.
    pool = ThreadPoolExecutor(parallel) if workers == "threads" else ProcessPoolExecutor(parallel, get_context("spawn"))
    try:
        yield pool
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


@contextmanager
def _dask(scheduler: str | None, parallel: int) -> Iterator[Executor]:
    """An executor on a cluster: tasks of a worker that is lost are run by another."""
    try:
        from distributed import Client, LocalCluster
    except ImportError:
        raise RunError("workers=dask needs Dask: pip install 'tod-runner[cluster]'") from None
    with ExitStack() as stack:
        try:
            own = {"n_workers": parallel, "threads_per_worker": 1, "dashboard_address": None}
            address = scheduler or stack.enter_context(LocalCluster(**own))
            client = stack.enter_context(Client(address, timeout=SCHEDULER_S))
        except OSError as error:
            raise RunError(f"the Dask scheduler {scheduler or ''} does not answer: {error}") from None
        yield client.get_executor()
