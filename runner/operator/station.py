"""State of the operator's side: the vehicle's messages and the reception of each camera, for table and page."""

from __future__ import annotations

import secrets
import threading
import time
import uuid
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

from msgspec import UNSET

from runner.configuration import agreement
from runner.core.events import Attention
from runner.mqtt.link import ControlLink
from runner.mqtt.login import Login
from runner.mqtt.messages import (
    OPERATOR_GONE,
    SIGNED_OFF,
    SILENT_S,
    JsonObject,
    MqttMessage,
    answer_s,
    is_online,
    of_run,
    read_clock,
    read_reply,
    read_settings,
    read_state,
    read_steering,
    read_telemetry,
    topic,
)
from runner.operator.meter import MeasuredRates, ReceptionMeter, StreamCounters
from runner.operator.notes import decision_note
from runner.operator.packet_count import PacketCount
from runner.records import (
    Arrival,
    Arrivals,
    CameraSample,
    CameraState,
    CameraTelemetry,
    LatencyStages,
    Note,
    Outcome,
    ReceptionReport,
    Sample,
    Telemetry,
    UnitReceived,
    VehicleState,
    to_json,
)
from runner.security.keyring import Keyring
from runner.settings import Setup
from runner.system.clocks import KEPT_S, MOST_DRIFT, STEP_S, ClockComparison, ClockDifference, Exchange, latency
from runner.system.held_up import LateCheck
from runner.system.kernel_clock import clock_error_s, wall_ahead_s
from runner.system.recent import CURRENT_S

CLOCK_S = 0.2  # between two comparisons of the clocks
READINGS = 8  # latencies of a camera that may still be confirmed
MAX_VEHICLES = 100  # whose names are remembered
ONE_WAY_S = 10.0  # how long a silent vehicle may still receive: an outage of one direction must not end its streams
FOUND_S = 2.0  # a vehicle that the broker does not know after this time is probably misspelt

OnReply = Callable[[Outcome], None]


class Listener:
    """Called, from any thread, with updates; a subclass overrides the methods it needs. Times are s since 1970."""

    def on_state(self, state: VehicleState | None) -> None:
        """The vehicle's state; None: it is offline."""

    def on_sample(self, sample: Sample) -> None:
        """The reception of all cameras, a few times a second."""

    def on_steering(self, at: float, rad: float) -> None:
        """The steering angle reported to the vehicle; `at` is by this machine's clock."""

    def on_note(self, note: Note) -> None:
        """A message for the operator."""

    def on_link(self, link: LinkState) -> None:
        """The control link of this side, whenever what there is to say about it changes."""


class LinkState(NamedTuple):
    """What there is to say about the control link.

    fault     why there is none; None: there is one, or it has only just been lost
    expiring  a sentence about each certificate of either side that expires soon
    """

    fault: str | None = None
    expiring: tuple[str, ...] = ()


class CameraRow(NamedTuple):
    """One camera: its rates and counters, and its state on the vehicle, if known."""

    name: str
    rates: MeasuredRates
    received: StreamCounters
    state: CameraState | None


class _PendingRequest(NamedTuple):
    on_reply: OnReply | None
    event: str
    until: float


