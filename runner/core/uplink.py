"""Estimates the capacity of the uplink from what the operator's side receives from every camera. Pure.

All cameras share one uplink and so one estimate. An access unit is delayed by the path and by the queue in front of the
link. The smallest recent delay of its camera is the path's; the rest is the queue's, and an offset between the clocks
of both sides cancels out. While a queue lasts, units arrive at the rate of the link.

Delay-based like NADA (RFC 8698), with special handling of two cases in which delay misleads. A link that stalls and
then delivers everything in a burst, as cellular links do, shows a gap and no lasting queue. A path that becomes longer
shows a queue that does not drain although less is sent.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from math import inf
from operator import attrgetter
from statistics import median
from types import MappingProxyType
from typing import NamedTuple

BUCKET_S = 10.0  # the path's delay is the minimum of the current time bucket and the previous one
NEW_S = 1.0  # how long a new camera must send before its own path is measured
KEPT_S, MAX_UNITS = 1.0, 5000  # units are stored for this long, and at most this many
SAME_S = 0.001  # closer capture times, after rounding, belong to the same frame
STEADY_S = 0.25  # the link's rate is the highest measured in this time: late units make it look lower
LONGEST_INTERVAL_S = 1.0  # between two frames; a longer one is a pause
# Without a unit for longer, path delays expire: clocks that drift apart by 50 ppm change them by 6 ms.
EXPIRED_S = 120.0
# Delays that differ by more are not of the same clock: a graph without capture times has an origin for each camera.
ONE_CLOCK_S = 10.0
SILENT = 4  # a camera without a frame for this many of its intervals, while others send, no longer does
RATE_S = 0.25  # the rate is averaged over this time or three frame intervals, whichever is longer
# With a queue longer than the first of these, the rate of the link has probably dropped and earlier measurements are
# obsolete. The link is busy, so a short time suffices to measure the new rate.
FALLEN_S, FALLEN_RATE_S = 0.04, 0.1
PAUSE_S = 0.01  # without a unit for this long beyond 1.5 frame intervals, measurement of the rate restarts ...
# ... or, behind a playout delay, for the second of these times if the last unit was late by more than the first: a
# large frame takes long on a narrow link.
VISIBLE_S, QUEUED_PAUSE_S = 0.003, 0.04


class _Windows(NamedTuple):
    """Times that depend on whether a playout delay hides jitter, s.

    recent    the queue is the shortest that a unit met in this time or one frame interval, whichever is longer
    evidence  a rate measured over a shorter time is not significant
    steady    as STEADY_S, once the rate of the link has dropped
    """

    recent: float
    evidence: float
    steady: float


ON_ARRIVAL = _Windows(recent=0.06, evidence=0.08, steady=FALLEN_RATE_S)
# A playout delay hides jitter: units that are late nevertheless have met a long queue, and arrive at the link's rate.
HELD_BACK = _Windows(recent=0.04, evidence=0.05, steady=0.05)

SLOW_S = 0.15  # a longer interval between frames is a gap in which frames were lost
EMPTY_S = 0.010  # a unit that waited less met no queue
GROWN_S = 0.020  # a queue from here on may be growing
GROWTH_S = 0.006  # change within COMPARED_S from which a queue counts as growing or draining
COMPARED_S = 0.08
LONG_S = 0.060  # a queue from here on is too long unless it drains
UNDRAINED_S = 0.4  # a queue that is no shorter after this time is not draining
LATE_REPORT_S = 0.06  # between two reports; a longer time means that the operator's side was held up
GAP_S = 0.12  # without a unit for this long and for two frame intervals, the link has stalled
COUNTED_S, LONGEST_S = 1.0, 2.0  # losses are counted for this long; with few packets for longer ...
FEW_PACKETS = 100  # ... until there are so many; with fewer the loss share is not reported
OVERFLOWING = 0.04  # packets lost per packet received, more than usual on the radio link: the queue overflows
DROPPED_SHARE = 0.8  # of the rate before the queue: less is no jitter, which delays units but lets all of them through
STUCK_GROWTH = 1.5  # a queue longer than this multiple of its minimum is growing
STUCK_S = 0.6  # a queue that has not drained for this long ...
STUCK_SHARE = 0.75  # ... although the rate fell to this share is not a queue: the path has become longer


class LinkState(StrEnum):
    """State of the queue in front of the link."""

    CLEAR = "clear"
    FILLING = "filling"
    DRAINING = "draining"
    STALLED = "stalled"


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


@dataclass(frozen=True, slots=True)
class LinkEstimate:
    """The uplink at the time of a report.

    kbps      received kbit/s; while the queue is filling or draining, the capacity. None: too little has arrived
    queue_ms  wait in the queue, including what a playout delay hides of it once the link's rate has dropped
    loss      share of packets lost in the last second or, with few packets, two; 0 to 1
    """

    kbps: float | None
    queue_ms: float
    loss: float
    state: LinkState


@dataclass(frozen=True, slots=True)
class _Path:
    """Delay of one camera's path: the minimum of the previous time bucket and the current one, which began at `began`.

    own  whether this camera was measured with an empty queue. Until then the path is the shortest of all cameras with
         the same clock: a camera that starts slowly or while a queue lasts would mistake that delay for its path
    """

    before: float
    current: float
    began: float
    own: bool = False

    @property
    def delay(self) -> float:
        return min(self.before, self.current)

    def after(self, unit: ReceivedUnit, *, empty: bool) -> _Path:
        delay = unit.arrived - unit.captured
        if not self.own and empty and unit.arrived - self.began > NEW_S:
            return _Path(delay, delay, unit.arrived, own=True)
        if unit.arrived - self.began > BUCKET_S:
            return _Path(self.current, delay, unit.arrived, self.own)
        return replace(self, current=delay) if delay < self.current else self


def _new_path(unit: ReceivedUnit, others: Collection[_Path], queue: float) -> _Path:
    """The path of a new camera.

    queue  which the newest unit of the others met, s
    """
    delay = unit.arrived - unit.captured
    if not others:
        return _Path(delay, delay, unit.arrived, own=True)
    shortest = _shortest(delay, others)
    shortest = delay - queue if shortest is None else shortest
    return _Path(shortest, shortest, unit.arrived)


def _shortest(delay: float, paths: Iterable[_Path]) -> float | None:
    """The shortest path whose capture times are of the same clock as those of a unit with this delay; None: none."""
    return min((path.delay for path in paths if abs(path.delay - delay) < ONE_CLOCK_S), default=None)


@dataclass(frozen=True, slots=True)
class _Unit:
    """When a unit arrived, how long it visibly waited in the queue, s, its size, and the playout delay, s."""

    arrived: float
    queue: float
    bytes: int
    playout: float


@dataclass(frozen=True, slots=True)
class UplinkMemory:
    """Memory of the estimator.

    paths      by camera
    captured   by camera, capture time of its last unit
    intervals  by camera, s between its last two units
    units      of the last second, in order of arrival
    queues     (time of the report, wait in the queue, packets received, lost) of the last STUCK_S
    packets    (time of the report, received, lost) for the share of losses
    resumed    when units arrived again after the last gap
    onset      when the queue was last empty; None: it is empty
    level      wait in the queue when it last grew clearly, s
    peak       kbit/s, highest rate since then: a queue that grows because the link fell carried more before
    cleared    kbit/s, rate when the queue was last empty
    rates      (time of the report, kbit/s) since the onset, of the last STEADY_S
    """

    paths: Mapping[str, _Path] = field(default_factory=lambda: MappingProxyType({}))
    captured: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    intervals: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    units: tuple[_Unit, ...] = ()
    queues: tuple[tuple[float, float, int, int], ...] = ()
    packets: tuple[tuple[float, int, int], ...] = ()
    resumed: float = -inf
    onset: float | None = None
    level: float = 0.0
    peak: float = 0.0
    cleared: float = 0.0
    rates: tuple[tuple[float, float], ...] = ()


def estimate(uplink: UplinkMemory, report: LinkReport) -> tuple[UplinkMemory, LinkEstimate | None]:
    """Update the estimate with a report.

    returns  None before the first unit has arrived
    """
    if uplink.units and report.units and report.units[0].arrived - uplink.units[-1].arrived > EXPIRED_S:
        uplink = UplinkMemory()
    before, uplink = uplink, _add_units(uplink, report.units)
    packets = _recent_packets((*uplink.packets, (report.at, report.packets, report.lost)))
    if uplink.resumed != before.resumed:
        packets = ()  # losses in a stall say nothing about the link after it
    uplink = replace(uplink, packets=packets)
    if not uplink.units:
        return uplink, None
    frame, last = _frame_interval(uplink.intervals, uplink.captured, uplink.paths), uplink.units[-1].arrived
    is_overdue = report.at - last > _longest_gap(frame)
    if report.all_received and is_overdue:  # nothing is sent, and nothing can be known of the link
        now = (report.at, 0.0, report.packets, report.lost)
        idle = replace(uplink, queues=(now,), onset=None, level=0.0, peak=0.0, rates=())
        return idle, LinkEstimate(0.0, 0.0, _loss(packets), LinkState.CLEAR)
    windows = _windows(uplink.units[-1].playout)
    queue = min(unit.queue for unit in _later(uplink.units, last - max(windows.recent, frame)))
    if queue <= EMPTY_S:
        onset = None
    elif uplink.onset is None:
        onset = max((u.arrived for u in uplink.units if u.queue <= EMPTY_S), default=uplink.units[0].arrived)
    else:
        onset = uplink.onset
    # While the operator's side is held up it reads nothing, and reports nothing either.
    held_up_s = max(0.0, report.at - uplink.queues[-1][0] - LATE_REPORT_S) if uplink.queues else 0.0
    stalled = not report.all_received and report.at - last > _longest_gap(frame) + held_up_s
    # In a stall nothing new is known of the queue, which would seem not to drain.
    waits = () if stalled else _entries_since(uplink.queues, report.at - STUCK_S)
    queues = (*waits, (report.at, queue, report.packets, report.lost))
    uplink = replace(uplink, onset=onset, queues=queues)
    fallen = onset is not None and queue + uplink.units[-1].playout > FALLEN_S
    own = min(frame, SLOW_S)
    kbps, since = _rate(uplink, last, max(FALLEN_RATE_S, own) if fallen else max(RATE_S, 3 * frame), queue, own)
    if onset is None or stalled or queue > STUCK_GROWTH * uplink.level + GROWN_S:
        uplink = replace(uplink, level=queue, peak=0.0)
    cleared = kbps if onset is None and kbps else uplink.cleared
    uplink = replace(uplink, peak=max(uplink.peak, kbps or 0.0), cleared=cleared)
    if _is_stuck(uplink, kbps):
        return _lengthen_path(uplink), LinkEstimate(kbps, 0.0, _loss(packets), LinkState.CLEAR)
    state = LinkState.STALLED if stalled else _state(queues, queue, onset)
    is_queued = state in (LinkState.FILLING, LinkState.DRAINING)
    if is_queued and kbps is not None:
        steady = windows.steady if fallen else STEADY_S
        rates = (*_entries_since(uplink.rates, max(report.at - steady, since)), (report.at, kbps))
        uplink, kbps = replace(uplink, rates=rates), max(rate for _, rate in rates)
    elif state is LinkState.CLEAR:
        uplink = replace(uplink, rates=())
    has_dropped = is_queued and kbps is not None and kbps < DROPPED_SHARE * uplink.cleared
    hidden = uplink.units[-1].playout if has_dropped else 0.0
    return uplink, LinkEstimate(kbps, 1000 * (queue + hidden), _loss(packets), state)


def _windows(playout: float) -> _Windows:
    return HELD_BACK if playout else ON_ARRIVAL


def _add_units(uplink: UplinkMemory, units: Iterable[ReceivedUnit]) -> UplinkMemory:
    """Add units; a capture time that goes backwards reveals that a clock was set, which invalidates all delays."""
    paths, captured, intervals = dict(uplink.paths), dict(uplink.captured), dict(uplink.intervals)
    kept, resumed = list(uplink.units), uplink.resumed
    newest = kept[-1].arrived if kept else None
    for unit in units:
        after = unit.captured - captured.get(unit.camera, unit.captured)
        if after < -SAME_S:
            paths, captured, intervals, kept = {}, {}, {}, []
        elif after > SAME_S:  # otherwise the rest of the same frame
            intervals[unit.camera] = min(LONGEST_INTERVAL_S, after)
        captured[unit.camera] = unit.captured
        path = paths.get(unit.camera)
        if unit.whole:  # without its last packets a unit seems to arrive sooner
            path = path or _new_path(unit, paths.values(), kept[-1].queue if kept else 0.0)
            path = path.after(unit, empty=uplink.onset is None)
            paths[unit.camera] = path
        shortest = path.delay if path and path.own else _shortest(unit.arrived - unit.captured, paths.values())
        gap = unit.arrived - newest if newest else 0.0
        pause = QUEUED_PAUSE_S if unit.playout and kept and kept[-1].queue > VISIBLE_S else PAUSE_S
        if gap > pause and gap > pause + 1.5 * _frame_interval(intervals, captured, paths):  # rarely compute the second
            resumed = unit.arrived
        newest = max(newest, unit.arrived) if newest else unit.arrived
        queue = 0.0 if shortest is None else max(0.0, unit.arrived - unit.captured - unit.late - shortest)
        kept.append(_Unit(unit.arrived, queue, unit.bytes, unit.playout))
    kept.sort(key=attrgetter("arrived"))  # a unit without its last packets is reported late
    recent = tuple(_later(kept, kept[-1].arrived - KEPT_S)[-MAX_UNITS:]) if kept else ()
    return replace(uplink, paths=paths, captured=captured, intervals=intervals, units=recent, resumed=resumed)


def _later(units: Sequence[_Unit], time: float) -> Sequence[_Unit]:
    """Those that arrived after a time; units are in order of arrival."""
    return units[bisect_right(units, time, key=attrgetter("arrived")) :]


def _frame_interval(intervals: Mapping[str, float], captured: Mapping[str, float], paths: Mapping[str, _Path]) -> float:
    """Median of the cameras that send, s."""
    # When each last frame would have arrived without a queue: capture times may be of different clocks.
    due = {name: at + paths[name].delay for name, at in captured.items() if name in paths}
    newest = max(due.values(), default=0.0)
    active = [own for name, own in intervals.items() if newest - due.get(name, newest) <= SILENT * own]
    return median(active) if active else 0.0


def _longest_gap(frame: float) -> float:
    """Longest time between two units of any camera that is not a stall, s."""
    return max(GAP_S, 2 * frame)


def _rate(uplink: UplinkMemory, last: float, window: float, queue: float, frame: float) -> tuple[float | None, float]:
    """Received kbit/s, and since when they are measured: the start or the doubling of the queue, never across a gap.

    A shorter time than a frame interval may lack the frame of the camera that sends most.
    """
    evidence = max(_windows(uplink.units[-1].playout).evidence, frame)
    # From one arrival to another: a window that begins in between would count too much or too little.
    within = len(_later(uplink.units, last - window))
    begin = uplink.units[max(0, len(uplink.units) - within - 1)].arrived
    began = uplink.resumed if uplink.onset is None else max(uplink.resumed, uplink.onset)
    small = (unit.arrived for unit in uplink.units if 2 * unit.queue <= queue and uplink.onset is not None)
    for since in (max(begin, began, max(small, default=began)), max(begin, began)):
        if last - since >= evidence:
            return _kbps(uplink.units, since, last), since
    if uplink.resumed > begin or last - begin < evidence:
        return None, last
    return _kbps(uplink.units, begin, last), begin


def _kbps(units: Sequence[_Unit], since: float, until: float) -> float:
    return sum(unit.bytes for unit in _later(units, since)) * 8 / 1000 / (until - since)


def _state(queues: Sequence[tuple[float, float, int, int]], queue: float, onset: float | None) -> LinkState:
    if onset is None or queue <= GROWN_S:
        return LinkState.CLEAR
    now = queues[-1][0]
    before = min((was for at, was, _, _ in queues if now - 0.3 < at < now - COMPARED_S), default=queue)
    long_ago = min((was for at, was, _, _ in queues if at < now - UNDRAINED_S), default=None)
    undrained = long_ago is not None and queue > long_ago - GROWTH_S
    if queue > before + GROWTH_S or (queue > LONG_S and queue > before - GROWTH_S) or undrained:
        return LinkState.FILLING
    return LinkState.DRAINING


def _is_stuck(uplink: UplinkMemory, kbps: float | None) -> bool:
    """Whether a queue lasts although less arrives than when it was that long, so that it cannot be a queue."""
    queues = [was for _, was, _, _ in uplink.queues]
    received, lost = sum(some for _, _, some, _ in uplink.queues), sum(some for _, _, _, some in uplink.queues)
    return (
        uplink.onset is not None
        and kbps is not None
        and uplink.queues[-1][0] - uplink.queues[0][0] > 0.8 * STUCK_S
        and min(queues) > GROWN_S
        and 0.9 * queues[0] < queues[-1] < STUCK_GROWTH * min(queues)
        and lost <= OVERFLOWING * received
        and kbps < STUCK_SHARE * uplink.peak
    )


def _lengthen_path(uplink: UplinkMemory) -> UplinkMemory:
    """Add to the paths' delays what was mistaken for a queue."""
    longer = min(was for _, was, _, _ in uplink.queues)
    paths = {
        name: _Path(path.delay + longer, path.delay + longer, path.began, path.own)
        for name, path in uplink.paths.items()
    }
    units = tuple(replace(unit, queue=max(0.0, unit.queue - longer)) for unit in uplink.units)
    return replace(uplink, paths=paths, onset=None, queues=(), units=units)


def _recent_packets(packets: Sequence[tuple[float, int, int]]) -> tuple[tuple[float, int, int], ...]:
    """Those from which the loss share is calculated, the newest last."""
    now, count, begin = packets[-1][0], 0, len(packets)
    for at, received, lost in reversed(packets):
        if at <= now - (COUNTED_S if count >= FEW_PACKETS else LONGEST_S):
            break
        count, begin = count + received + lost, begin - 1
    return tuple(packets[begin:])


def _loss(packets: Sequence[tuple[float, int, int]]) -> float:
    received, lost = sum(received for _, received, _ in packets), sum(lost for _, _, lost in packets)
    return lost / (received + lost) if received + lost >= FEW_PACKETS else 0.0


def _entries_since(entries: Iterable[tuple[float, ...]], begin: float) -> tuple[tuple, ...]:  # type: ignore[type-arg]
    return tuple(entry for entry in entries if entry[0] > begin)
