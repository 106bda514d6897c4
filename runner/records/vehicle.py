"""What the vehicle says of itself, its cameras and its clock, and its answers to requests."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Annotated, Any, NamedTuple

from msgspec import UNSET, UnsetType

from runner.core.commands import KnobValues
from runner.core.decision import NOTHING, Believed, Setting
from runner.core.driving import Driving
from runner.core.events import (
    Attention,
    Gear,
    Latitude,
    LinkMeasured,
    LinkState,
    Longitude,
    PositionReported,
    Steering,
)
from runner.core.limits import Count, Limits, NonNegative, Share
from runner.core.model import Mode, Roi
from runner.records import Amount, Clock, Json, Number, Time, to_json
from runner.records.decisions import Applied, CameraDecision, UplinkDecisions, applied_to_json, decided
from runner.records.reception import UplinkSent

SLOW, SLOW_S = 0.7, 2.0  # a camera is slow if it has delivered less than this share of its rate for so long, s


@dataclass(frozen=True, slots=True)
class Position:
    """Position of the vehicle; None: unknown."""

    lat: Annotated[Latitude, "degrees north (WGS-84)"]
    lon: Annotated[Longitude, "degrees east (WGS-84)"]
    speed_mps: Annotated[float | UnsetType, "as its receiver reports it, m/s; absent: unknown"] = UNSET
    heading_deg: Annotated[float | UnsetType, "of travel, degrees clockwise from north"] = UNSET

    @classmethod
    def of(cls, event: PositionReported) -> Position:
        known = {"speed_mps": event.speed_mps, "heading_deg": event.heading_deg}
        return cls(event.lat, event.lon, **{key: value for key, value in known.items() if value is not None})


@dataclass(frozen=True, slots=True)
class CameraState(CameraDecision):
    """The decision for one camera, the values read back as applied, and the fault of its source, if any."""

    weight: Annotated[Amount, "in the allocation"]
    applied: Applied
    chosen: Annotated[
        Roi | UnsetType, "the operator's region of interest, if `roi` is another; absent: it is the same"
    ] = UNSET
    placed: Annotated[
        bool | UnsetType,
        "true: each of its pictures that shows less than the full image says which part; absent: they do not say",
    ] = UNSET
    fault: Annotated[str | None, "None: none known"] = None
    untimed: Annotated[
        bool | UnsetType, "true: its source provides no capture times, so latency is unknown; absent otherwise"
    ] = UNSET
    slow_fps: Annotated[
        int | UnsetType, Limits(1), "rate of its pictures, Hz, while the camera is slow; absent otherwise"
    ] = UNSET
    refused: Annotated[
        Mapping[str, str] | UnsetType, "by operator that is refused its pictures, why, in words; absent: none is"
    ] = UNSET

    @classmethod
    def at(
        cls,
        setting: Setting,
        weight: Number,
        camera: str,
        reading: CameraReading,
        chosen: Roi | None = None,
    ) -> CameraState:
        """chosen: the operator's region of interest; None: the one that is decided."""
        return cls(
            **decided(setting),
            weight=weight,
            applied=applied_to_json(camera, reading.applied),
            chosen=UNSET if chosen in (None, setting.roi) else chosen,
            placed=reading.placed or UNSET,
            fault=reading.fault or reading.lost,
            untimed=reading.untimed or UNSET,
            slow_fps=reading.slow_fps or UNSET,
            refused=reading.refused or UNSET,
        )


@dataclass(frozen=True, slots=True)
class SoundState:
    """The vehicle's sound."""

    fault: Annotated[str | None, "why its source does not open; None: it does, or nobody listens"] = None
    refused: Annotated[
        Mapping[str, str] | UnsetType, "by operator that is refused it, why, in words; absent: none is"
    ] = UNSET


@dataclass(frozen=True, slots=True)
class VoiceState:
    """The vehicle's loudspeaker."""

    operator: Annotated[str | None, "id of the operator whose voice it plays; None: nobody is connected"] = None
    speaking: Annotated[bool, "whether voice arrives"] = False
    fault: Annotated[str | None, "why it does not open; None: it does"] = None


