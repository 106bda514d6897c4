"""Simulated cameras, link and reception reports: the estimator and the cap in a closed loop."""

from __future__ import annotations

import heapq
import itertools
import random
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

from runner.core.events import LinkMeasured, PositionReported
from runner.core.link_cap import believed_limit, start_cap, update_cap
from runner.core.link_memory import UNCAPPED, LinkCap
from runner.core.uplink import LinkEstimate, LinkReport, ReceivedUnit, UplinkMemory, estimate
from runner.records import SentFrame
from runner.vehicle.sending import SendingTimes

Profile = Callable[[float], float]  # value over time, s
SLOT_S = 0.01  # capacity is constant for this long
PACKET = 1200  # bytes
LOOK_S = 0.02


@dataclass(repr=False)
class Link:
    """A link with a queue that drops packets which would wait too long.

    kbps     capacity
    delay_s  further delay of packets sent at that time, both ways; packets stay in order
    queue_s  longest wait
    playout_s  for which the transport holds frames back, counted from when they are sent
    """

    kbps: Profile
    delay_s: Profile = lambda t: 0.0
    one_way_s: float = 0.015
    queue_s: float = 0.3
    loss: float = 0.0
    playout_s: float = 0.0


class Queue:
    """The queue in front of a link.

    free  when the last bit in the queue leaves
    """

    def __init__(self, link: Link, free: float) -> None:
        self._link, self.free = link, free

    def put(self, t: float, size: int) -> float | None:
        """When a packet of that many bytes has left; None: dropped."""
        if self.free - t > self._link.queue_s:
            return None
        self.free = _sent(self._link, max(t, self.free), size)
        return self.free


class Tcp:
    """A TCP flow: the window grows by one packet per round trip, and shrinks to 0.7 on loss (RFC 9438)."""

    PACKET = 1500

    def __init__(self, until: float, rtt_s: float) -> None:
        self._until, self._rtt_s = until, rtt_s
        self._window, self._in_flight, self._reduced_at = 10.0, 0, 0.0
        self.delivered: list[tuple[float, int]] = []

    def on_feedback(self, t: float, outcome: str) -> None:
        if outcome == "ack":
            self._in_flight -= 1
            self._window += 1 / self._window
            self.delivered.append((t, self.PACKET))
        elif outcome == "loss":
            self._in_flight -= 1
            if t - self._reduced_at > self._rtt_s:
                self._window, self._reduced_at = max(2.0, 0.7 * self._window), t

    def send(self, t: float, queue: Queue) -> Iterator[tuple[float, str]]:
        """Send as much as the window allows; yields when the sender learns the fate of each packet."""
        while t < self._until and self._in_flight < self._window:
            self._in_flight += 1
            left = queue.put(t, self.PACKET)
            yield (left or queue.free) + self._rtt_s, "ack" if left else "loss"


class ShortFlows(Tcp):
    """TCP flows one after another, of 100 to 1000 kB: each begins with slow start, after a pause of 0.2 to 1.5 s."""

    def __init__(self, until: float, rtt_s: float) -> None:
        super().__init__(until, rtt_s)
        self._rng, self._left, self._begins, self._is_starting = random.Random(1), 0, 0.0, True

    def on_feedback(self, t: float, outcome: str) -> None:
        if outcome == "ack" and self._is_starting:
            self._window += 1 - 1 / self._window
        self._is_starting = self._is_starting and outcome != "loss"
        super().on_feedback(t, outcome)

    def send(self, t: float, queue: Queue) -> Iterator[tuple[float, str]]:
        if self._left <= 0 and t >= self._begins:
            self._left, self._window, self._is_starting = self._rng.randint(100_000, 1_000_000), 10.0, True
        while self._left > 0 and t < self._until and self._in_flight < self._window:
            self._in_flight, self._left = self._in_flight + 1, self._left - self.PACKET
            left = queue.put(t, self.PACKET)
            yield (left or queue.free) + self._rtt_s, "ack" if left else "loss"
            if self._left <= 0:
                self._begins = t + self._rng.uniform(0.2, 1.5)
                yield self._begins, "begins"


@dataclass(repr=False)
class Drive:
    """Record of a simulated drive: (t, cap in kbit/s, state), waits in the queue, bytes that arrived, t of losses."""

    caps: list[tuple[float, float, str]] = field(default_factory=list)
    waits: list[tuple[float, float]] = field(default_factory=list)
    arrived: list[tuple[float, int]] = field(default_factory=list)
    lost: list[float] = field(default_factory=list)
    tcp: Sequence[tuple[float, int]] = ()

    def record_frame(self, t: float, wait: float, arrived: float, size: int) -> None:
        self.waits.append((t, wait))
        self.arrived.append((arrived, size))

    def wait_ms(self, share: float, since: float = 0.0) -> float:
        waits = sorted(wait for t, wait in self.waits if t >= since)
        return 1000 * waits[min(len(waits) - 1, int(share * len(waits)))]

    def kbps(self, begin: float, end: float) -> float:
        return sum(size for t, size in self.arrived if begin <= t < end) * 8 / 1000 / (end - begin)

    def lowest(self, begin: float, end: float) -> float:
        return min(cap for t, cap, _ in self.caps if begin <= t < end)

    def cuts(self, begin: float, end: float) -> int:
        caps = [cap for t, cap, _ in self.caps if begin <= t < end]
        return sum(after < before for before, after in itertools.pairwise(caps))

    def first(self, since: float, wanted: Callable[[float], bool]) -> float:
        """Time until the cap fulfils a condition, s."""
        return next(t for t, cap, _ in self.caps if t >= since and wanted(cap)) - since


