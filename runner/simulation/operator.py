"""What the operator's side receives: frames, lost packets and their repair, and its reception reports. Pure.

It stands for `runner.gst.arriving`, `runner.gst.repair` and `runner.operator.station`.
"""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import count
from operator import attrgetter
from typing import NamedTuple

from msgspec import UNSET

from runner.records.reception import Arrival, ReceptionReport, UnitReceived

RUN = 1  # of the operator's side
# As in runner.gst.arriving and runner.gst.repair, which this package cannot import.
TAIL_S, REORDER_S, ATTEMPTS = 0.010, 0.005, 3
INITIAL_RTT_S, LONGEST_WAIT_S = 0.1, 0.3
CONGESTED, CLEAR, DECAY, COUNTED_S = 0.15, 0.05, 0.75, 0.25
RETRY_S = 0.04  # rtpjitterbuffer's rtx-min-retry-timeout: a repetition that has not come is requested again


class Frame(NamedTuple):
    """A frame as it has arrived.

    begun, ended   (packets, bytes) of all cameras that had arrived with the first, and with the last of its packets
    packets        that arrived
    """

    camera: str
    arrival: Arrival
    begun: tuple[int, int]
    ended: tuple[int, int]
    packets: int


@dataclass
class Loss:
    """Packets of a frame that were lost.

    sizes     bytes of video of each
    due       until when they may arrive, s
    complete  when all had been repaired, s; None: not yet
    """

    camera: str
    captured: float
    sizes: list[int]
    due: float
    complete: float | None = None


_Known = tuple[float, int, Frame | int]  # when it is known, its number, and a frame or a count of lost packets


@dataclass
class _Damage:
    """Of a camera's picture: [since, until[, s."""

    since: float
    until: float


@dataclass
class Operator:
    """The operator's side.

    repairs_s  how long the vehicle keeps packets for retransmission; 0: there is none
    jitter_s   how long a missing packet is awaited at least
    wave_s     in which a refresh wave heals a picture
    """

    repairs_s: float
    jitter_s: float
    wave_s: float
    arrived: tuple[int, int] = (0, 0)  # packets and bytes of all cameras
    unrepaired: dict[str, int] = field(default_factory=dict)  # packets by camera that never came in time
    congested: bool = False  # so much is lost that repetitions are not requested
    rtt_s: float = INITIAL_RTT_S  # until the first repetition has arrived
    _known: list[_Known] = field(default_factory=list)  # a heap
    _order: count[int] = field(default_factory=count)
    _base_s: float | None = None  # that delays are less by
    _ended: tuple[int, int] | None = None  # of the newest unit reported
    _damages: dict[str, list[_Damage]] = field(default_factory=dict)
    _keys: dict[str, tuple[float, float]] = field(default_factory=dict)  # newest key frame: its capture and its arrival
    _telemetry: deque[tuple[float, float]] = field(default_factory=deque)  # (arrival, sent) of what is on its way
    _vehicle_s: tuple[float, float] | None = None  # of the newest one that has arrived
    _recent: tuple[float, float] = (0.0, 0.0)  # received and missing packets, decaying
    _counted: tuple[int, int] = (0, 0)
    _counted_at: float = 0.0
    _totals: tuple[int, int] = (0, 0)

    def frame(self, frame: Frame, known: float) -> None:
        """A frame that is known at a time: with its last packet, or a while after the last one that came."""
        heapq.heappush(self._known, (known, next(self._order), frame))

    def missing(self, packets: int, known: float) -> None:
        """Packets whose absence is noticed at a time."""
        heapq.heappush(self._known, (known, next(self._order), packets))

    def telemetry(self, arrival: float, sent: float) -> None:
        self._telemetry.append((arrival, sent))

    def wait_s(self) -> float:
        """How long a missing packet is awaited."""
        repairs = self.repairs_s and not self.congested
        return max(self.jitter_s, min(LONGEST_WAIT_S, self.jitter_s + (ATTEMPTS * self.rtt_s if repairs else 0.0)))

    def key_frame(self, camera: str, captured: float, arrival: float) -> None:
        """A whole key frame arrives: it heals what was lost before it."""
        self._keys[camera] = (captured, arrival)
        for damage in self._damages.get(camera, ()):
            damage.until = min(damage.until, max(damage.since, arrival))

    def damage(self, loss: Loss) -> None:
        """A loss that was not repaired in time damages pictures until a key frame or a refresh wave has passed."""
        self.unrepaired[loss.camera] = self.unrepaired.get(loss.camera, 0) + max(1, len(loss.sizes))
        captured, arrival = self._keys.get(loss.camera, (-1.0, 0.0))
        until = max(loss.due, arrival) if captured > loss.captured else loss.due + self.wave_s
        self._damages.setdefault(loss.camera, []).append(_Damage(loss.due, until))

    def damaged_s(self, now: float) -> dict[str, float]:
        """By camera, for how long its picture was damaged by now; overlaps count once."""
        found = {}
        for camera, damages in self._damages.items():
            total, end = 0.0, 0.0
            for one in sorted(damages, key=lambda damage: damage.since):
                total += max(0.0, min(now, one.until) - max(end, one.since))
                end = max(end, one.until)
            found[camera] = total
        return found

    def report(self, t: float) -> ReceptionReport:
        """What has become known since the report before."""
        known, frames, received, lost = self._known, list[Frame](), 0, 0
        while known and known[0][0] <= t:
            what = heapq.heappop(known)[2]
            if isinstance(what, int):
                lost += what
            else:
                frames.append(what)
                received += what.packets
        self._totals = (self._totals[0] + received, self._totals[1] + lost)
        while self._telemetry and self._telemetry[0][0] <= t:
            self._vehicle_s = self._telemetry.popleft()
        arrival, sent = self._vehicle_s or (t, t)
        if t - self._counted_at >= COUNTED_S:
            self._count(t)
        frames.sort(key=attrgetter("arrival.arrived"))
        return ReceptionReport(
            round(t, 4),
            round(sent + t - arrival, 6),
            self._units(t, frames),
            received,
            lost,
            damaged=self._damaged(t) or UNSET if self._damages else UNSET,
            run=RUN,
            offset_s=round(self._base_s, 4) if frames and self._base_s is not None else UNSET,
        )

    def _units(self, t: float, frames: Sequence[Frame]) -> tuple[UnitReceived, ...]:
        if frames and self._base_s is None:
            self._base_s = frames[0].arrival.arrived - frames[0].arrival.captured
        base, units = self._base_s or 0.0, []
        for camera, arrival, begun, ended, _ in frames:
            before = self._ended or ended
            train = (ended[0] - begun[0], ended[1] - begun[1])
            carried = (max(0, ended[0] - before[0]), max(0, ended[1] - before[1]))
            units.append(UnitReceived.of(camera, arrival, t, base, train, carried))
            self._ended = max(before, ended)
        return tuple(units)

    def _damaged(self, t: float) -> tuple[str, ...]:
        return tuple(name for name, some in self._damages.items() if any(one.since <= t < one.until for one in some))

    def _count(self, t: float) -> None:
        """Stop or resume repair, a few times a second."""
        received, missing = (
            DECAY * r + n - o for r, n, o in zip(self._recent, self._totals, self._counted, strict=True)
        )
        self._recent, self._counted, self._counted_at = (received, missing), self._totals, t
        self.congested = missing > (CLEAR if self.congested else CONGESTED) * (received + missing)
