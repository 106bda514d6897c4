"""Measure the points that a plan requests: tasks for an executor, results cached by content."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from fractions import Fraction
from typing import TYPE_CHECKING

from runner.core.model import Roi
from runner.errors import RunError
from runner.graph import Plan
from runner.lanes import Lane, compile_lanes, fragment
from runner.rate_quality.cache import Cache, digest, point_from_json, point_to_json
from runner.rate_quality.curves import Point
from runner.rate_quality.sequence import Sequence as Clip
from runner.rate_quality.task import Cancelled, Task, run_task

if TYPE_CHECKING:
    from runner.rate_quality.metrics import Mask, Metric

LANES_VERSION = 4  # increment with every change that affects points
PIXELS_AT_ONCE = 16_000_000  # in the lanes of all tasks together, which keeps memory below 2 GB


@dataclass
class Sweep:
    """Measures points of one camera's sequence.

    plan     the camera at the size and rate of the sequence
    name     of the camera, for progress
    encoder  versions of the encoding software: part of a point's cache key
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

    def measure(self, lanes: Sequence[Lane], on_progress: Callable[[float], None]) -> list[Point]:
        """Points of some lanes, from the cache or measured; each is stored as soon as its task is done.

        lanes        all of them of the same n-th pictures
        on_progress  called with the share of the work that is done, never decreasing
        raises  RunError; points finished by then stay in the cache
        """
        of = {(lane.scaling, lane.kbps): lane for lane in lanes}
        points = [point for lane in lanes if (point := self._cached(lane))]
        self.found += len(points)
        known = {(point.scaling, point.target_kbps) for point in points}
        missing = [lane for lane in lanes if (lane.scaling, lane.kbps) not in known]
        for point in self._run(self._tasks(missing), on_progress):
            key = self._key(of[point.scaling, point.target_kbps])
            self.cache.store(key, self._json(point, key))
            points.append(point)
            self.encoded += 1
        return points

    def _run(self, tasks: list[Task], on_progress: Callable[[float], None]) -> Iterator[Point]:
        """Points as their tasks end.

        raises  RunError if a worker process dies
        """
        try:
            yield from self._points(tasks, on_progress)
        except BrokenExecutor:
            rule = "it may have run out of memory: choose a smaller `parallel`, or workers=threads"
            raise RunError(f"a worker process ended without a result; {rule}") from None

    def _points(self, tasks: list[Task], on_progress: Callable[[float], None]) -> Iterator[Point]:
        done = TaskProgress([task.cost for task in tasks], on_progress)
        own_process = isinstance(self.executor, ThreadPoolExecutor)
        futures: dict[Future[list[Point]], int] = {}
        for number, task in enumerate(tasks):
            callback = (lambda share, n=number: done.update(n, share),) if own_process else ()
            futures[self.executor.submit(run_task, task, *callback)] = number
        try:
            waiting = set(futures)
            while waiting:
                ended, waiting = wait(waiting, return_when=FIRST_COMPLETED)
                for future in ended:
                    number = futures.pop(future)  # a cluster frees results that nobody references
                    yield from future.result()
                    done.update(number, 1.0)
        finally:
            done.cancelled = True
            for future in futures:
                future.cancel()

    def _tasks(self, lanes: Sequence[Lane]) -> list[Task]:
        """Lanes in sets that share a decoder, none much more costly than those at full size alone."""
        by_factor: dict[Fraction, list[Lane]] = {}
        for lane in sorted(lanes, key=lambda lane: lane.scaling, reverse=True):
            by_factor.setdefault(lane.scaling, []).append(lane)
        tasks = [self._task(part) for group in by_factor.values() for part in self._in_memory(group)]
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

    def _in_memory(self, lanes: Sequence[Lane]) -> Iterator[Sequence[Lane]]:
        """Lanes of one factor in parts that run together: each encoder and decoder keeps several pictures."""
        pixels = self.roi.pixels * float(lanes[0].scaling) ** 2
        most = max(1, int(PIXELS_AT_ONCE / self.parallel / pixels))
        return (lanes[at : at + most] for at in range(0, len(lanes), most))

    def _task(self, lanes: Sequence[Lane]) -> Task:
        compiled = compile_lanes(self.plan, self.clip.decode, self.plan.camera.full_roi, lanes, self.clip.bag)
        return Task(tuple(lanes), compiled, self.roi, self.clip.frames, self.stride, self.metrics, self.mask)

    # --- cache keys ---------------------------------------------------------------------------------------------------

    def _key(self, lane: Lane) -> str:
        if lane not in self._keys:
            text = fragment(self.plan, self.plan.camera.full_roi, lane)
            parts = (*self.clip.identity, str(self.clip.fps), text, self.encoder, self.stride, self.mask_digest)
            self._keys[lane] = digest("point", LANES_VERSION, *parts)
        return self._keys[lane]

    def _cached(self, lane: Lane) -> Point | None:
        document = self.cache.load(self._key(lane))
        return None if document is None else point_from_json(lane.scaling, lane.kbps, document, self._identities)

    def _json(self, point: Point, key: str) -> dict[str, object]:
        before = self.cache.load(key) or {}
        document = point_to_json(point, self._identities)
        return document | {"scores": before.get("scores", {}) | document["scores"]}

    @property
    def _identities(self) -> dict[str, str]:
        return {metric.name: metric.identity for metric in self.metrics}


class TaskProgress:
    """The share done of several tasks; updated from any of their threads."""

    def __init__(self, costs: Sequence[float], on_progress: Callable[[float], None]) -> None:
        self._costs, self._shares, self._on_progress = costs, [0.0] * len(costs), on_progress
        self._lock = threading.Lock()
        self.cancelled = False

    def update(self, number: int, share: float) -> None:
        """raises Cancelled if the task is no longer needed"""
        if self.cancelled:
            raise Cancelled
        with self._lock:
            self._shares[number] = max(share, self._shares[number])
            done = sum(cost * share for cost, share in zip(self._costs, self._shares, strict=True))
            self._on_progress(done / sum(self._costs))
