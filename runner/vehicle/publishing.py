"""What the vehicle publishes of itself, and when: its state, telemetry, advised speed and steering angle."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from msgspec import UNSET, UnsetType

from runner.core.decision import Decision
from runner.core.events import Attention, LinkMeasured, PositionReported, SteeringReported
from runner.core.model import plain
from runner.core.step import Run
from runner.records import combined
from runner.records.decisions import applied_to_json, uplinks_decided
from runner.records.reception import UplinkSent
from runner.records.vehicle import (
    CameraReading,
    CameraState,
    CameraTelemetry,
    Position,
    SenderStages,
    SoundState,
    SpeedAdvice,
    SteeringAngle,
    Telemetry,
    UplinkMeasured,
    UplinkTelemetry,
    VehicleState,
    VoiceState,
    VoiceTelemetry,
)
from runner.settings import LatencyLimit
from runner.vehicle.readings import Readings

STATE_S = 0.2  # between two states, unless a request waits for its answer: each takes some kB of a limited link
REASONS_S, UNSEEN_REASONS_S = 1.0, 10.0  # between two that differ in reasons only; the second without an operator
STEERING_S = 0.05  # between two published steering angles: each costs the video 0.2 kB of the link
UNSEEN = (Attention.HIDDEN, Attention.ABSENT)  # the driver sees no picture
ADVICE_S = 0.2  # how long a reported latency, and the advice based on it, is valid
POSITION_S = 5.0  # an older position is stale
SPEED_S = 2.0  # an older speed is stale; receivers of GNSS report once a second or more often

Publish = Callable[[VehicleState | Telemetry | SpeedAdvice | SteeringAngle], bool]


@dataclass
class Publisher:
    """Used in one thread, except that any may set `again`: the broker may have lost the state.

    publish   as in `runner.vehicle.loop.ControlLoop`
    cause     the event that the decision in force came from
    latency   when a latency was last reported, s, and its value, ms
    position  as last reported
    """

    limit: LatencyLimit
    publish: Publish
    cause: str = ""
    latency: tuple[float, float | None] = (-ADVICE_S, None)
    again: bool = False
    position: PositionReported | None = None
    _published: VehicleState | None = None  # the state as last published
    _steering_published: float = -STEERING_S

    def is_state_due(self, now: float, decision: Decision) -> bool:
        """Whether to publish the state if it has changed. Frame rates do not wait: pages judge by them."""
        last = self._published
        if last is None or self.again or now - last.t >= STATE_S:
            return True
        rates = {name: plain(setting.fps) for name, setting in decision.settings.items() if setting.fps is not None}
        return any(name in last.cameras and last.cameras[name].fps != fps for name, fps in rates.items())

    def state(self, run: Run, readings: Readings, now: float, *, has_viewer: bool) -> None:
        """Publish the decided and the applied values if either has changed.

        has_viewer  whether an operator is present
        """
        state = vehicle_state(run, readings.cameras, now, self.cause)
        if (sound := readings.sound) is not None:
            state = replace(state, sound=SoundState(sound.lost, sound.refused or UNSET))
        if (voice := readings.voice) is not None:
            state = replace(state, voice=VoiceState(voice.operator, voice.speaking, voice.lost))
        if self._is_news(state, REASONS_S if has_viewer else UNSEEN_REASONS_S) and self.publish(state):
            self.again, self._published = False, state

    def _is_news(self, state: VehicleState, interval_s: float) -> bool:
        """Whether to publish a state. Changed reasons or beliefs alone, which change all the time, are not urgent."""
        last = self._published
        if last is None or self.again:
            return True
        if state == last:
            return False
        return state.t - last.t >= interval_s or _without_reasons(state) != _without_reasons(last)

    def telemetry(
        self,
        run: Run,
        t: float,
        readings: Readings,
        stages: Mapping[str, SenderStages],
        refused: int,
        errors: int,
        addresses: Mapping[str, tuple[str, ...]],
        sent: Mapping[str, Mapping[str, UplinkSent]],
    ) -> Telemetry:
        """What was read back from the elements, and what the encoders have output so far.

        addresses  by uplink
        sent       by camera and uplink
        """
        measured = {
            name: combined(
                CameraTelemetry,
                camera.encoded,
                stages.get(name),
                applied=applied_to_json(name, camera.applied),
                sent=sent.get(name, UNSET),
            )
            for name, camera in readings.cameras.items()
        }
        known = run.state.predicted_kbps
        predicted = None if known is None else plain(known)
        position, factor = self._current_position(t), self._speed_factor(run, t)
        links = run.state.links
        uplinks = {name: UplinkTelemetry(own, _measured(links.get(name))) for name, own in addresses.items()}
        sound = UNSET if readings.sound is None else readings.sound.encoded
        voice = UNSET if readings.voice is None else VoiceTelemetry.of(readings.voice)
        return Telemetry(t, predicted, position, measured, refused, errors, factor, uplinks or UNSET, sound, voice)

    def _current_position(self, t: float) -> Position | None:
        """The position, while it is not stale; its speed becomes stale earlier."""
        if self.position is None or (age_s := t - self.position.t) > POSITION_S:
            return None
        return Position.of(self.position if age_s <= SPEED_S else replace(self.position, speed_mps=None))

    def steering(self, event: SteeringReported, now: float) -> None:
        if event.t - self._steering_published >= STEERING_S:
            self._steering_published = event.t
            at = round(time.time() - (now - event.t), 4)
            self.publish(SteeringAngle(at, event.rad, UNSET if event.gear is None else event.gear))

    def advise(self, run: Run, t: float) -> None:
        """Publish the speed that the latency of the operator's pictures allows.

        0 without a recent report or driver, and while somebody asks to stop, even if no latency limits the speed.
        """
        if (factor := self._speed_factor(run, t)) is not None:
            _, measured_ms = self.latency
            total_ms = (
                None if not factor or measured_ms is None else round(measured_ms + (self.limit.fixed_ms or 0.0), 1)
            )
            self.publish(SpeedAdvice(t, factor, total_ms, ADVICE_S))

    def _speed_factor(self, run: Run, t: float) -> float | None:
        if run.state.driving.stop is not None:
            return 0.0
        at, measured_ms = self.latency
        is_driven = bool(run.state.driving.in_control) and run.state.attention not in UNSEEN
        is_seen = is_driven and t - at <= ADVICE_S
        factor = self.limit.speed_factor(measured_ms if is_seen else None)
        return None if factor is None else round(factor, 3)


def vehicle_state(run: Run, cameras: Mapping[str, CameraReading], t: float, cause: str) -> VehicleState:
    """The state as the vehicle publishes it."""
    decision, since = run.decision, run.state.attention_since
    states = {
        name: CameraState.at(
            decision.settings[name], plain(run.state.weights[name]), name, camera, run.state.rois[name]
        )
        for name, camera in cameras.items()
    }
    return VehicleState(
        t,
        cause,
        decision.mode,
        plain(decision.total),
        plain(decision.asked),
        states,
        run.fault,
        attention=run.state.attention or UNSET,
        attention_since=UNSET if not run.state.attention or since is None else since,
        driving=run.state.driving,
        believed=decision.believed or UNSET,
        uplinks=uplinks_decided(decision),
        copies=dict(run.state.copies) or UNSET,
    )


def _without_reasons(state: VehicleState) -> VehicleState:
    cameras = {name: replace(camera, reason="") for name, camera in state.cameras.items()}
    return replace(state, cameras=cameras, believed=UNSET, uplinks=UNSET)


def _measured(link: LinkMeasured | None) -> UplinkMeasured | UnsetType:
    return UplinkMeasured.of(link) if link else UNSET
