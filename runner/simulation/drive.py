"""One simulated drive: cameras send over the link, the operator's side reports, the rules decide. Pure."""

from __future__ import annotations

import heapq
import random
from array import array
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import count
from typing import Any

from runner.configuration.experiment import TimedRequest
from runner.core.budget import payload_bytes
from runner.core.events import BitratePredicted, ClockAdvanced, Event, parse
from runner.core.step import Run
from runner.pqos import Predictions
from runner.records.reception import ReceptionReport, ReceptionReported
from runner.settings import Setup
from runner.simulation.control import ControlMessages, segments
from runner.simulation.encoder import Encoder, EncoderModel
from runner.simulation.operator import REORDER_S, RETRY_S, TAIL_S, Frame, Loss, Operator
from runner.simulation.steps import Steps
from runner.simulation.tcp import Feedback, Flow
from runner.simulation.vehicle import SimulatedVehicle
from runner.simulation.way import EXTENSION, RTO_S, Link, Put, Way, carried, framed, merged

ENCODED_S = 0.001  # from the capture of a frame until it is sent, at least
TICK_S, TELEMETRY_S, REPORT_S = 0.1, 0.2, 0.04
REPORT_BYTES, UNIT_BYTES = 170, 62  # of a report in JSON with MQTT's header, and of each frame in it
UNSTATED_WAVE_S = 1.5  # length of a refresh wave where the graph states none
REPEATED = 2  # bytes by which a repeated packet is longer (RFC 4588)


@dataclass(frozen=True)
class Conditions:
    """What is simulated besides the link itself.

    encoder          how its encoders depart from their rates
    late_s           by which a frame is sent later than the earliest on average, exponentially distributed. Measured in
                     real drives: half within 1 ms more, 95 % within 6 ms; on a busy machine 40 ms
    report_jitter_s  mean further delay of a report, exponentially distributed; reports stay in order
    report_loss      share of reports that never arrive
    control          whether the control link uses the link, too
    """

    encoder: EncoderModel = field(default_factory=EncoderModel)
    late_s: float = 0.002
    report_jitter_s: float = 0.0
    report_loss: float = 0.0
    control: bool = True


@dataclass
class Drive:
    """What happened: pairs of time, s, and value, as flat arrays.

    capacity     of all links together, but for cuts, kbit/s
    totals       kbit/s that the rules decided, whenever they did
    predictions  kbit/s
    waits        of each frame's last packet in the queue, with its own service, s
    frames       bytes of each frame at its arrival
    others       bytes of repeated packets and of the control link at their arrival
    lost         when packets of the cameras were lost
    tcp_bytes    that competing flows delivered
    damaged_s    by camera
    arrivals     by camera, when frames arrived, by the first of several ways, s
    """

    duration_s: float
    capacity: Steps
    totals: array[float] = field(default_factory=lambda: array("d"))
    predictions: array[float] = field(default_factory=lambda: array("d"))
    waits: array[float] = field(default_factory=lambda: array("d"))
    frames: array[float] = field(default_factory=lambda: array("d"))
    others: array[float] = field(default_factory=lambda: array("d"))
    lost: array[float] = field(default_factory=lambda: array("d"))
    tcp_bytes: int = 0
    damaged_s: dict[str, float] = field(default_factory=dict)
    arrivals: dict[str, array[float]] = field(default_factory=dict)


class Recorder:
    """Writes down nothing."""

    def step(self, before: Run, event: Event, after: Run) -> None: ...
    def reported(self, reported: ReceptionReported) -> None: ...
    def frame(self, frame: Frame) -> None: ...
    def tick(self, t: float, simulation: Simulation) -> None: ...


