"""One simulated drive: cameras send over the link, the operator's side reports, the rules decide. Pure."""

from __future__ import annotations

import heapq
import random
from array import array
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count
from typing import Any, NamedTuple

from runner.configuration.experiment import TimedRequest
from runner.core.budget import payload_bytes
from runner.core.events import BitratePredicted, ClockAdvanced, Event, parse
from runner.core.step import Run
from runner.link.limit import TcpFlows
from runner.link.losses import LossModel
from runner.pqos import Predictions
from runner.records.reception import Arrival, ReceptionReported
from runner.settings import Setup
from runner.simulation.control import ControlMessages, segments
from runner.simulation.encoder import Encoder, EncoderModel
from runner.simulation.operator import REORDER_S, RETRY_S, TAIL_S, Frame, Loss, Operator
from runner.simulation.queues import Queue
from runner.simulation.steps import Steps
from runner.simulation.tcp import Feedback, Flow
from runner.simulation.vehicle import SimulatedVehicle

ENCODED_S = 0.001  # from the capture of a frame until it is sent, at least
TICK_S, TELEMETRY_S, REPORT_S = 0.1, 0.2, 0.04
REPORT_BYTES, UNIT_BYTES = 170, 62  # of a report in JSON with MQTT's header, and of each frame in it
RTO_S = 0.2  # until TCP repeats a segment (Linux' least)
# Each frame begins with a packet of its own for the access unit delimiter (2 bytes of payload), and only this one has
# the header extension with the capture time. Seen in reports of real drives.
DELIMITER, EXTENSION = 2, 16
UNSTATED_WAVE_S = 1.5  # length of a refresh wave where the graph states none
REPEATED = 2  # bytes by which a repeated packet is longer (RFC 4588)
DelayAt = Callable[[float], float]


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
class Link:
    """From the vehicle to the operator; those that begin with `back` are of the other direction.

    capacity  kbit/s
    queue     in front of it; back None: there is none
    one_way_s, delay_at  delay without any queue, and what is added over time, s
    losses    behind the queue; None: there are none
    tcp       competing flows
    """

    capacity: Steps
    queue: Queue
    one_way_s: float
    back_s: float
    delay_at: DelayAt | None = None
    losses: LossModel | None = None
    back: Queue | None = None
    back_at: DelayAt | None = None
    back_losses: LossModel | None = None
    tcp: TcpFlows | None = None

    def back_after_s(self, t: float) -> float:
        """Delay of a packet to the vehicle without any queue."""
        return self.back_s + (self.back_at(t) if self.back_at else 0.0)

    def back_arrival(self, t: float, size: int) -> float:
        """When a message to the vehicle arrives; a segment that is dropped is repeated later."""
        left: float | None = t
        for part in segments(size) if self.back else ():
            left = self.back.put(t, part) if self.back and left is not None else None
        return (t + RTO_S if left is None else left) + self.back_after_s(t)

    def loses_back(self) -> bool:
        """Whether the next packet to the vehicle is lost."""
        return bool(self.back_losses and self.back_losses.draw())