class Station:
    """One operator's end of the control link, and the measurements of reception.

    settings   those that must agree with the vehicle's configuration, see `runner.configuration.agreement`
    keyring    of this operator; None: no authentication, under a random id
    listeners  must be added before `connect`

    Requests go out through `ask`; samples of the cameras' counters come in through `take`.
    """

    def __init__(self, setup: Setup, settings: agreement.SettingsByPath, keyring: Keyring | None = None) -> None:
        vehicle = setup.vehicle
        self._vehicle, self._settings = vehicle, settings
        login = Login(keyring, self.note) if keyring else None
        self.user = login.user if login else None  # this operator's name in its keys; None: it has none
        self.identity = self.user or uuid.uuid4().hex[:12]  # of this operator
        self.answer_s = answer_s(setup.expires_s)
        self.listeners: list[Listener] = []
        self.state: VehicleState | None = None  # None: the vehicle is offline
        self._published: VehicleState | None = None  # the last state that the vehicle published
        self.attention: Attention | None = None  # of the driver, as the page detects it
        self._telemetry: Telemetry | None = None
        self._signed_off = False  # the vehicle, by itself or through its last will
        self._vehicle_time = (0.0, 0.0)  # the vehicle's time in the newest telemetry, and when it arrived
        self._last_message = 0.0
        self._vehicles: dict[str, bool] = {}  # by name, for those known to the broker: whether online
        self._connected_at: float | None = None
        self.link_state = LinkState()
        self._differences: str | None = None  # between both sides' configurations
        self._noted_differences: str | None = None  # as reported
        self._pending: dict[str, _PendingRequest] = {}
        self._lock = threading.Lock()
        self.meters = {name: ReceptionMeter(float(camera.fps)) for name, camera in vehicle.cameras.items()}
        self.clock: ClockDifference | None = None  # the vehicle's against this machine's; None: unknown
        self._clocks = ClockComparison()
        self._clock_requests: deque[float] = deque(maxlen=round(KEPT_S / CLOCK_S))  # `sent` of unanswered reports
        self._clock_due = 0.0  # time.monotonic of the next request
        # By camera, time and value of latencies by both clocks: valid once a later exchange shows that no clock was set
        # meanwhile.
        self._readings: dict[str, deque[tuple[float, float]]] = {name: deque(maxlen=READINGS) for name in self.meters}
        self._wall_ahead_s = 0.0  # of the monotonic clock, at the newest exchange
        self._set_back = float("-inf")  # when a capture time went backwards: the vehicle's clock was set
        self.samples: Mapping[str, StreamCounters] = {}
        self._rates: dict[str, MeasuredRates] = {}
        self._newest: Mapping[str, Arrival] = {}  # by camera
        self._sampled = 0.0  # time.monotonic of `samples`
        self._late = LateCheck()
        self._packets = PacketCount()
        self._delay_s: float | None = None  # of the first access unit: reported delays are relative to it
        self._run = secrets.randbits(32)  # identifies the reports of this process
        listen = {
            topic("+", "state"): self._on_any_state,
            topic(vehicle.name, "reply", self.identity): self._on_reply,
            topic(vehicle.name, "clock", self.identity): self._on_clock,
            topic(vehicle.name, "telemetry"): self._on_telemetry,
            topic(vehicle.name, "steering"): self._on_steering,
            topic(vehicle.name, "configuration"): self._on_configuration,
        }
        self._requests = topic(vehicle.name, "request", self.identity)
        self._receptions = topic(vehicle.name, "reception", self.identity)
        will = (self._requests, of_run(OPERATOR_GONE, self._run))
        self.link = ControlLink(setup.control, will, listen, self._on_connected, self.note, login)

    def connect(self) -> None:
        """Connect to the broker, and stay connected; returns immediately."""
        self.link.connect()

    def close(self) -> None:
        self.state = None  # so that signing off is not reported as a loss
        self.link.close((self._requests, of_run(SIGNED_OFF, self._run)))

    def ask(self, event: JsonObject, on_reply: OnReply | None = None) -> None:
        """Send a request to the vehicle.

        on_reply  called with its outcome: applied (read back from the elements), refused, expired or timed out
        """
        if self.state is None:
            if on_reply:
                reason = self.link.fault or "the vehicle is offline"
                on_reply(Outcome(self._vehicle_time[0], "refused", reason))
            return
        identity, now = uuid.uuid4().hex, time.monotonic()
        with self._lock:
            self._pending[identity] = _PendingRequest(on_reply, event["event"], now + self.answer_s)
        self.link.publish(self._requests, {**event, "id": identity, "as_of": self._vehicle_now(now)})

    def _announce(self, now: float) -> None:
        """Announce this operator as present, also to a vehicle that is temporarily silent."""
        if self.state is not None:
            self.ask(self._presence())
        elif self._may_reach_vehicle(now):
            event = {**self._presence(), "id": uuid.uuid4().hex, "as_of": self._vehicle_now(now)}
            self.link.publish(self._requests, event)

    def _presence(self) -> JsonObject:
        attention = self.attention  # another thread may replace it
        return {"event": "operator_connected", **({"attention": attention} if attention else {})}

    def _may_reach_vehicle(self, now: float) -> bool:
        """Whether the vehicle may still receive from this side: it sent recently and did not sign off."""
        return not self._signed_off and 0 < now - self._vehicle_time[1] <= ONE_WAY_S and self._vehicle_time[0] > 0

    def _vehicle_now(self, now: float) -> float:
        """The vehicle's time in the newest telemetry, plus the time since."""
        t, arrived = self._vehicle_time
        return round(t + now - arrived, 6)

    def note(self, text: str) -> None:
        note = Note(time.time(), text)
        for listener in self.listeners:
            listener.on_note(note)

    def report(self, camera: str, what: str) -> None:
        """An event of a camera, as `OperatorSide` reports it."""
        self.note(f"{camera}: {what}")

    def captured_here(self, name: str, captured: float | None) -> float | None:
        """Convert a camera's capture time, s since 1970, from the vehicle's clock to this machine's; None: unknown."""
        return None if captured is None or self.untimed(name) else self._to_own_clock(captured)

    def _to_own_clock(self, at: float) -> float | None:
        """Convert a past time, s since 1970, from the vehicle's clock to this machine's; None: unknown."""
        clock = self.clock  # another thread may replace it
        if clock is None or self._was_set():
            return None
        here = at - clock.ahead_s
        return here if here <= time.time() + clock.bound_s else None  # in the future: a clock was set

    def untimed(self, name: str) -> bool:
        """Whether the vehicle does not know when a camera's pictures are captured."""
        camera = self._camera(name)
        return camera is not None and camera.untimed is True

    def sending(self) -> dict[str, bool]:
        """Which cameras should send, according to the vehicle; empty while the vehicle is offline.

        A camera whose source is being replaced sends nothing, but keeps its session.
        """
        state = self.state  # another thread may replace it
        cameras = state.cameras if state else {}
        return {name: camera.sending and not camera.fault for name, camera in cameras.items()}

    def take(self, samples: Mapping[str, StreamCounters]) -> None:
        """Process a sample of all counters; to be called a few times a second, since it also checks timeouts."""
        now = time.monotonic()
        is_excused = self._late.is_excused(now)
        if self.state and now - self._last_message > SILENT_S and not is_excused:
            self._vehicle_lost(f"the vehicle has been silent for {SILENT_S:g} s")
        self._time_out(now)
        self._check_link()
        self._check_vehicle_name(now)
        self._announce(now)  # the heartbeat
        self._compare_clocks(now)
        samples = {name: self._with_latency(name, received, now) for name, received in samples.items()}
        for name, received in samples.items():
            self._rates[name] = self.meters[name].add(now, received, self._camera(name))
        self.samples, self._sampled = samples, now
        sample = self._sample()
        for listener in self.listeners:
            listener.on_sample(sample)

    def may_report(self) -> bool:
        """Whether a report would be sent immediately. While earlier ones wait, arrivals accumulate for the next."""
        return not self.link.is_behind()

    def report_reception(self, arrivals: Arrivals) -> None:
        """Report arrivals since the last report to the vehicle; to be called every REPORT_S, by one thread."""
        now = time.monotonic()
        self._check_capture_times(arrivals.newest, now)
        frames = [(name, frame) for name, some in arrivals.frames.items() for frame in some]
        frames.sort(key=lambda each: each[1].arrived)
        if frames and self._delay_s is None:
            self._delay_s = frames[0][1].arrived - frames[0][1].captured
        base = self._delay_s or 0.0
        self._packets.add(arrivals.arrived)
        received = []
        for name, frame in frames:  # in order of arrival, as `carried` needs them
            train = self._packets.between(frame.first or frame.arrived, frame.arrived)
            received.append(UnitReceived.of(name, frame, now, base, train, self._packets.carried(frame.arrived)))
        if not self._may_reach_vehicle(now):
            return
        counts = (arrivals.packets, arrivals.lost)
        report = ReceptionReport(round(now, 4), self._vehicle_now(now), tuple(received), *counts, run=self._run)
        if received:
            report = replace(report, offset_s=round(base, 4))
        if arrivals.damaged:
            report = replace(report, damaged=tuple(arrivals.damaged))
        if (latency_ms := self._worst_latency_ms(now)) is not None:
            report = replace(report, latency_ms=round(latency_ms, 1))
        if now >= self._clock_due:
            self._clock_due = now + CLOCK_S
            sent = time.time()
            with self._lock:
                self._clock_requests.append(sent)
            report = replace(report, sent=sent)
        self.link.publish(self._receptions, to_json(report), behind=True)  # its arrivals are in no other report

    def _worst_latency_ms(self, now: float) -> float | None:
        """Upper bound of the latency of the slowest displayed picture, ms; None: unknown, or nothing is displayed.

        Unknown if any source has a fault. For each camera it is the greater of the newest access unit's latency to
        arrival and the last sampled one's to decoding, plus the time by which the next one is overdue.
        """
        clock, state, found = self.clock, self.state, []
        if self._was_set():
            return None
        wall = time.time() - now  # of the monotonic clock
        for name, camera in (state.cameras if state else {}).items():
            if not camera.sending or name not in self._vehicle.cameras:
                continue
            if camera.fault or self.untimed(name):  # it may repeat a picture, whose age is unknown
                return None
            sampled, newest = self.samples.get(name), self._newest.get(name)
            if not clock or not newest or not sampled or sampled.latency_ms is None or now - self._sampled > CURRENT_S:
                return None
            arrived_ms = latency(1000 * (wall + newest.arrived - newest.captured), clock)
            if arrived_ms is None or self._clocks.was_set_since(newest.arrived - arrived_ms / 1000):
                return None
            overdue_s = max(0.0, now - newest.arrived - 1 / float(self._vehicle.cameras[name].fps))
            found.append(max(sampled.latency_ms, arrived_ms) + 1000 * overdue_s)
        return max(found) + 1000 * clock.bound_s if found and clock else None

    def rows(self) -> list[CameraRow]:
        return [
            CameraRow(name, self._rates[name], received, self._camera(name)) for name, received in self.samples.items()
        ]

    def headline(self) -> str:
        state = self.state  # another thread may replace it
        if state is None:
            return f"{self._vehicle.name}: {self.link.fault or 'offline'}"
        clock = self.clock
        latencies = f"latencies ± {1000 * clock.bound_s:.1f} ms" if clock else "latencies still unknown"
        return f"{self._vehicle.name}, mode {state.mode}, total {state.total_words} kbit/s, {latencies}"

    def _compare_clocks(self, now: float) -> None:
        with self._lock:
            before, self.clock = self.clock, self._clocks.difference(now)
        if self.clock is None and before is not None and self.state:
            unstated = f"the vehicle has not stated its clock for {KEPT_S:g} s"
            why = "a clock was stepped" if self._clocks.was_set else unstated
            self.note(f"{why}: latencies are unknown")

    def _with_latency(self, name: str, received: Any, now: float) -> StreamCounters:
        """Counters with the latency corrected for the clock difference; None if that is unknown."""
        readings = self._readings[name]
        if received.latency_ms is not None and (not readings or readings[-1][0] != received.latency_at):
            readings.append((received.latency_at, received.latency_ms))
        latency_ms = None if self.untimed(name) else self._latency_ms(readings, now)
        counters: StreamCounters = replace(received, latency_ms=latency_ms)
        return counters

    def _latency_ms(self, readings: Iterable[tuple[float, float]], now: float) -> float | None:
        """The newest confirmed one; without the control link, which reveals that clocks were set, the newest."""
        silent = now - self._clocks.last_sent > CURRENT_S
        recent = [(at, raw_ms) for at, raw_ms in readings if now - at <= CURRENT_S]
        for at, raw_ms in reversed(recent):
            latency_ms = latency(raw_ms, self.clock)
            if latency_ms is not None and (silent or self._clocks.held(at - latency_ms / 1000, at)):
                return latency_ms
        return None

    def _check_capture_times(self, newest: Mapping[str, Arrival], now: float) -> None:
        """Detect that the vehicle's clock was set back, before the next exchange shows it."""
        before, self._newest = self._newest, newest
        if any(name in before and arrival.captured < before[name].captured for name, arrival in newest.items()):
            self._set_back = now

    def _was_set(self) -> bool:
        """Whether this machine's clock was set, or the vehicle's was set back, and no exchange has followed."""
        set_back = self._clocks.last_sent < self._set_back and self._set_back > time.monotonic() - CURRENT_S
        return set_back or abs(wall_ahead_s() - self._wall_ahead_s) > STEP_S + MOST_DRIFT * KEPT_S

    def _sample(self) -> Sample:
        telemetry = self._telemetry if self.state else None
        measured = telemetry.cameras if telemetry else {}
        cameras = {row.name: _camera_sample(row, measured.get(row.name)) for row in self.rows()}
        return Sample(
            t=time.time(),
            predicted_kbps=telemetry.predicted_kbps if telemetry else None,
            allocated_kbps=sum(camera.allocated_kbps for camera in cameras.values()),
            actual_kbps=round(sum(camera.kbps for camera in cameras.values()), 1),
            position=telemetry.position if telemetry else None,
            refused=telemetry.refused if telemetry else 0,
            cameras=cameras,
            dropped=self.link.dropped,
            speed_factor=telemetry.speed_factor if telemetry else None,
            clock_ahead_ms=round(1000 * self.clock.ahead_s, 3) if self.clock else None,
            clock_bound_ms=round(1000 * self.clock.bound_s, 3) if self.clock else None,
        )

    def _camera(self, name: str) -> CameraState | None:
        state = self.state
        return state.cameras.get(name) if state else None

    def _on_any_state(self, message: MqttMessage) -> None:
        """The state of any vehicle at the broker; of other vehicles only the name is used."""
        name = message.topic.split("/")[1]
        is_own = name == self._vehicle.name
        state = read_state(message.payload) if is_own else None
        if len(self._vehicles) < MAX_VEHICLES or name in self._vehicles:
            self._vehicles[name] = state is not None if is_own else is_online(message.payload)
        if not is_own:
            return
        self._published = state
        self._signed_off = state is None
        if state:
            self._note_differences()
            self._vehicle_online()
        else:
            self._vehicle_lost("the vehicle is offline")

    def _vehicle_online(self) -> None:
        """The vehicle is online once state and telemetry have arrived."""
        before, state = self.state, self._published
        self._last_message = time.monotonic()
        if state is None or before is state or not self._telemetry:
            return
        self._set_state(state)
        if before:
            self._note_changes(before, state)
        else:
            self.note(f"the vehicle is online, mode {state.mode}")
            self.ask(self._presence())

    def _set_state(self, state: VehicleState | None) -> None:
        self.state = state
        for listener in self.listeners:
            listener.on_state(state)

    def _note_changes(self, before: VehicleState, state: VehicleState) -> None:
        """A note about a decision, and one when the rules fail or recover."""
        if state.fault != before.fault:
            self.note(
                f"{state.fault}; the previous decision stays in force" if state.fault else "the rules decide again"
            )
        if text := decision_note(before, state):
            self.note(text)

    def _on_telemetry(self, message: MqttMessage) -> None:
        telemetry = read_telemetry(message.payload)
        if message.retained:  # old: no heartbeat, and not the vehicle's current time
            return
        self._vehicle_time = (telemetry.t, time.monotonic())
        self._telemetry = telemetry
        self._vehicle_online()

    def _on_steering(self, message: MqttMessage) -> None:
        steering = read_steering(message.payload)
        at = None if message.retained else self._to_own_clock(steering.at)
        if at is not None:
            for listener in self.listeners:
                listener.on_steering(at, steering.rad)

    def _on_clock(self, message: MqttMessage) -> None:
        returned, now, answer = time.time(), time.monotonic(), read_clock(message.payload)
        own_set_s = wall_ahead_s()
        own_s = clock_error_s()
        errors_s = None if own_s is None or answer.error_s is None else own_s + answer.error_s
        with self._lock:
            if not message.retained and answer.sent in self._clock_requests:
                self._clock_requests.remove(answer.sent)
                set_s = (own_set_s, answer.set_s)
                self._clocks.add(
                    now, Exchange(answer.sent, answer.received, answer.answered, returned, set_s, errors_s)
                )
                self._wall_ahead_s = own_set_s

    def _on_configuration(self, message: MqttMessage) -> None:
        self._differences = agreement.differences(self._settings, read_settings(message.payload).settings)
        self._note_differences()

    def _note_differences(self) -> None:
        """Report where the vehicle's configuration differs from this side's, once it is online.

        What the broker has stored may be of a vehicle that ended long ago.
        """
        if self._published is None or self._differences == self._noted_differences:
            return
        self._noted_differences = self._differences
        if self._differences:
            self.note(f"the vehicle's configuration differs: {self._differences}")

    def _check_link(self) -> None:
        state, ends = self.state, dict(self.link.certificate_ends())
        if state and state.certificate_ends is not UNSET:
            ends["the vehicle's"] = state.certificate_ends
        before, self.link_state = self.link_state, LinkState(self.link.fault, _expiring(ends))
        if self.link_state != before:
            for listener in self.listeners:
                listener.on_link(self.link_state)

    def _check_vehicle_name(self, now: float) -> None:
        """Report once which vehicles are online, if this one is unknown to the broker."""
        if self._connected_at is None or now - self._connected_at < FOUND_S:
            return
        self._connected_at = None
        if self._vehicle.name not in self._vehicles:
            online = sorted(name for name, is_online in self._vehicles.items() if is_online)
            known = f"online: {', '.join(online)}" if online else "no vehicle is online"
            self.note(f"the broker has no vehicle named {self._vehicle.name}; {known}")

    def _on_reply(self, message: MqttMessage) -> None:
        reply = read_reply(message.payload)
        with self._lock:
            pending = self._pending.pop(reply.id, None)
        if pending is None:
            return
        if pending.on_reply:
            pending.on_reply(reply)
        elif reply.result == "refused":
            self.note(f"{pending.event} refused: {reply.reason}")

    def _time_out(self, now: float) -> None:
        with self._lock:
            expired = {identity: each for identity, each in self._pending.items() if now > each.until}
            for identity in expired:
                del self._pending[identity]
        for pending in expired.values():
            if pending.on_reply:
                reason = f"no answer from the vehicle within {self.answer_s:g} s"
                pending.on_reply(Outcome(self._vehicle_now(now), "timed out", reason))

    def _on_connected(self, connected: bool) -> None:
        self._connected_at = time.monotonic() if connected else None
        if not connected:
            self._published = None
            self._vehicle_lost("the control link is lost")

    def _vehicle_lost(self, why: str) -> None:
        if self.state:
            self.note(why)
        self._telemetry = None
        self._set_state(None)