class Simulation:
    """One drive. Events wait in a heap; packets do not, see `runner.simulation.queues`."""

    def __init__(
        self, setup: Setup, links: Mapping[str, Link], pqos: Predictions, duration_s: float, conditions: Conditions,
        seed: int, recorder: Recorder, requests: Sequence[TimedRequest] = (),
    ) -> None:  # fmt: skip
        self.conditions, self.recorder = conditions, recorder
        self._rng = rng = random.Random(seed)
        cameras = setup.vehicle.cameras
        arrivals = {name: array("d") for name in cameras}
        self.done = Drive(duration_s, carried(links.values()), arrivals=arrivals)
        self._sizes = {
            n: (payload_bytes(c.graph), c.graph.settings.header_bytes - EXTENSION) for n, c in cameras.items()
        }
        self.encoders = {n: Encoder(c, conditions.encoder, rng) for n, c in cameras.items()}
        settings = [camera.graph.settings for camera in cameras.values()]
        operator = partial(
            Operator,
            repairs_s=max(one.retransmission_ms for one in settings) / 1000,
            jitter_s=max(one.jitter_buffer_ms for one in settings) / 1000,
            wave_s=2 * max(one.key_interval_s or UNSTATED_WAVE_S for one in settings),
        )
        # One knows the pictures, and reports where there is one way; otherwise each way has one that reports on it.
        self.operator = operator()
        self.ways = {n: Way(one, operator() if n else self.operator, self._sizes) for n, one in links.items()}
        self.vehicle = SimulatedVehicle(setup, pqos, self.encoders, self._stepped, recorder.reported)
        self._requests = requests
        self._order = count()
        self._events: list[tuple[float, int, Callable[[float, Any], None], Any]] = []
        self._held_up_until = 0.0  # the control link
        self._back_newest = 0.0  # arrival of the newest report
        first = next(iter(links.values()))
        self._first_queue = first.queue
        self._flows = [
            Flow(flows, first.one_way_s + first.back_s, random.Random(number))
            for flows in ([first.tcp] if first.tcp else [])
            for number in range(flows.flows)
        ]

    def run(self) -> Drive:
        """The whole drive."""
        vehicle, end = self.vehicle, self.done.duration_s
        vehicle.take(ClockAdvanced(t=0.0))
        self._messages = ControlMessages(vehicle.setup, vehicle.run)
        vehicle.connect(0.0)
        for name, encoder in self.encoders.items():  # real cameras start by chance
            self._schedule_frame(0.0, name, self._rng.uniform(0, encoder.interval_s))
        self._at(TICK_S, self._tick, None)
        self._at(TELEMETRY_S, self._send_telemetry, None)
        self._at(REPORT_S, self._report, None)
        for request in self._requests:
            self._at(request.at_s, self._take_request, request.event)
        for flow in self._flows:
            self._at(flow.flows.start_s, self._begin_flow, flow)
        events, pop = self._events, heapq.heappop
        while events[0][0] < end:
            t, _, work, what = pop(events)
            work(t, what)
        self.done.tcp_bytes = self.tcp_bytes
        self.done.damaged_s = self.operator.damaged_s(end)
        return self.done

    @property
    def tcp_bytes(self) -> int:
        """That competing flows have delivered."""
        return sum(flow.delivered for flow in self._flows)

    def _at(self, t: float, work: Callable[[float, Any], None], what: Any) -> None:
        heapq.heappush(self._events, (t, next(self._order), work, what))

    def _stepped(self, before: Run, event: Event, after: Run) -> None:
        if after.decision is not before.decision and after.decision.total != before.decision.total:
            self.done.totals.extend((event.t, float(after.decision.total)))
        if isinstance(event, BitratePredicted):
            self.done.predictions.extend((event.t, float(after.state.predicted_kbps or 0)))
        self.recorder.step(before, event, after)

    # --- vehicle ---

    def _tick(self, t: float, _: None) -> None:
        self._at(t + TICK_S, self._tick, None)
        self.vehicle.tick(round(t, 6))
        if self._messages.advice:
            self._send_message(t, self._messages.advice)
        self._send_state(t)
        self.recorder.tick(round(t, 6), self)

    def _take_request(self, t: float, event: Mapping[str, Any]) -> None:
        self.vehicle.take(parse({**event, "t": round(t, 6)}))

    def _send_telemetry(self, t: float, _: None) -> None:
        self._at(t + TELEMETRY_S, self._send_telemetry, None)
        if (arrival := self._send_message(t, self._messages.telemetry)) is not None:
            self.operator.telemetry(arrival, t)

    def _send_state(self, t: float) -> None:
        if self._messages.state_due(t, self.vehicle.run.decision):
            self._send_message(t, self._messages.state)

    def _send_message(self, t: float, size: int) -> float | None:
        """When a message of the control link arrives; None: not before another one.

        A lost segment holds up the connection until TCP repeats it, and later messages are left out meanwhile
        (`MqttLink.is_behind`); the repetition itself is not simulated.
        """
        way = self._control_way(t)
        if not self.conditions.control:
            return t + way.link.one_way_s
        if t < self._held_up_until:
            return None
        arrival = t
        for part in segments(size):
            left = way.link.queue.put(t, part)
            if left is None or way.link.loses(left):
                self._held_up_until = t + RTO_S
                return None
            arrival = way.arrival(left)
            self.done.others.extend((arrival, part))
        return arrival

    def _schedule_frame(self, t: float, name: str, captured: float) -> None:
        """Frames of a camera stay in order, however late one is sent."""
        late_s = self.conditions.late_s
        sent = captured + ENCODED_S + (self._rng.expovariate(1 / late_s) if late_s else 0.0)
        self._at(max(t, sent), self._send_frame, (name, captured))

    def _send_frame(self, t: float, what: tuple[str, float]) -> None:
        name, captured = what
        encoder = self.encoders[name]
        self._schedule_frame(t, name, captured + encoder.interval_s)
        key, size = encoder.key, encoder.frame()
        if not size:
            return
        self.vehicle.sent(name, captured, t)
        ways = [self.ways[uplink] for uplink in encoder.uplinks or self.ways]
        puts = [way.put_frame(t, name, size) for way in ways]
        for way, own in zip(ways, puts, strict=True):
            if way.receiver is not self.operator:
                way.deliver(t, name, captured, own)
        put = merged(puts)
        if put.missing:
            self.done.lost.extend([t] * len(put.missing))
        if not put.packets:
            self._lost(name, captured, t, put, t + encoder.interval_s)
            return
        self.done.waits.extend((t, put.left - t))
        self.done.frames.extend((put.last, put.carried))
        self.done.arrivals[name].append(put.last)
        frame = framed(name, captured, put, ways[0].receiver.arrived)
        self.recorder.frame(frame)
        self.operator.frame(frame, put.last + TAIL_S if put.tail else put.last)
        if put.missing:
            self._lost(name, captured, t, put, put.last)
        elif key:
            self.operator.key_frame(name, captured, put.last)

    def _control_way(self, t: float) -> Way:
        """The first way that is not cut: the control link goes over all of them."""
        living = (way for way in self.ways.values() if not way.link.cuts or way.link.cut_at(t) is None)
        return next(living, next(iter(self.ways.values())))

    # --- repair ---

    def _lost(self, name: str, captured: float, sent: float, put: Put, last: float) -> None:
        """Packets of a frame are lost; those at its end are missed only a while after the last that arrived."""
        sizes, tail = list(put.missing.values()), put.tail
        self.operator.missing(len(sizes), last + TAIL_S if tail else last)
        loss = Loss(name, captured, sizes, last + self.operator.wait_s())
        self._at(loss.due, self._check_repaired, loss)
        if self.operator.repairs_s and not self.operator.congested:
            noticed = last + (TAIL_S if tail else REORDER_S)
            self._at(noticed, self._request, (loss, sent))

    def _request(self, t: float, what: tuple[Loss, float]) -> None:
        """The operator's side requests what is missing, and again if it does not come."""
        loss, sent = what
        if loss.complete is not None or t >= loss.due or self.operator.congested:
            return
        self._at(t + max(RETRY_S, self.operator.rtt_s), self._request, what)
        link = self._control_way(t).link
        if not link.loses_back():
            self._at(t + link.back_after_s(t), self._repeat, (loss, sent, t))

    def _repeat(self, t: float, what: tuple[Loss, float, float]) -> None:
        """The vehicle sends lost packets again."""
        loss, sent, requested = what
        if t - sent > self.operator.repairs_s or not loss.sizes:
            return
        header, way, still = self._sizes[loss.camera][1] + REPEATED, self._repeating_way(loss.camera), []
        packets, arrived = way.receiver.arrived
        for part in loss.sizes:
            left = way.link.queue.put(t, part + header)
            if left is None or way.link.loses(left):
                still.append(part)
                continue
            packets, arrived = packets + 1, arrived + part
            at = way.arrival(left)
            self.done.others.extend((at, part + header))
            self.operator.rtt_s += (at - requested - self.operator.rtt_s) / 8
        way.receiver.arrived = (packets, arrived)
        loss.sizes = still
        if not still:
            loss.complete = way.newest

    def _repeating_way(self, camera: str) -> Way:
        """The first way of a camera that is not known to have stalled."""
        shares, names = self.vehicle.run.decision.uplinks, self.encoders[camera].uplinks or tuple(self.ways)
        return self.ways[next((name for name in names if name in shares and not shares[name].stalled), names[0])]

    def _check_repaired(self, _: float, loss: Loss) -> None:
        if loss.complete is None or loss.complete > loss.due:
            self.operator.damage(loss)

    # --- reports ---

    def _report(self, t: float, _: None) -> None:
        self._at(t + REPORT_S, self._report, None)
        report = self.operator.report(t)
        for name, way in self.ways.items():
            own = way.receiver.report(t) if name else report
            self._send_report(t, replace(own, uplink=name, as_of=report.as_of, damaged=report.damaged) if name else own)

    def _send_report(self, t: float, report: ReceptionReport) -> None:
        conditions, rng, link = self.conditions, self._rng, self._control_way(t).link
        if conditions.report_loss and rng.random() < conditions.report_loss:
            return
        arrival = link.back_arrival(t, REPORT_BYTES + UNIT_BYTES * len(report.units))
        if conditions.report_jitter_s:
            arrival += rng.expovariate(1 / conditions.report_jitter_s)
        if link.loses_back():  # TCP repeats it one round trip after the next one has arrived (RFC 8985)
            arrival += REPORT_S + link.one_way_s + link.back_s
        self._back_newest = max(self._back_newest, arrival)
        self._at(self._back_newest, self._take_report, report)

    def _take_report(self, t: float, report: Any) -> None:
        self.vehicle.take_report(report, round(t, 6))
        self._send_message(t, 0)
        self._send_state(t)

    # --- other traffic ---

    def _begin_flow(self, t: float, flow: Flow) -> None:
        self._schedule(t, flow, flow.begin(t, self._first_queue))

    def _feedback(self, t: float, what: tuple[Flow, bool, float]) -> None:
        flow, delivered, sent = what
        self._schedule(t, flow, flow.feedback(t, delivered, sent, self._first_queue))

    def _schedule(self, t: float, flow: Flow, sent: Iterable[Feedback]) -> None:
        for when, delivered, at in sent:
            self._at(when, self._feedback, (flow, delivered, at))
        if flow.done():
            self._at(t + flow.pause_s(), self._begin_flow, flow)
