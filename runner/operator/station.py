"""State of the operator's side: the vehicle's messages and the reception of each camera, for table and page."""

from __future__ import annotations

import secrets
import time
from collections.abc import Mapping, Sequence
from enum import Enum, auto
from typing import TYPE_CHECKING, NamedTuple

from msgspec import UNSET, UnsetType

from runner.configuration import agreement
from runner.core.budget import SOUND
from runner.core.decision import NOTHING
from runner.core.events import BACK_S, NAMES, Attention, Gear, MomentMarked
from runner.mqtt.copies import Newest
from runner.mqtt.link import ControlLink, login_of
from runner.mqtt.messages import (
    OPERATOR_GONE,
    SIGNED_OFF,
    SILENT_S,
    JsonObject,
    MqttMessage,
    answer_s,
    is_online,
    of_run,
    read_settings,
    read_state,
    read_steering,
    read_telemetry,
    topic,
)
from runner.operator.latency import Latency, stages
from runner.operator.meter import MeasuredRates, ReceptionMeter
from runner.operator.notes import Refusals, change_notes, driver_words
from runner.operator.reception import ReceptionReports
from runner.operator.requests import OnReply, Requests
from runner.operator.seen import StatedView
from runner.operator.sound import sound_sample, sound_words
from runner.operator.uplinks import UplinkRow, uplink_rows
from runner.records import combined, to_json
from runner.records.lines import Note
from runner.records.operator import CameraSample, Sample, SoundSample
from runner.records.reception import NOTHING_ARRIVED, Arrivals, UplinkReceived
from runner.records.vehicle import (
    NOTHING_ENCODED,
    CameraState,
    CameraTelemetry,
    Telemetry,
    UplinkLost,
    UplinkMeasured,
    VehicleState,
)
from runner.security.keyring import Keyring
from runner.settings import Setup
from runner.system.held_up import LateCheck
from runner.system.kept import KeptIdentity

if TYPE_CHECKING:
    from runner.apply import Reception, SoundReception

MAX_VEHICLES = 100  # whose names are remembered
ONE_WAY_S = 10.0  # how long a silent vehicle may still receive: an outage of one direction must not end its streams
FOUND_S = 2.0  # a vehicle that the broker does not know after this time is probably misspelt


class Presence(Enum):
    """How an operator's side shows itself to the vehicle."""

    ABSENT = auto()  # it only hears what the vehicle publishes
    WATCHING = auto()  # it is sent pictures, but must not be given control
    DRIVING = auto()  # it drives, or would


class Listener:
    """Called, from any thread, with updates; a subclass overrides the methods it needs. Times are s since 1970."""

    def on_state(self, state: VehicleState | None) -> None:
        """The vehicle's state; None: it is offline."""

    def on_sample(self, sample: Sample) -> None:
        """The reception of all cameras, a few times a second."""

    def on_steering(self, at: float, rad: float, gear: Gear | None) -> None:
        """The steering angle reported to the vehicle, and its gear, if known; `at` is by this machine's clock."""

    def on_note(self, note: Note) -> None:
        """A message for the operator."""

    def on_marked(self, back_s: float) -> None:
        """This operator marks the last seconds, whether or not the vehicle hears of it."""

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
    """One camera: its rates and counters, its state on the vehicle, if known, and why the vehicle refuses it, or ""."""

    name: str
    rates: MeasuredRates
    received: Reception
    state: CameraState | None
    refused: str = ""


class _KnownVehicles:
    """The vehicles that the broker knows by name, and whether they are online."""

    def __init__(self) -> None:
        self._online: dict[str, bool] = {}
        self.connected_at: float | None = None

    def add(self, name: str, online: bool) -> None:
        if len(self._online) < MAX_VEHICLES or name in self._online:
            self._online[name] = online

    def lacking(self, name: str, now: float) -> str | None:
        """Which vehicles are online if the broker does not know this one, once after a connection; else None."""
        if self.connected_at is None or now - self.connected_at < FOUND_S:
            return None
        self.connected_at = None
        online = sorted(known for known, is_online in self._online.items() if is_online)
        listed = f"online: {', '.join(online)}" if online else "no vehicle is online"
        return None if name in self._online else f"the broker has no vehicle named {name}; {listed}"


