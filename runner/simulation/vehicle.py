"""The vehicle's side: the rules engine, fed as `runner.vehicle.loop` feeds it. Pure."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from msgspec import UNSET

from runner.core.events import ClockAdvanced, ControlPassed, Departure, Event
from runner.core.roles import Role
from runner.core.step import Run, start, step
from runner.errors import RunError
from runner.pqos import Predictions
from runner.records.reception import ReceptionReport, ReceptionReported, SentFrame
from runner.settings import Setup
from runner.simulation.encoder import Encoder
from runner.vehicle.noticed import presence_events
from runner.vehicle.operators import Operators
from runner.vehicle.repair import KeyFrames
from runner.vehicle.sending import SendingTimes
from runner.vehicle.uplink import MeasuredUplinks

OPERATOR = "operator"  # id of the only one
LOOK_S = 0.02  # between two looks at what the payloaders have sent
OnStep = Callable[[Run, Event, Run], None]


@dataclass
class SimulatedVehicle:
    """on_step: called with each event and the run before and after it; on_report: with each reception report."""

    setup: Setup
    pqos: Predictions
    encoders: Mapping[str, Encoder]
    on_step: OnStep
    on_report: Callable[[ReceptionReported], None]
    _sent: deque[tuple[str, SentFrame]] = field(default_factory=deque)  # that were not looked at yet
    _key_frames: KeyFrames = field(default_factory=KeyFrames)

    def __post_init__(self) -> None:
        vehicle = self.setup.vehicle
        self.run = start(vehicle)
        self._uplinks, self._sending = MeasuredUplinks(vehicle), SendingTimes()
        self._operators = Operators(self.setup.expires_s)

    def take(self, event: Event) -> None:
        """Process an event, and the prediction that follows from it."""
        self._step(event)
        for prediction in self.pqos.observe(event):
            self._step(prediction)

    def connect(self, t: float) -> None:
        """The operator's side connects."""
        self._operators.connected(OPERATOR, t)
        self._note_presence(t)

    def tick(self, t: float) -> None:
        """Work that is due ten times a second."""
        self.take(ClockAdvanced(t=t))
        self._operators.expire_silent(t)
        self._note_presence(t)

    def sent(self, camera: str, captured: float, t: float) -> None:
        """A frame has been sent."""
        unsent = t // LOOK_S * LOOK_S
        self._sent.append((camera, SentFrame(captured, unsent, unsent + LOOK_S)))

    def take_report(self, report: ReceptionReport, t: float) -> None:
        """A reception report arrives."""
        self._operators.message_received(OPERATOR, t)
        self._note_presence(t)
        while self._sent and self._sent[0][1].sent <= t // LOOK_S * LOOK_S:
            name, frame = self._sent.popleft()
            self._sending.add({name: (frame,)})
        placed = {name: each.uplinks for name, each in self.run.decision.settings.items() if each.uplinks}
        reported = self._sending.judge(ReceptionReported(t, OPERATOR, True, report), report.as_of, placed)
        self.on_report(reported)
        if measured := self._uplinks.take(reported):
            self.take(measured)
        if report.damaged is not UNSET:
            encoders = {name: self.encoders[name] for name in report.damaged}
            affected = (name for name, encoder in encoders.items() if encoder.sends and encoder.restarts)
            for name in self._key_frames.due(affected, t):
                encoders[name].key = True

    def _step(self, event: Event) -> None:
        before = self.run
        self.run = after = step(self.setup.vehicle, before, event)
        if after.fault:
            raise RunError(after.fault)
        for command in after.commands:
            self.encoders[command.camera].turn(command)
        self.on_step(before, event, after)

    def _note_presence(self, t: float) -> None:
        before, present = self.run.state, self._operators.present
        for event in presence_events(before, present, (), lambda _: Role.CONTROLLER, t, Departure.SILENT):
            self.take(event)
        in_control = self.run.state.driving.in_control
        if in_control != before.driving.in_control:
            self.take(ControlPassed(t=t, operator=in_control))
