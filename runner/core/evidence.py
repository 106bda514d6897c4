"""What the frames that arrived tell of the uplink's capacity, and of the queue in front of it. Pure.

A first-in, first-out link tells its capacity at any load. Without a queue, frame i would have arrived at u_i: when it
was captured, plus the shortest delay of its path. If the frame before it arrived at a_(i-1) > u_i, the link was busy
from a_(i-1) to a_i, and carried what arrived in that time (Lindley's recursion, solved for the service time). The
packets of one frame are a packet train: what arrived between its first and its last packet passed the link in that
time, whether or not the frame had to wait. An offset between the clocks of both sides cancels out.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from math import inf
from types import MappingProxyType
from typing import NamedTuple

from runner.core.events import Evidence, LinkState
from runner.core.history import History, rate, recorded

REPORT_S = 0.04  # between two reports
BUCKET_S = 10.0  # the path's delay is the minimum of the current time bucket and the previous one
SAME_S = 0.001  # closer capture times, after rounding, belong to the same frame
# Without a unit for longer, path delays expire: clocks that drift apart by 50 ppm change them by 6 ms.
EXPIRED_S = 120.0
# Delays that differ by more are not of the same clock: a graph without capture times has an origin for each camera.
ONE_CLOCK_S = 10.0
GAP_S = 0.12  # without a unit for this long, the link has stalled
JITTER_S = 0.004  # of an arrival: half of 8 ms, a usual grant cycle of a mobile uplink
BUSY_S = JITTER_S  # a frame that waited longer found the link busy; it may have been sent late by less
GAP_INTERVALS = 1.5  # frame intervals without a frame are no gap, either
FIRST_INTERVAL_S = 1 / 15
QUEUE_S = 0.02  # a shorter standing wait is no queue worth mentioning
RATE_S, COUNTED_S = 0.5, 1.0  # what is received, and the share lost, are stated of this time


@dataclass(frozen=True, slots=True)
class ReceivedUnit:
    """A frame as the operator's side received it, or a part of one: its rest may follow in a later report.

    captured  s by the vehicle's clock
    arrived   of its last packet, s by the operator's monotonic clock
    bytes     received on the wire, including headers
    whole     whether no packet was initially missing
    playout   s for which the transport holds a unit back, which hides a shorter wait in the queue
    late      s by which the vehicle at least took longer than usual to send it: no queue
    train_s   from the arrival of its first packet to that of its last
    train     bytes on the wire of all cameras that arrived in that time, without the first packet; 0: unknown
    carried   bytes on the wire of all cameras that arrived after the last packet of the previous unit; 0: unknown
    """

    camera: str
    captured: float
    arrived: float
    bytes: int
    whole: bool = True
    playout: float = 0.0
    late: float = 0.0
    train_s: float = 0.0
    train: int = 0
    carried: int = 0


@dataclass(frozen=True, slots=True)
class LinkReport:
    """What the operator's side has received since its previous report.

    at             s, time of the report by the operator's monotonic clock
    units          in order of arrival
    packets, lost  RTP packets of all cameras received, and missing
    all_received   the vehicle had sent nothing that was still on its way
    """

    at: float
    units: tuple[ReceivedUnit, ...] = ()
    packets: int = 0
    lost: int = 0
    all_received: bool = False


class Path(NamedTuple):
    """Shortest delay of a camera's first packets, s: of the previous time bucket and of this one, which began then."""

    before: float
    now: float
    began: float

    @property
    def delay(self) -> float:
        return min(self.before, self.now)

    def after(self, delay: float, t: float) -> Path:
        if t - self.began > BUCKET_S:
            return Path(self.now, delay, t)
        return self._replace(now=delay) if delay < self.now else self


class Received(NamedTuple):
    """Of one report: kbit, packets, and packets lost."""

    kbit: float
    packets: int
    lost: int


class LinkSummary(NamedTuple):
    """The uplink in a few numbers, for people: no rule reads them.

    kbps      received in the last RATE_S; 0 with the first report
    queue_s   the standing queue
    loss      share of the packets of the last COUNTED_S that was lost
    """

    kbps: float
    queue_s: float
    loss: float
    state: LinkState


