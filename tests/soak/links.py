"""Random links: whatever came before, a link that is steady again is used within 10 s.

Frames of all cameras pass a queue packet by packet, and the belief about the uplink decides how large they are. The
link first changes at random: rates, none at all, losses, predictions of any value. Then its rate stays the same. Where
packets were lost without a queue, as a policer loses them, more is tried more slowly.
"""

from __future__ import annotations

import heapq
import math
import random
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import count
from statistics import fmean

from soak import batches

from runner.core import belief, evidence
from runner.core.evidence import REPORT_S, LinkReport, ReceivedUnit
from runner.simulation.queues import RateQueue
from runner.simulation.steps import Steps

LINKS, BATCH = 10_000, 100
STEADY_S, LOSSY_S, AT_LEAST = 10.0, 25.0, 0.8  # from a steady rate on, until the total is at this share of it
MEAN_S = 2.0  # over which the total is averaged then
NARROWEST_KBPS, MOST_KBPS = 200.0, 33_000.0
PACKET = 1200
ONE_WAY_S = 0.015


def soak(seed: int, scale: float) -> list[str]:
    return batches.problems(link, "links", seed, LINKS, scale, BATCH)


def link(seed: int) -> str:
    """A drive over one random link; returns the problem, "" if there is none."""
    rng = random.Random(seed)
    drive = Drive(rng)
    for t, total in drive.totals():
        if not 0 < total <= MOST_KBPS:
            return f"{total} kbit/s at {t:.2f} s"
    reached = fmean(total for t, total in drive.decided if t > drive.end_s - MEAN_S)
    if reached < AT_LEAST * drive.kbps:
        return f"{reached:.0f} of {drive.kbps:.0f} kbit/s, {drive.end_s - drive.well_s:g} s after all was well"
    return ""


@dataclass
class Drive:
    """kbps  the steady rate at the end"""

    rng: random.Random
    decided: list[tuple[float, float]] = field(default_factory=list)

    def __post_init__(self) -> None:
        rng = self.rng
        self.cameras, self.fps = rng.randrange(1, 9), rng.choice((10, 15, 30))
        self.well_s = rng.uniform(2, 20)
        self.lossy = rng.choice((0.0, 0.0, rng.uniform(0, 0.1)))
        self.end_s = self.well_s + STEADY_S
        self.kbps = math.exp(rng.uniform(math.log(NARROWEST_KBPS), math.log(12_000)))
        times = [0.0, *sorted(rng.uniform(0, self.well_s) for _ in range(rng.randrange(12))), self.well_s]
        rates = [rng.choice((0.0, math.exp(rng.uniform(2, 10)))) for _ in times[:-1]] + [self.kbps]
        self.queue = RateQueue(Steps(times, rates), rng.choice((200, 300, 1000)))  # ms: a frame fits
        self.predicted = self._predictions()

    def _predictions(self) -> Callable[[float], float | None]:
        """None, right in the end, or wrong by a factor all the time."""
        rng = self.rng
        kind, factor = rng.choice(("none", "random", "wrong")), math.exp(rng.uniform(-1, 1))
        values = [math.exp(rng.uniform(0, 11)) for _ in range(int(self.well_s) + 1)]
        if kind == "none":
            return lambda t: None
        if kind == "wrong":
            return lambda t: factor * self.kbps
        return lambda t: values[int(t)] if t < self.well_s else self.kbps

    def totals(self) -> Iterator[tuple[float, float]]:
        """The total after each report, until the end."""
        known = belief.begin(0.0, 0.5 * (self.predicted(0.0) or MOST_KBPS), MOST_KBPS, self.predicted(0.0))
        memory, total, order = evidence.EvidenceMemory(), known.total, count()
        frame_s = 1 / self.fps
        waiting = [(frame_s * n / self.cameras, next(order), n) for n in range(self.cameras)]
        report_at, arriving, missing = REPORT_S, list[tuple[float, int, ReceivedUnit, int]](), 0
        while report_at < self.end_s:
            while waiting[0][0] < report_at:
                t, _, camera = heapq.heappop(waiting)
                heapq.heappush(waiting, (t + frame_s, next(order), camera))
                unit, packets, lost = self._send(t, camera, total)
                missing += lost
                if unit:
                    heapq.heappush(arriving, (unit.arrived, next(order), unit, packets))
            units, packets = [], 0
            while arriving and arriving[0][0] <= report_at:
                _, _, unit, of_unit = heapq.heappop(arriving)
                units.append(unit)
                packets += of_unit
            report = LinkReport(report_at, tuple(units), packets, missing if units else 0)
            missing = 0 if units else missing
            t = report_at + ONE_WAY_S
            memory, seen = evidence.observe(memory, report)
            known = belief.predict(known, t, self.predicted(t))
            if seen:
                known = belief.observe(known, t, seen, 2 * ONE_WAY_S)
            known = belief.decide(known, t, seen.silent_s if seen else 0.0)
            total = known.total
            self.decided.append((t, total))
            if known.policer.kbps < math.inf and t > self.well_s:
                self.end_s = self.well_s + LOSSY_S
            yield t, total
            report_at += REPORT_S

    def _send(self, t: float, camera: int, total: float) -> tuple[ReceivedUnit | None, int, int]:
        """A frame over the link: what arrives of it, and its packets received and lost."""
        size = max(1, round(total * 125 / self.fps / self.cameras * self.rng.uniform(0.85, 1.15)))
        lossy = self.lossy if t < self.well_s else 0.0
        arrived = list[tuple[float, int]]()
        packets = [min(PACKET, size - begin) for begin in range(0, size, PACKET)]
        for each in packets:
            left = self.queue.put(t, each)
            if left is not None and self.rng.random() >= lossy:
                arrived.append((left + ONE_WAY_S, each))
        if not arrived:
            return None, 0, len(packets)
        first, last = arrived[0][0], arrived[-1][0]
        size, whole = sum(each for _, each in arrived), len(arrived) == len(packets)
        train = size - arrived[0][1]
        unit = ReceivedUnit(
            f"camera {camera}", t, last, size, whole, train_s=last - first if train else 0.0, train=train
        )
        return unit, len(arrived), len(packets) - len(arrived)