@dataclass(frozen=True, slots=True)
class VehicleState:
    """State of a vehicle that is online."""

    t: Time = field(compare=False)
    cause: Annotated[str, "the event that triggered the decision, in words"]
    mode: Mode
    total_kbps: Annotated[Amount, "kbit/s, after all rules, such as what the measured link carries"]
    asked_kbps: Annotated[Amount, "the total of the prediction or the operator, kbit/s"]
    cameras: Annotated[Mapping[str, CameraState], "decisions and applied values by camera"]
    fault: Annotated[str | None, "why the rules could not decide, so that an earlier decision stays in force"] = None
    online: Annotated[bool, "false: the vehicle is offline, and its state unknown"] = True
    attention: Annotated[Attention | UnsetType, "of the driver; absent: the operator in control states none"] = UNSET
    attention_since: Annotated[Time | UnsetType, "t from which on; absent: none is stated"] = UNSET
    driving: Annotated[Driving | UnsetType, "absent: by an earlier version"] = UNSET
    certificate_ends: Annotated[
        float | UnsetType, "when the certificate of the vehicle expires, s since 1970; absent: it has none"
    ] = UNSET
    believed: Annotated[Believed | UnsetType, "of the uplink; absent: nothing"] = UNSET
    uplinks: UplinkDecisions = UNSET
    copies: Annotated[
        Mapping[str, int] | UnsetType,
        "by camera, how many leave the vehicle, if more than one: together they have the total; absent: one of each",
    ] = UNSET
    sound: Annotated[SoundState | UnsetType, "absent: the vehicle sends none"] = UNSET
    voice: Annotated[VoiceState | UnsetType, "absent: the vehicle has no loudspeaker"] = UNSET

    @property
    def total_words(self) -> str:
        """The total in kbit/s, and the requested one if that is more: 1800 of 3000."""
        less = self.total_kbps < self.asked_kbps
        return f"{self.total_kbps:.6g} of {self.asked_kbps:.6g}" if less else f"{self.total_kbps}"


@dataclass(frozen=True, slots=True)
class UplinkLost:
    """A vehicle's state by the last will of one of its connections: it is offline unless another one works."""

    uplink: Annotated[str, "of an offline vehicle with several: by which its connection to the broker was lost"]
    online: bool = False


@dataclass(frozen=True, slots=True)
class Offline:
    """Operator log line: the vehicle is offline."""

    t: Time
    online: bool = False


@dataclass(frozen=True, slots=True)
class EncoderCounts:
    """What the encoder of a camera counts since its pipeline was built."""

    frames: Annotated[Count, "frames that the encoder has put out"]
    bytes: Annotated[Count, "their size"]


NOTHING_ENCODED = EncoderCounts(*[0 for _ in fields(EncoderCounts)])


@dataclass(frozen=True, slots=True)
class CameraTelemetry(EncoderCounts):
    """Values read back as applied, and the encoder's output since its pipeline was built."""

    applied: Applied
    capture_ms: Annotated[
        float | None, "ms of the last sampled picture from its capture to the encoder; None: unknown"
    ] = None
    encode_ms: Annotated[float | None, "ms that it took through the encoder; None: unknown"] = None
    sent: Annotated[
        Mapping[str, UplinkSent] | UnsetType, "by uplink, since its pipeline was built; absent: there is one"
    ] = UNSET


@dataclass(frozen=True, slots=True)
class UplinkMeasured:
    """What the operator in control receives over one of several uplinks, as in `runner.core.events.LinkMeasured`."""

    kbps: Annotated[NonNegative, "in the last 0.5 s, with packet headers, kbit/s"]
    queue_ms: Annotated[NonNegative, "standing queue in front of it, ms"]
    loss: Annotated[Share, "share of the packets of the last second that was lost"]
    state: Annotated[LinkState, "stalled: nothing arrives"]
    rtt_ms: Annotated[NonNegative, "round trip of the control link, ms"]

    @classmethod
    def of(cls, event: LinkMeasured) -> UplinkMeasured:
        return cls(float(event.kbps), event.queue_ms, event.loss, event.state, event.rtt_ms)


@dataclass(frozen=True, slots=True)
class UplinkTelemetry:
    """One of several uplinks."""

    addresses: Annotated[tuple[str, ...], "that it sends from; none while its device has none"]
    measured: Annotated[UplinkMeasured | UnsetType, "absent: nothing has arrived at the operator in control"] = UNSET


@dataclass(frozen=True, slots=True)
class VoiceTelemetry:
    """The operator's voice as the vehicle has received it; counters run since the start."""

    operator: Annotated[str | None, "id of the operator that is connected; None: nobody is"]
    packets: Annotated[Count, "received"]
    lost: Annotated[Count, "packets that never arrived, or too late"]
    level_db: Annotated[float | None, "of the last tenth of a second, dB below full scale; None: nothing arrived"]

    @classmethod
    def of(cls, voice: VoiceReading) -> VoiceTelemetry:
        level_db = None if voice.level_db is None else round(voice.level_db, 1)
        return cls(voice.operator, voice.packets, voice.missing, level_db)