def drive(
    link: Link,
    limit: Profile,
    seconds: float,
    *,
    cameras: int = 8,
    fps: float = 30,
    report_s: float = 0.04,
    noise: float = 0.15,
    seed: int = 1,
    tcp_s: tuple[float, float] | None = None,
    position: Callable[[float], PositionReported] | None = None,
    queued_s: float = 0.0,
    start: Fraction = Fraction(1),
    key_frame: float = 1,
    late: Callable[[int, float], float] = lambda camera, t: 0.0,
    watched: bool = False,
    filled: float = 1.0,
    flows: type[Tcp] = Tcp,
    predicted: bool = True,
    floors: float = 0,
) -> Drive:
    """A drive under a limit (prediction or total), kbit/s; every camera sends an equal part of the cap.

    noise  share by which sizes of access units vary
    tcp_s  begin and end of a TCP flow, or of several (flows), over the same link
    position  of the vehicle over time
    queued_s  length of the queue before the cameras begin
    start  share of the limit until the link is measured
    key_frame  size of each camera's first frame, in multiples of the others
    late  delay until the frame that a camera captures at t is sent, s
    watched  whether the vehicle looks every LOOK_S which frames it has sent
    filled  share of their bitrate that the encoders use
    predicted  whether the limit is a prediction; otherwise only the measurement limits the total
    floors  what the cap needs for the floors of all cameras, kbit/s
    """
    rng, order, uplink = random.Random(seed), itertools.count(), UplinkMemory()
    begin, end = tcp_s or (seconds, seconds)
    link_queue, tcp = Queue(link, queued_s), flows(end, 2 * link.one_way_s)
    done, cap, sending = Drive(tcp=tcp.delivered), _first_cap(limit(0.0), start, predicted, floors), SendingTimes()
    events: list[tuple[float, int, str, Any]] = [
        (0.001 * number, next(order), "frame", number) for number in range(cameras)
    ]
    events += [(report_s, next(order), "report", None), (begin, next(order), "tcp", "begins")]
    heapq.heapify(events)

    def schedule(t: float, kind: str, what: Any) -> None:
        heapq.heappush(events, (t, next(order), kind, what))

    last_unit = last_report = 0.0
    in_flight: list[tuple[ReceivedUnit, int, int]] = []  # with packets received, and those missing until then
    missing, in_force = [0] * cameras, limit(0.0) if cap.kbps is None else float(cap.kbps)
    while events and events[0][0] < seconds:
        t, _, kind, what = heapq.heappop(events)
        if kind == "frame":
            schedule(t + 1 / fps, "frame", what)
            schedule(t + late(what, t), "sent", (what, t))
        elif kind == "sent":
            camera, captured = what
            varied = rng.uniform(1 - noise, 1 + noise) * (key_frame if captured < 1 / fps else 1)
            size = int(filled * in_force * 1000 / 8 / fps / cameras * varied)
            left, lost_packets = _send_frame(link_queue, t, size, lambda: rng.random() < link.loss)
            missing[camera] += lost_packets
            done.lost += [t] * bool(lost_packets)
            if left:
                last_unit = max(last_unit, left[-1] + link.one_way_s + link.delay_s(t))
                size = min(size, len(left) * PACKET)
                done.record_frame(t, left[-1] - t, last_unit, size)
                in_flight.append(
                    (
                        ReceivedUnit(
                            f"camera {camera}",
                            captured,
                            max(last_unit, t + link.one_way_s + link.playout_s),
                            size,
                            not lost_packets,
                            link.playout_s,
                            _look(sending, camera, captured, t) if watched else 0.0,
                        ),
                        len(left),
                        missing[camera],
                    )
                )
                missing[camera] = 0
        elif kind == "tcp":
            tcp.on_feedback(t, what)
            for when, outcome in tcp.send(t, link_queue):
                schedule(when, "tcp", outcome)
        elif kind == "report":
            schedule(t + report_s, "report", None)
            arrived = [entry for entry in in_flight if entry[0].arrived <= t]
            in_flight = in_flight[len(arrived) :]
            last_report = max(last_report, t + link.one_way_s + link.delay_s(t))
            units, packets, lost = zip(*arrived, strict=True) if arrived else ((), (), ())
            counts = (sum(packets), sum(lost), not units and sending.is_all_received(t))
            schedule(last_report, "arrived", LinkReport(t, units, *counts))
        else:
            uplink, estimated = estimate(uplink, what)
            if estimated:
                measured = _measured(t, estimated, 2 * link.one_way_s)
                cap = update_cap(
                    cap, measured, t, Fraction(limit(t)), Fraction(1, 2), position(t) if position else None
                )
            trusted = float(believed_limit(cap, Fraction(limit(t)), Fraction(1, 2)))
            in_force = min(trusted, float(cap.kbps)) if cap.kbps is not None else trusted
            done.caps.append((t, in_force, estimated.state if estimated else ""))
    return done