def _expiring(ends: Mapping[str, float]) -> tuple[str, ...]:
    if not ends:  # as without keys
        return ()
    from runner.security.validity import expiring

    return tuple(expiring(ends, time.time()))


def _camera_sample(row: CameraRow, measured: CameraTelemetry | None) -> CameraSample:
    received, state = row.received, row.state
    return CameraSample(
        fps=round(row.rates.fps, 1),
        kbps=round(row.rates.kbps, 1),
        allocated_kbps=state.kbps if state else 0,
        demand_kbps=state.demand_kbps if state else 0,
        scaling=state.scaling if state else None,
        width=received.width,
        height=received.height,
        latency_ms=received.latency_ms,
        lost=received.lost,
        rebuilt=received.rebuilt,
        foreign=received.foreign,
        frames=received.frames,
        bytes=received.bytes,
        arrivals=(),
        damaged=received.damaged,
        buffer_ms=received.buffer_ms,
        stages_ms=_stages(received, measured),
    )


def _stages(received: StreamCounters, measured: CameraTelemetry | None) -> LatencyStages:
    """The parts of a camera's latency: those that each side has measured, and the link as the remainder."""
    capture, encode = (measured.capture_ms, measured.encode_ms) if measured else (None, None)
    buffer, decode, total = received.waited_ms, received.decode_ms, received.latency_ms
    parts = [part for part in (capture, encode, buffer, decode) if part is not None]
    link = total - sum(parts) if total is not None and len(parts) == 4 else None
    if link is not None and link < 0:  # the parts are of other pictures than the latency, by up to a second
        link = None
    return LatencyStages(*(None if ms is None else round(ms, 2) for ms in (capture, encode, link, buffer, decode)))