@dataclass(frozen=True, slots=True)
class Telemetry:
    """Measured on the vehicle, a few times a second: also its heartbeat."""

    t: Time
    predicted_kbps: Annotated[Amount | None, "last prediction of the total, kbit/s; None before the first"]
    position: Position | None
    cameras: Annotated[Mapping[str, CameraTelemetry], "measured values by camera"]
    refused: Annotated[Count, "requests refused since the start"]
    errors: Annotated[Count, "exceptions caught by the control loop since the start"] = 0
    speed_factor: Annotated[Share | None, "as in `SpeedAdvice`; None: not advised"] = None
    uplinks: Annotated[Mapping[str, UplinkTelemetry] | UnsetType, "by uplink; absent: there is one"] = UNSET
    sound: Annotated[EncoderCounts | UnsetType, "packets of sound and their bytes; absent: it sends none"] = UNSET
    voice: Annotated[VoiceTelemetry | UnsetType, "absent: the vehicle has no loudspeaker"] = UNSET


@dataclass(frozen=True, slots=True)
class SpeedAdvice:
    """Share of full speed that the latency of the operator's pictures allows, ten times a second.

    0 while somebody asks to stop, and only then without `latency.fixed_ms`.

    The driving function must assume 0 once `expires_s` have passed without a newer one.
    """

    t: Time
    speed_factor: Annotated[Share, "the share"]
    latency_ms: Annotated[NonNegative | None, "glass to glass, at most, ms; None: unknown"]
    expires_s: Annotated[float, Limits(above=0), "how long it may be used, s"]


@dataclass(frozen=True, slots=True)
class SteeringAngle:
    """The steering angle as of its report, to match it to the picture captured at that time."""

    at: Annotated[Clock, "when it was reported, s since 1970 by the vehicle's clock, as capture times are"]
    rad: Annotated[Steering, "as in `runner.core.events.SteeringReported`"]
    gear: Annotated[Gear | UnsetType, "as there; absent: unknown"] = UNSET


@dataclass(frozen=True, slots=True)
class Outcome:
    """Outcome of a request."""

    t: Time
    result: Annotated[
        str, Limits(among=("applied", "refused", "expired", "timed out")), "applied: read back from the elements"
    ]
    reason: Annotated[str, "why, in words"]


@dataclass(frozen=True, slots=True)
class Reply(Outcome):
    """The answer to a request.

    id  the request's; "": it had none
    """

    id: str


@dataclass(frozen=True, slots=True)
class ClockAnswer:
    """The vehicle's clock, for an operator that compares it with its own, see `runner.system.clocks`.

    received, answered  s since 1970, by the vehicle's clock
    error_s             its maximum error against UTC according to the kernel; None: not synchronised
    """

    sent: Annotated[Clock, "of the report that is answered, s since 1970 by the operator's clock"]
    received: Clock
    answered: Clock
    set_s: Annotated[Clock, "how far that clock is ahead of the vehicle's monotonic clock"]
    error_s: NonNegative | None


@dataclass(frozen=True, slots=True)
class Settings:
    """Settings on which both sides' configurations must agree."""

    run: Annotated[str, "random name of the vehicle's process: distinguishes vehicles of one name"]
    settings: Annotated[Mapping[str, str | int | float | bool | list[Any] | None], "by path, such as cameras.front.fps"]


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
    refused        by operator whose receiver is refused, why
    placed         whether each picture that shows less than the full image says which part
    """

    applied: KnobValues = NOTHING
    encoded: EncoderCounts = NOTHING_ENCODED
    fault: str | None = None
    lost: str | None = None
    untimed: bool = False
    slow_fps: int | None = None
    copies: int = 0
    refused: Mapping[str, str] = NOTHING
    placed: bool = False


class SoundReading(NamedTuple):
    """What is known of the vehicle's sound; without a pipeline, as the defaults.

    encoded  packets and their bytes
    others   as in `CameraReading`
    """

    encoded: EncoderCounts = NOTHING_ENCODED
    lost: str | None = None
    copies: int = 0
    refused: Mapping[str, str] = NOTHING


class VoiceReading(NamedTuple):
    """What is known of the vehicle's loudspeaker; without a server, as the defaults.

    operator  that is connected; None: nobody is
    speaking  whether voice arrives
    packets   received since the start
    missing   of these, packets that never arrived, or too late
    level_db  of the last tenth of a second, dB below full scale; None: nothing arrived
    lost      why it does not open; None: it does
    """

    operator: str | None = None
    speaking: bool = False
    packets: int = 0
    missing: int = 0
    level_db: float | None = None
    lost: str | None = None


def state_to_json(state: VehicleState | None) -> Json:
    """The JSON object of a vehicle's state; None: it is offline."""
    return {"online": False} if state is None else to_json(state)
