"""Turns counters into figures for the operator: rates over the last second, and a summary of a run. Pure."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field
from statistics import median
from typing import TYPE_CHECKING

from msgspec import UNSET

from runner.records.vehicle import CameraState

if TYPE_CHECKING:
    from runner.apply import Reception

WINDOW_S = 1.0
MOST_WINDOWS = 10_800  # three hours: a side may run for weeks
SETTLE_S = 1.5  # what a window is compared with must be older: window length plus settling of the rate control


@dataclass(frozen=True, slots=True)
class MeasuredRates:
    """Frames per second and kbit/s over the last second."""

    fps: float = 0.0
    kbps: float = 0.0


@dataclass
class ReceptionMeter:
    """Watches one camera: rates over a sliding window, and how well reception follows the decisions.

    fps       the camera's own, where the vehicle states no other
    followed  kbit/s received over kbit/s allocated, one entry per window in which this was settled, of the last
              MOST_WINDOWS; likewise latencies_ms, of all windows
    windows   in which pictures were to come, at a settled rate; sized: whose size was settled. The bitrate may change
              more often than it settles
    """

    fps: float
    followed: deque[float] = field(default_factory=lambda: deque(maxlen=MOST_WINDOWS))
    latencies_ms: deque[float] = field(default_factory=lambda: deque(maxlen=MOST_WINDOWS))
    sizes: dict[tuple[int, int], int] = field(default_factory=dict)  # decided sizes that were received, with counts
    short: int = 0  # windows with too few frames for the camera's rate
    windows: int = 0
    sized: int = 0
    _past: deque[tuple[float, Reception]] = field(default_factory=deque)
    _decided: dict[str, tuple[object, float]] = field(default_factory=dict)  # by part, what, and since when
    _counted: float = 0.0

    def add(self, t: float, counters: Reception, decided: CameraState | None) -> MeasuredRates:
        """Add a sample of the counters at time t, s; a few times a second."""
        for part, value in _parts(decided).items():
            if part not in self._decided or self._decided[part][0] != value:
                self._decided[part] = value, t
        self._past.append((t, counters))
        while len(self._past) > 2 and self._past[1][0] <= t - WINDOW_S:
            self._past.popleft()
        rates = self._rates()
        # Overlapping windows would count the same frames again.
        if decided and decided.sending and self._is_settled("rate", t) and t - self._counted >= WINDOW_S:
            self._counted = t
            self._compare(t, rates, counters, decided)
        return rates

    def _is_settled(self, part: str, t: float) -> bool:
        return t - self._decided[part][1] >= SETTLE_S

    def _rates(self) -> MeasuredRates:
        (t0, first), (t1, last) = self._past[0], self._past[-1]
        if t1 <= t0:
            return MeasuredRates()
        return MeasuredRates(
            (last.frames - first.frames) / (t1 - t0), (last.bytes - first.bytes) * 8 / 1000 / (t1 - t0)
        )

    def _compare(self, t: float, rates: MeasuredRates, counters: Reception, decided: CameraState) -> None:
        self.windows += 1
        self.short += rates.fps < 0.9 * (self.fps if decided.fps is UNSET else decided.fps)
        if self._is_settled("size", t):
            self.sized += 1
            size = (counters.width, counters.height)
            if size == (decided.width, decided.height):
                self.sizes[size] = self.sizes.get(size, 0) + 1
            if self._is_settled("bitrate", t):
                self.followed.append(rates.kbps / decided.kbps)
        if counters.latency_ms is not None:
            self.latencies_ms.append(counters.latency_ms)


def _parts(decided: CameraState | None) -> dict[str, object]:
    """What is decided of a camera, in parts that change by themselves."""
    if decided is None:
        return {"rate": None, "size": None, "bitrate": None}
    rate, size = (decided.sending, decided.fps), (decided.width, decided.height)
    return {"rate": rate, "size": size, "bitrate": decided.kbps}


def percentile(values: Iterable[float], share: float) -> float | None:
    """The value below which a share of all values are; None if there are none."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))] if ordered else None


def middle(values: Collection[float]) -> float | None:
    return median(values) if values else None