def _first_cap(limit: float, start: Fraction, predicted: bool, floors: float) -> LinkCap:
    cap = UNCAPPED._replace(alone=not predicted, predicted=predicted, floors=Fraction(floors))
    return start_cap(cap, None, 0.0, Fraction(limit), start)


def _look(sending: SendingTimes, camera: int, captured: float, t: float) -> float:
    """What the vehicle knows of how late it sent a frame, at t, s."""
    looked = t // LOOK_S * LOOK_S
    sending.add({f"camera {camera}": [SentFrame(captured, looked, looked + LOOK_S)]})
    return sending.late_s(f"camera {camera}", captured)


def _send_frame(queue: Queue, t: float, size: int, is_lost: Callable[[], bool]) -> tuple[list[float], int]:
    """When the packets of a frame that get through have left, and how many are dropped or lost."""
    times = [queue.put(t, min(PACKET, size - begin)) for begin in range(0, size, PACKET)]
    left = [at for at in times if at is not None and not is_lost()]
    return left, len(times) - len(left)


def _measured(t: float, estimated: LinkEstimate, rtt_s: float) -> LinkMeasured:
    return LinkMeasured(
        t=t,
        kbps=None if estimated.kbps is None else Fraction(round(estimated.kbps, 1)).limit_denominator(10),
        queue_ms=round(estimated.queue_ms, 1),
        loss=round(estimated.loss, 4),
        state=estimated.state,
        rtt_ms=1000 * rtt_s,
    )


def _sent(link: Link, t: float, size: int) -> float:
    """When the last bit of a packet has left."""
    bits = size * 8 / 1000
    while True:
        end = (int(t / SLOT_S + 1e-9) + 1) * SLOT_S
        kbps = max(0.001, link.kbps(t))
        if kbps * (end - t) >= bits:
            return t + bits / kbps
        bits -= kbps * (end - t)
        t = end


def steps(*values: tuple[float, float]) -> Profile:
    """A profile that takes each value from its time on."""

    def value(t: float) -> float:
        return [v for begin, v in values if begin <= t or begin == values[0][0]][-1]

    return value


def stalls(*spans: tuple[float, float]) -> Profile:
    """Delay of a link that stalls for spans of time and then delivers everything in a burst."""

    def delay(t: float) -> float:
        return next((end - t for begin, end in spans if begin <= t < end), 0.0)

    return delay


def jitter(every_s: float, long_s: float, ms: float, seed: int = 3, until: float = 60.0) -> Profile:
    """Random delays with these means: time between two, length, and size."""
    rng, spans, t = random.Random(seed), [], 1.0
    while t < until:
        t += rng.expovariate(1 / every_s)
        end = t + long_s * rng.uniform(0.5, 1.5)
        spans.append((t, end, ms / 1000 * rng.uniform(0.5, 1.5)))
        t = end
    return lambda t: next((delay for begin, end, delay in spans if begin <= t < end), 0.0)


def busy(share: float, mean_s: float, ms: float, seed: int = 1) -> Callable[[int, float], float]:
    """Delay of frames on a machine that is busy for a share of the time, in spans with this mean length.

    In these spans each frame is independently late by up to `ms`; frames of a camera keep their order.
    """
    rng, at = random.Random(seed), 1.0
    spans: list[tuple[float, float]] = []
    while at < 60:
        at += rng.expovariate(share / (mean_s * (1 - share))) if share < 1 else 0
        spans.append((at, at + rng.expovariate(1 / mean_s)))
        at = spans[-1][1]
    sent: dict[int, float] = {}

    def late(camera: int, t: float) -> float:
        is_busy = any(begin <= t < end for begin, end in spans)
        after = rng.uniform(0, ms / 1000) if is_busy else 0.0
        sent[camera] = max(t + after, sent.get(camera, 0.0) + 1e-4)
        return sent[camera] - t

    return late


def utilisation(done: Drive, link: Link, limit: Profile, begin: float, end: float) -> float:
    """Received rate over the rate that the link and the limit allowed."""
    allowed = [min(link.kbps(t), limit(t)) for t in _times(begin, end)]
    return done.kbps(begin, end) / (sum(allowed) / len(allowed))


def _times(begin: float, end: float) -> Iterator[float]:
    return (begin + i * SLOT_S for i in range(int((end - begin) / SLOT_S)))