class Station:
    """One operator's end of the control link, and the measurements of reception.

    settings   those that must agree with the vehicle's configuration, see `runner.configuration.agreement`
    keyring    of this operator; None: no authentication, under an id that this machine keeps
    listeners  must be added before `connect`

    Requests go out through `ask`; samples of the cameras' counters come in through `take`.
    """

    def __init__(self, setup: Setup, settings: agreement.SettingsByPath, keyring: Keyring | None = None) -> None:
        vehicle = setup.vehicle
        self._vehicle, self._settings = vehicle, settings
        control, login = setup.control, login_of(setup.control, keyring, self.note)
        self.user = login.identity or None if login else None  # this operator's name in its keys; None: it has none
        self._kept = None if self.user else KeptIdentity(vehicle.name)
        self.identity = self._kept.value if self._kept else str(self.user)  # of this operator
        self.answer_s = answer_s(setup.expires_s)
        self.listeners: list[Listener] = []
        self.state: VehicleState | None = None  # None: the vehicle is offline
        self._published: VehicleState | None = None  # the last state that the vehicle published
        self.attention: Attention | None = None  # of the driver, as the page detects it
        self.seen = StatedView()  # of the cameras
        self._presence = Presence.DRIVING
        self.telemetry: Telemetry | None = None
        self.addresses: Mapping[str, tuple[str, ...]] = {}  # that the vehicle sends from, by uplink, as it last said
        self._newest, self._newest_steering = Newest(), Newest()
        self._uplinks_lost: set[str] = set()  # by their wills, since the vehicle was last heard
        self._signed_off = False  # the vehicle, by itself or through its last will
        self._last_message = 0.0
        self._known = _KnownVehicles()
        self.link_state = LinkState()
        self._differences: str | None = None  # between both sides' configurations
        self._noted_differences: str | None = None  # as reported
        fps = {name: float(camera.fps) for name, camera in vehicle.cameras.items()}
        self.meters = {name: ReceptionMeter(each) for name, each in fps.items()}
        self.samples: Mapping[str, Reception] = {}
        self.sound: SoundSample | UnsetType = UNSET
        self.records_sound = False
        self._rates: dict[str, MeasuredRates] = {}
        self._refusals = Refusals(self.identity)
        self.uplinks: Sequence[UplinkRow] = ()  # none while the vehicle is offline
        self._late = LateCheck()
        self.latency = Latency(fps, self._cameras)
        self._run = secrets.randbits(32)  # identifies the reports of this process
        self._reports = {name: ReceptionReports(self._run, self.latency, name) for name in setup.uplinks or ("",)}
        self._to_request = topic(vehicle.name, "request", self.identity)
        self._to_report = topic(vehicle.name, "reception", self.identity)
        self._requests = Requests(
            lambda request: self.link.publish(self._to_request, request), self.answer_s, self.note
        )
        self.own_time = self._requests.own_time
        listen = {
            topic("+", "state"): self._on_any_state,
            topic(vehicle.name, "reply", self.identity): self._requests.on_reply,
            topic(vehicle.name, "clock", self.identity): self.latency.on_clock,
            topic(vehicle.name, "telemetry"): self._on_telemetry,
            topic(vehicle.name, "steering"): self._on_steering,
            topic(vehicle.name, "configuration"): self._on_configuration,
        }
        will = (self._to_request, of_run(OPERATOR_GONE, self._run))
        self.link = ControlLink(control, will, listen, self._on_connected, self.note, login, prefix=control.prefix)

    def connect(self) -> None:
        """Connect to the broker, and stay connected; returns immediately."""
        self.link.connect()

    def close(self) -> None:
        self.state = None  # so that signing off is not reported as a loss
        self.link.close((self._to_request, of_run(SIGNED_OFF, self._run)))
        if self._kept:
            self._kept.close()

    def ask(self, event: JsonObject, on_reply: OnReply | None = None) -> None:
        """Send a request to the vehicle.

        on_reply  called with its outcome: applied (read back from the elements), refused, expired or timed out
        """
        if event.get("event") == NAMES[MomentMarked]:
            for listener in self.listeners:
                listener.on_marked(float(event.get("back_s", BACK_S)))
        if self.state is None:
            self._requests.refuse(on_reply, self.link.fault or "the vehicle is offline")
        else:
            self._requests.send(event, on_reply)

    def appear(self, presence: Presence) -> None:
        """Show this operator to the vehicle like this from now on; without a call it drives."""
        if presence is self._presence:
            return
        self._presence = presence
        if presence is Presence.ABSENT:
            self.link.publish(self._to_request, of_run(SIGNED_OFF, self._run))
        else:
            self.announce()

    def announce(self) -> None:
        """Announce this operator as present, also to a vehicle that is temporarily silent."""
        if self._presence is Presence.ABSENT:
            return
        attention = self.attention  # another thread may replace it
        presence: JsonObject = {"event": "operator_connected", **({"attention": attention} if attention else {})}
        if self._presence is Presence.WATCHING:
            presence = {"event": "operator_connected", "watching": True}
        is_online = self.state is not None
        if is_online or self._may_reach_vehicle():
            self._requests.send(presence, awaited=is_online)

    def _may_reach_vehicle(self) -> bool:
        """Whether the vehicle may still receive from this side: it sent recently and did not sign off."""
        return not self._signed_off and self._requests.heard_within(ONE_WAY_S)

    def note(self, text: str) -> None:
        note = Note(time.time(), text)
        for listener in self.listeners:
            listener.on_note(note)

    def _cameras(self) -> Mapping[str, CameraState]:
        """The vehicle's cameras by its state; none while it is offline."""
        state = self.state  # another thread may replace it
        return state.cameras if state else {}

    def sending(self) -> dict[str, bool]:
        """Which cameras, and whether the sound, should send, by the vehicle's word; empty while it is offline.

        A camera whose source is being replaced sends nothing, but keeps its session.
        """
        sending = {name: camera.sending and not camera.fault for name, camera in self._cameras().items()}
        state = self.state
        if state and state.sound is not UNSET:
            sending[SOUND] = state.sound.fault is None
        return sending

    def take(
        self,
        samples: Mapping[str, Reception],
        over: Mapping[str, Mapping[str, UplinkReceived]] = NOTHING,
        sound: SoundReception | None = None,
    ) -> None:
        """Process a sample of all counters; to be called a few times a second, since it also checks timeouts.

        over   by camera, what each uplink brought; no camera if the vehicle has one
        sound  None: this side receives none
        """
        now = time.monotonic()
        is_excused = self._late.is_excused(now)
        if self.state and now - self._last_message > SILENT_S and not is_excused:
            self._vehicle_lost(f"the vehicle has been silent for {SILENT_S:g} s")
        self._requests.time_out(now)
        self._check_link()
        if not_found := self._known.lacking(self._vehicle.name, now):
            self.note(not_found)
        self.announce()  # the heartbeat
        if (why := self.latency.compare_clocks(now)) and self.state:
            self.note(f"{why}: latencies are unknown")
        samples, cameras = self.latency.confirm(samples, now), self._cameras()
        for name, received in samples.items():
            self._rates[name] = self.meters[name].add(now, received, cameras.get(name))
        self.samples = samples
        for text in self._refusals.update(samples, cameras, now):
            self.note(text)
        self.sound = sound_sample(sound, self.state, self.latency.clock, self.identity, recorded=self.records_sound)
        sample, state = self._sample(over), self.state
        self.uplinks = uplink_rows(state, sample.uplinks) if state else []
        for listener in self.listeners:
            listener.on_sample(sample)

    def report_reception(self, arrivals: Mapping[str, Arrivals]) -> None:
        """Report arrivals since the last report to the vehicle; to be called at least every REPORT_S, by one thread.

        arrivals  by uplink; "": the vehicle has one
        """
        if self._presence is Presence.ABSENT:
            return
        now = time.monotonic()
        as_of = self._requests.vehicle_now(now) if self._may_reach_vehicle() else None
        view = UNSET if as_of is None else self.seen.report(now)
        for uplink, reports in self._reports.items():
            if report := reports.make(arrivals.get(uplink, NOTHING_ARRIVED), now, as_of, view):
                self.link.publish(self._to_report, to_json(report), behind=True)  # its arrivals are in no other report

    def rows(self) -> list[CameraRow]:
        cameras, refused = self._cameras(), self._refusals.words
        return [
            CameraRow(name, self._rates[name], received, cameras.get(name), refused.get(name, ""))
            for name, received in self.samples.items()
        ]

    def headline(self) -> str:
        state = self.state  # another thread may replace it
        if state is None:
            return f"{self._vehicle.name}: {self.link.fault or 'offline'}"
        clock = self.latency.clock
        latencies = f"latencies ± {1000 * clock.bound_s:.1f} ms" if clock else "latencies still unknown"
        totals = f"{self._vehicle.name}, mode {state.mode}, total {state.total_words} kbit/s, {latencies}"
        lines, driving = [totals], state.driving
        if driving is not UNSET:
            lines.append(driver_words(driving, self.identity, self.own_time(driving.since)))
        return "\n".join(lines if self.sound is UNSET else [*lines, sound_words(self.sound)])

    def _sample(self, over: Mapping[str, Mapping[str, UplinkReceived]]) -> Sample:
        telemetry, clock = self.telemetry if self.state else None, self.latency.clock
        measured = telemetry.cameras if telemetry else {}
        cameras = {
            row.name: _camera_sample(row, measured.get(row.name), over.get(row.name, UNSET)) for row in self.rows()
        }
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
            clock_ahead_ms=round(1000 * clock.ahead_s, 3) if clock else None,
            clock_bound_ms=round(1000 * clock.bound_s, 3) if clock else None,
            uplinks=_uplinks(telemetry),
            sound=self.sound,
        )

    def _on_any_state(self, message: MqttMessage) -> None:
        """The state of any vehicle at the broker; of other vehicles only the name is used."""
        name = message.topic.split("/")[1]
        if name != self._vehicle.name:
            self._known.add(name, is_online(message.payload))
            return
        state = read_state(message.payload)
        if isinstance(state, UplinkLost):
            self._uplinks_lost |= {state.uplink} & self.addresses.keys()
            if self._published and self._uplinks_lost < self.addresses.keys():
                return  # it has others
            state = None
        if state and not self._newest.takes("state", state.t, time.monotonic()):
            return
        self._known.add(name, state is not None)
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
        if state is None or before is state or not self.telemetry:
            return
        self._set_state(state)
        if before:
            for text in change_notes(before, state):
                self.note(text)
        else:
            self.note(f"the vehicle is online, mode {state.mode}")
            self.announce()

    def _set_state(self, state: VehicleState | None) -> None:
        self.state = state
        for listener in self.listeners:
            listener.on_state(state)

    def _on_telemetry(self, message: MqttMessage) -> None:
        telemetry = read_telemetry(message.payload)
        arrived = time.monotonic()
        if message.retained or not self._newest.takes("telemetry", telemetry.t, arrived):
            return  # old: no heartbeat, and not the vehicle's current time
        self._requests.vehicle_time = (telemetry.t, arrived)
        self._uplinks_lost.clear()
        self.telemetry = telemetry
        if telemetry.uplinks is not UNSET:
            self.addresses = {name: each.addresses for name, each in telemetry.uplinks.items()}
        self._vehicle_online()

    def _on_steering(self, message: MqttMessage) -> None:
        steering = read_steering(message.payload)
        at = None if message.retained else self.latency.own_time(steering.at)
        if at is not None and self._newest_steering.takes("steering", steering.at, time.monotonic()):
            for listener in self.listeners:
                listener.on_steering(at, steering.rad, None if steering.gear is UNSET else steering.gear)

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

    def _on_connected(self, connected: bool) -> None:
        self._known.connected_at = time.monotonic() if connected else None
        if not connected:
            self._newest.forget()  # what the broker has kept is said again
            self._published = None
            self._vehicle_lost("the control link is lost")

    def _vehicle_lost(self, why: str) -> None:
        if self.state:
            self.note(why)
        self.telemetry = None
        self._set_state(None)