@dataclass
class Drive:
    """What happened: pairs of time, s, and value, as flat arrays.

    totals       kbit/s that the rules decided, whenever they did
    predictions  kbit/s
    waits        of each frame's last packet in the queue, with its own service, s
    frames       bytes of each frame at its arrival
    others       bytes of repeated packets and of the control link at their arrival
    lost         when packets of the cameras were lost
    tcp_bytes    that competing flows delivered
    damaged_s    by camera
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


class _Put(NamedTuple):
    """A frame on the link.

    packets, bytes         that get through, and their bytes of video
    carried                their bytes on the link
    first_left, last_left  when the first and the last of these leave the queue, s
    begun                  packets and bytes of all cameras that get through, up to the first of these
    missing                bytes of each lost packet
    tail                   how many of these follow the last that gets through
    """

    packets: int
    bytes: int
    carried: int
    first_left: float
    last_left: float
    begun: tuple[int, int]
    missing: list[int]
    tail: int


class Recorder:
    """Writes down nothing."""

    def step(self, before: Run, event: Event, after: Run) -> None: ...
    def reported(self, reported: ReceptionReported) -> None: ...
    def frame(self, frame: Frame) -> None: ...
    def tick(self, t: float, simulation: Simulation) -> None: ...


class Simulation:
    """One drive. Events wait in a heap; packets do not, see `runner.simulation.queues`."""

    def __init__(
        self, setup: Setup, link: Link, pqos: Predictions, duration_s: float, conditions: Conditions, seed: int,
        recorder: Recorder, requests: Sequence[TimedRequest] = (),
    ) -> None:  # fmt: skip
        self.link, self.conditions, self.recorder = link, conditions, recorder
        self._rng = rng = random.Random(seed)
        self.done = Drive(duration_s, link.capacity)
        cameras = setup.vehicle.cameras
        self._sizes = {
            n: (payload_bytes(c.graph), c.graph.settings.header_bytes - EXTENSION) for n, c in cameras.items()
        }
        self.encoders = {n: Encoder(c, conditions.encoder, rng) for n, c in cameras.items()}
        settings = [camera.graph.settings for camera in cameras.values()]
        self.operator = Operator(
            repairs_s=max(one.retransmission_ms for one in settings) / 1000,
            jitter_s=max(one.jitter_buffer_ms for one in settings) / 1000,
            wave_s=2 * max(one.key_interval_s or UNSTATED_WAVE_S for one in settings),
        )
        self.vehicle = SimulatedVehicle(setup, pqos, self.encoders, self._stepped, recorder.reported)
        self._requests = requests
        self._order = count()
        self._events: list[tuple[float, int, Callable[[float, Any], None], Any]] = []
        self._newest = 0.0  # arrival of the newest packet: packets stay in order
        self._held_up_until = 0.0  # the control link
        self._back_newest = 0.0  # arrival of the newest report
        self._flows = [
            Flow(flows, link.one_way_s + link.back_s, random.Random(number))
            for flows in ([link.tcp] if link.tcp else [])
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
            self.done.predictions.extend((event.t, float(event.kbps)))
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
        if not self.conditions.control:
            return t + self.link.one_way_s
        if t < self._held_up_until:
            return None
        arrival, losses = t, self.link.losses
        for part in segments(size):
            left = self.link.queue.put(t, part)
            if left is None or (losses and losses.draw()):
                self._held_up_until = t + RTO_S
                return None
            arrival = self._arrival(left)
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
        put = self._put_packets(t, name, size)
        if put.missing:
            self.done.lost.extend([t] * len(put.missing))
        if not put.packets:
            self._lost(name, captured, t, put.missing, t + encoder.interval_s, put.tail)
            return
        first, last = self._arrival(put.first_left), self._arrival(put.last_left)
        self.done.waits.extend((t, put.last_left - t))
        self.done.frames.extend((last, put.carried))
        whole, ended = not put.missing, self.operator.arrived
        frame = Frame(name, Arrival(last, captured, put.bytes, whole, first), put.begun, ended, put.packets)
        self.recorder.frame(frame)
        self.operator.frame(frame, last + TAIL_S if put.tail else last)
        if not whole:
            self._lost(name, captured, t, put.missing, last, put.tail)
        elif key:
            self.operator.key_frame(name, captured, last)

    def _put_packets(self, t: float, name: str, size: int) -> _Put:
        """Put a frame's packets on the link one after the other, as `udpsink` does with the list of a payloader."""
        payload, header = self._sizes[name]
        put, losses = self.link.queue.put, self.link.losses
        before, arrived = self.operator.arrived
        first_left = last_left = 0.0
        begun = (0, 0)
        packets = received = carried = tail = 0
        missing: list[int] = []
        part, wire = DELIMITER, DELIMITER + header + EXTENSION
        while True:
            left = put(t, wire)
            if left is None or (losses is not None and losses.draw()):
                missing.append(part)
                tail += 1
            else:
                tail = 0
                packets += 1
                received += part
                carried += wire
                last_left = left
                if packets == 1:
                    first_left, begun = left, (before + 1, arrived + part)
            if size <= 0:
                break
            part = size if size < payload else payload
            size -= part
            wire = part + header
        self.operator.arrived = (before + packets, arrived + received)
        return _Put(packets, received, carried, first_left, last_left, begun, missing, tail)

    def _arrival(self, left: float) -> float:
        """When a packet that has left the queue arrives; packets stay in order."""
        at = left + self.link.one_way_s
        if self.link.delay_at:
            at += self.link.delay_at(left)
        if at < self._newest:
            return self._newest
        self._newest = at
        return at

    # --- repair ---

    def _lost(self, name: str, captured: float, sent: float, sizes: list[int], last: float, tail: int) -> None:
        """Packets of a frame are lost; those at its end are missed only a while after the last that arrived."""
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
        if not self.link.loses_back():
            self._at(t + self.link.back_after_s(t), self._repeat, (loss, sent, t))

    def _repeat(self, t: float, what: tuple[Loss, float, float]) -> None:
        """The vehicle sends lost packets again."""
        loss, sent, requested = what
        if t - sent > self.operator.repairs_s or not loss.sizes:
            return
        header, losses, still = self._sizes[loss.camera][1] + REPEATED, self.link.losses, []
        packets, arrived = self.operator.arrived
        for part in loss.sizes:
            left = self.link.queue.put(t, part + header)
            if left is None or (losses is not None and losses.draw()):
                still.append(part)
                continue
            packets, arrived = packets + 1, arrived + part
            at = self._arrival(left)
            self.done.others.extend((at, part + header))
            self.operator.rtt_s += (at - requested - self.operator.rtt_s) / 8
        self.operator.arrived = (packets, arrived)
        loss.sizes = still
        if not still:
            loss.complete = self._newest

    def _check_repaired(self, _: float, loss: Loss) -> None:
        if loss.complete is None or loss.complete > loss.due:
            self.operator.damage(loss)

    # --- reports ---

    def _report(self, t: float, _: None) -> None:
        self._at(t + REPORT_S, self._report, None)
        report = self.operator.report(t)
        conditions, rng = self.conditions, self._rng
        if conditions.report_loss and rng.random() < conditions.report_loss:
            return
        arrival = self.link.back_arrival(t, REPORT_BYTES + UNIT_BYTES * len(report.units))
        if conditions.report_jitter_s:
            arrival += rng.expovariate(1 / conditions.report_jitter_s)
        if self.link.loses_back():  # TCP repeats it one round trip after the next one has arrived (RFC 8985)
            arrival += REPORT_S + self.link.one_way_s + self.link.back_s
        self._back_newest = max(self._back_newest, arrival)
        self._at(self._back_newest, self._take_report, report)

    def _take_report(self, t: float, report: Any) -> None:
        self.vehicle.take_report(report, round(t, 6))
        self._send_message(t, 0)
        self._send_state(t)

    # --- other traffic ---

    def _begin_flow(self, t: float, flow: Flow) -> None:
        self._schedule(t, flow, flow.begin(t, self.link.queue))

    def _feedback(self, t: float, what: tuple[Flow, bool, float]) -> None:
        flow, delivered, sent = what
        self._schedule(t, flow, flow.feedback(t, delivered, sent, self.link.queue))

    def _schedule(self, t: float, flow: Flow, sent: Iterable[Feedback]) -> None:
        for when, delivered, at in sent:
            self._at(when, self._feedback, (flow, delivered, at))
        if flow.done():
            self._at(t + flow.pause_s(), self._begin_flow, flow)