@dataclass(frozen=True, slots=True)
class EvidenceMemory:
    """Of what has arrived until now.

    paths     by camera
    seen      by camera: capture time of its newest frame, and its wait, s
    waits     (arrival, wait) of the frames of the last frame interval
    interval  between two frames of a camera, averaged, s
    last      arrival of the newest frame; None: there was none
    resumed   when frames arrived again after the last stall
    received  by the time of the report
    """

    paths: Mapping[str, Path] = field(default_factory=lambda: MappingProxyType({}))
    seen: Mapping[str, tuple[float, float]] = field(default_factory=lambda: MappingProxyType({}))
    waits: tuple[tuple[float, float], ...] = ()
    interval: float = FIRST_INTERVAL_S
    last: float | None = None
    resumed: float = -inf
    received: History[Received] = ()


def observe(memory: EvidenceMemory, report: LinkReport) -> tuple[EvidenceMemory, Evidence | None]:
    """What a report tells; None before the first frame."""
    if memory.last is None and not report.units:
        return memory, None
    memory, evidence = _observe(memory, report)
    counted = Received(sum(_carried(unit) for unit in report.units), report.packets, report.lost)
    return replace(memory, received=recorded(memory.received, report.at, counted, COUNTED_S)), evidence


def summarise(memory: EvidenceMemory, evidence: Evidence) -> LinkSummary:
    """After a report that told this."""
    now = memory.received[-1][0]
    recent = [of for at, of in memory.received if at > now - COUNTED_S]
    lost = sum(of.lost for of in recent)
    loss = lost / max(1, lost + sum(of.packets for of in recent))
    kbps = rate(tuple((at, of.kbit) for at, of in memory.received), now, RATE_S)
    return LinkSummary(kbps, evidence.wait_s, loss, _state(evidence))


def _state(evidence: Evidence) -> LinkState:
    if evidence.silent_s:
        return LinkState.STALLED
    if evidence.wait_s <= QUEUE_S:
        return LinkState.CLEAR
    return LinkState.FILLING if evidence.growth >= 0 else LinkState.DRAINING


def _observe(memory: EvidenceMemory, report: LinkReport) -> tuple[EvidenceMemory, Evidence]:
    units, last = report.units, memory.last
    if not units:
        if report.all_received:
            return memory, Evidence()
        assert last is not None
        # While the operator's side is held up it reads nothing, and reports nothing either.
        held_up_s = max(0.0, report.at - memory.received[-1][0] - REPORT_S) if memory.received else 0.0
        silent_s = max(0.0, report.at - last - _gap_s(memory) - held_up_s)
        return memory, Evidence(wait_s=_standing(memory), silent_s=silent_s)
    if _is_of_another_clock(memory, units):
        memory, last = EvidenceMemory(), None
    began = units[0].arrived
    gap = 0.0 if last is None else began - last
    ended_stall = gap > _gap_s(memory)
    if ended_stall and began - memory.resumed > 4 * _gap_s(memory):  # a slow link has gap after gap
        # What a stalled link releases arrives at once, and says nothing about its capacity, nor its losses.
        memory, _ = _add_frames(replace(memory, resumed=began), units, report.at)
        return memory, Evidence(wait_s=_standing(memory), backlog=True)
    if ended_stall:
        memory = replace(memory, resumed=began)
    memory, evidence = _add_frames(memory, units, report.at)
    # What was lost before the first frame says when the link began, not what it carries.
    lost = 0.0 if last is None else report.lost * evidence.kbit / max(1, report.packets)
    return memory, evidence._replace(wait_s=_standing(memory), lost_kbit=lost)


def _gap_s(memory: EvidenceMemory) -> float:
    return max(GAP_S, GAP_INTERVALS * memory.interval)


def _is_of_another_clock(memory: EvidenceMemory, units: Iterable[ReceivedUnit]) -> bool:
    first = next(iter(units))
    if memory.last is not None and first.arrived - memory.last > EXPIRED_S:
        return True
    captured = {name: at for name, (at, _) in memory.seen.items()}
    for unit in units:
        if unit.captured < captured.get(unit.camera, -inf) - SAME_S:
            return True
        captured[unit.camera] = unit.captured
    return False


