"""What the vehicle says of itself, its cameras and its clock, and its answers to requests."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Annotated, Any, NamedTuple

from msgspec import UNSET, UnsetType

from runner.core.commands import KnobValues
from runner.core.decision import NOTHING, Believed, Setting
from runner.core.events import Attention, Latitude, Longitude, PositionReported, Steering
from runner.core.model import Count, Limits, Mode, NonNegative, Share
from runner.records import Amount, Clock, Json, Number, Time, to_json
from runner.records.decisions import Applied, CameraDecision, applied_to_json, decided

SLOW, SLOW_S = 0.7, 2.0  # a camera is slow if it has delivered less than this share of its rate for so long, s


@dataclass(frozen=True, slots=True)
class Position:
    """Position of the vehicle; None: unknown.

    lat, lon     degrees (WGS-84)
    speed_mps    as its receiver reports it, m/s; absent: unknown
    heading_deg  the same, degrees clockwise from north
    """

    lat: Latitude
    lon: Longitude
    speed_mps: float | UnsetType = UNSET
    heading_deg: float | UnsetType = UNSET

    @classmethod
    def of(cls, event: PositionReported) -> Position:
        known = {"speed_mps": event.speed_mps, "heading_deg": event.heading_deg}
        return cls(event.lat, event.lon, **{key: value for key, value in known.items() if value is not None})


@dataclass(frozen=True, slots=True)
class CameraState(CameraDecision):
    """The decision for one camera, the values read back as applied, and the fault of its source, if any.

    weight    in the allocation
    fault     None: none known
    untimed   true: its source provides no capture times, so latency is unknown; absent otherwise
    slow_fps  rate of its pictures, Hz, while the camera is slow; absent otherwise
    """

    weight: Amount
    applied: Applied
    fault: str | None = None
    untimed: bool | UnsetType = UNSET
    slow_fps: Annotated[int, Limits(1)] | UnsetType = UNSET

    @classmethod
    def at(cls, setting: Setting, weight: Number, camera: str, reading: CameraReading) -> CameraState:
        return cls(
            **decided(setting),
            weight=weight,
            applied=applied_to_json(camera, reading.applied),
            fault=reading.fault or reading.lost,
            untimed=reading.untimed or UNSET,
            slow_fps=reading.slow_fps or UNSET,
        )


@dataclass(frozen=True, slots=True)
class VehicleState:
    """State of a vehicle that is online.

    cause       the event that triggered the decision, in words
    asked_kbps  the total of the prediction or the operator, kbit/s
    total_kbps  the same after all rules, such as what the measured link carries
    cameras     decisions and applied values by camera
    online      false: the vehicle is offline, and its state unknown
    fault       why the rules could not decide, so that an earlier decision stays in force
    attention   of the driver; absent: the operator in control states none
    operator    id of the operator in control; absent: none
    certificate_ends  when the certificate of the vehicle expires, s since 1970; absent: it has none
    believed    of the uplink; absent: nothing
    """

    t: Time = field(compare=False)
    cause: str
    mode: Mode
    total_kbps: Amount
    asked_kbps: Amount
    cameras: Mapping[str, CameraState]
    fault: str | None = None
    online: bool = True
    attention: Attention | UnsetType = UNSET
    operator: str | UnsetType = UNSET
    certificate_ends: float | UnsetType = UNSET
    believed: Believed | UnsetType = UNSET

    @property
    def total_words(self) -> str:
        """The total in kbit/s, and the requested one if that is more: 1800 of 3000."""
        less = self.total_kbps < self.asked_kbps
        return f"{self.total_kbps:.6g} of {self.asked_kbps:.6g}" if less else f"{self.total_kbps}"


@dataclass(frozen=True, slots=True)
class Offline:
    """Operator log line: the vehicle is offline."""

    t: Time
    online: bool = False


@dataclass(frozen=True, slots=True)
class EncoderCounts:
    """What the encoder of a camera counts since its pipeline was built.

    frames, bytes  that the encoder has put out
    """

    frames: Count
    bytes: Count


NOTHING_ENCODED = EncoderCounts(*[0 for _ in fields(EncoderCounts)])


@dataclass(frozen=True, slots=True)
class CameraTelemetry(EncoderCounts):
    """Values read back as applied, and the encoder's output since its pipeline was built.

    capture_ms, encode_ms  ms of the last sampled picture from its capture to the encoder, and through it; None: unknown
    """

    applied: Applied
    capture_ms: float | None = None
    encode_ms: float | None = None


@dataclass(frozen=True, slots=True)
class Telemetry:
    """Measured on the vehicle, a few times a second: also its heartbeat.

    predicted_kbps  last prediction of the total, kbit/s; None before the first
    cameras         measured values by camera
    refused         requests refused since the start
    errors          exceptions caught by the control loop since the start
    speed_factor    as in `SpeedAdvice`; None: not advised
    """

    t: Time
    predicted_kbps: Amount | None
    position: Position | None
    cameras: Mapping[str, CameraTelemetry]
    refused: Count
    errors: Count = 0
    speed_factor: Share | None = None


@dataclass(frozen=True, slots=True)
class SpeedAdvice:
    """Share of full speed that the latency of the operator's pictures allows, ten times a second.

    The driving function must assume 0 once `expires_s` have passed without a newer one.

    speed_factor  the share
    latency_ms    glass to glass, at most, ms; None: unknown
    expires_s     how long it may be used, s
    """

    t: Time
    speed_factor: Share
    latency_ms: NonNegative | None
    expires_s: Annotated[float, Limits(above=0)]


@dataclass(frozen=True, slots=True)
class SteeringAngle:
    """The steering angle as of its report, to match it to the picture captured at that time.

    at   when it was reported, s since 1970 by the vehicle's clock, as capture times are
    rad  as in `runner.core.events.SteeringReported`
    """

    at: Clock
    rad: Steering


@dataclass(frozen=True, slots=True)
class Outcome:
    """Outcome of a request.

    result  applied: read back from the elements
    reason  why, in words
    """

    t: Time
    result: Annotated[str, Limits(among=("applied", "refused", "expired", "timed out"))]
    reason: str


@dataclass(frozen=True, slots=True)
class Reply(Outcome):
    """The answer to a request.

    id  the request's; "": it had none
    """

    id: str


@dataclass(frozen=True, slots=True)
class ClockAnswer:
    """The vehicle's clock, for an operator that compares it with its own, see `runner.system.clocks`.

    sent                of the report that is answered, s since 1970 by the operator's clock
    received, answered  s since 1970, by the vehicle's clock
    set_s               how far that clock is ahead of the vehicle's monotonic clock
    error_s             its maximum error against UTC according to the kernel; None: not synchronised
    """

    sent: Clock
    received: Clock
    answered: Clock
    set_s: Clock
    error_s: NonNegative | None


@dataclass(frozen=True, slots=True)
class Settings:
    """Settings on which both sides' configurations must agree.

    run       random name of the vehicle's process: distinguishes vehicles of one name
    settings  by path, such as cameras.front.fps
    """

    run: str
    settings: Mapping[str, str | int | float | bool | list[Any] | None]


class SenderStages(NamedTuple):
    """Latencies of one picture, ms. capture: to the encoder's input, including conversion, cropping and scaling."""

    capture_ms: float
    encode_ms: float


class CameraReading(NamedTuple):
    """What the elements of a camera on the vehicle say; without a pipeline, as the defaults.

    applied        by knob, the values read back
    fault          of its source: it has failed, is awaited, refuses the login, or repeats a picture; None: none
    lost           why its source cannot be opened; None: it can
    untimed        whether its source does not know the capture time of its last picture
    slow_fps       the rate of its pictures, Hz, if that has been well below its own for a while; else None
    copies         viewers outside the vehicle: each is sent a copy of the stream
    """

    applied: KnobValues = NOTHING
    encoded: EncoderCounts = NOTHING_ENCODED
    fault: str | None = None
    lost: str | None = None
    untimed: bool = False
    slow_fps: int | None = None
    copies: int = 0


def state_to_json(state: VehicleState | None) -> Json:
    """The JSON object of a vehicle's state; None: it is offline."""
    return {"online": False} if state is None else to_json(state)