def holds_control(station: Station) -> bool:
    """Whether this station's operator is in control by the vehicle's word, or was until it was lost."""
    state = station.state  # another thread may replace it
    return state is not None and state.driving is not UNSET and state.driving.holder == station.identity


def _expiring(ends: Mapping[str, float]) -> tuple[str, ...]:
    if not ends:  # as without keys
        return ()
    from runner.security.validity import expiring

    return tuple(expiring(ends, time.time()))


def _uplinks(telemetry: Telemetry | None) -> Mapping[str, UplinkMeasured] | UnsetType:
    """Those over which something has arrived."""
    if telemetry is None or telemetry.uplinks is UNSET:
        return UNSET
    measured = ((name, each.measured) for name, each in telemetry.uplinks.items())
    return {name: each for name, each in measured if each is not UNSET}


def _camera_sample(
    row: CameraRow, measured: CameraTelemetry | None, over: Mapping[str, UplinkReceived] | UnsetType
) -> CameraSample:
    received, state = row.received, row.state
    return combined(
        CameraSample,
        measured or NOTHING_ENCODED,
        received,
        fps=round(row.rates.fps, 1),
        kbps=round(row.rates.kbps, 1),
        allocated_kbps=state.kbps if state else 0,
        demand_kbps=state.demand_kbps if state else 0,
        scaling=state.scaling if state else None,
        arrivals=(),
        stages_ms=stages(received, measured),
        received=over,
        refused=row.refused or UNSET,
    )