def _add_frames(memory: EvidenceMemory, units: tuple[ReceivedUnit, ...], at: float) -> tuple[EvidenceMemory, Evidence]:
    """Add the frames of a report, in order of arrival."""
    paths, seen, waits, interval, last = (
        dict(memory.paths),
        dict(memory.seen),
        list(memory.waits),
        memory.interval,
        memory.last,
    )
    busy_kbit = busy_s = grown = grown_s = served = due = shorter_s = 0.0
    unqueued = services = 0
    trains = {False: (0.0, 0.0, 0), True: (0.0, 0.0, 0)}  # by whether the frame found the link busy
    for unit in units:
        first = unit.arrived - unit.train_s
        known = paths.get(unit.camera)
        path = paths[unit.camera] = _path(paths, unit, first)
        shorter_s = max(shorter_s, 0.0 if known is None else known.delay - path.delay)
        due = unit.captured + unit.late + path.delay
        wait = 0.0 if last is None else max(0.0, last - due)
        is_busy = wait > max(BUSY_S, _idle(unit, last))
        if unit.whole:
            if is_busy:
                if last is not None and unit.arrived > last:
                    busy_kbit, busy_s = busy_kbit + _carried(unit), busy_s + unit.arrived - last
                    served, services = served + due + wait, services + 1
            elif not unit.playout:
                unqueued += 1
                served, services = served + due, services + 1
            if unit.train and not unit.playout:
                kbit, took_s, number = trains[is_busy]
                trains[is_busy] = kbit + _kbit(unit.train), took_s + unit.train_s, number + 1
        waited = max(0.0, first - due)
        captured, before = seen.get(unit.camera, (unit.captured, waited))
        after_s = unit.captured - captured
        if 0 < after_s < 1:
            grown, grown_s = grown + waited - before, grown_s + after_s
            interval += 0.1 * (after_s - interval)
        seen[unit.camera] = unit.captured, waited
        waits.append((unit.arrived, waited + (unit.playout if is_busy else 0.0)))
        last = unit.arrived if last is None else max(last, unit.arrived)
    assert last is not None
    kept = tuple(entry for entry in waits if entry[0] >= last - interval)
    evidence = Evidence(
        busy_kbit=busy_kbit,
        busy_s=busy_s,
        train_kbit=trains[True][0],
        train_s=trains[True][1],
        trains=trains[True][2],
        idle_kbit=trains[False][0],
        idle_s=trains[False][1],
        idle=trains[False][2],
        unqueued=unqueued,
        kbit=sum(_carried(unit) for unit in units),
        longest_s=max(wait for _, wait in kept),
        shorter_s=shorter_s,
        growth=grown / grown_s if grown_s else 0.0,
        age_s=at - served / services if services else 0.0,
        backlog=due < memory.resumed,
    )
    return replace(memory, paths=paths, seen=seen, waits=kept, interval=interval, last=last), evidence


def _path(paths: Mapping[str, Path], unit: ReceivedUnit, first: float) -> Path:
    """The path of a camera once its frame, whose first packet arrived then, is known."""
    delay = first - unit.captured  # `late` may be too long, which would make the path look too short for good
    path = paths.get(unit.camera)
    if path is None:
        # A camera that starts while a queue lasts would mistake it for its path.
        others = (other.delay for other in paths.values() if abs(other.delay - delay) < ONE_CLOCK_S)
        shortest = min([delay, *others])
        return Path(shortest, shortest, unit.arrived)
    return path.after(delay, unit.arrived) if unit.whole else path


def _idle(unit: ReceivedUnit, last: float | None) -> float:
    """For how long the link may have been idle between the frame before and this one, s: it may have been sent late."""
    if last is None or not unit.train:
        return 0.0
    first_s = unit.train_s * (unit.bytes - unit.train) / unit.train
    return unit.arrived - unit.train_s - first_s - last


def _standing(memory: EvidenceMemory) -> float:
    return min(wait for _, wait in memory.waits)


def _carried(unit: ReceivedUnit) -> float:
    return _kbit(unit.carried or unit.bytes)


def _kbit(size: int) -> float:
    return size * 8 / 1000


def rounded(evidence: Evidence) -> Evidence:
    """As it is logged: to a microsecond and a bit."""
    return Evidence._make(round(value, 6) if type(value) is float else value for value in evidence)
