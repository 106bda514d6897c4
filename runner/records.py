"""Records that both sides publish and log: state, telemetry, replies, samples, lines of a drive. Pure.

Each record is a frozen dataclass whose fields are the keys of its JSON. Only this module writes and reads that JSON;
its schemas, control and drive, are made from the classes below: from their docstrings, and the limits in their types.
A key whose field has a default may be missing. Bitrates are kbit/s, sizes px, times s.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, NamedTuple, TypeVar

import msgspec
from msgspec import UNSET, UnsetType

from runner.core.commands import Command, KnobValues
from runner.core.decision import NOTHING, Believed, Decision, Setting
from runner.core.events import Attention, Latitude, Longitude, PositionReported, Steering
from runner.core.model import Count, Limits, Mode, NonNegative, Roi, Share, plain

Number = int | float
Amount = Annotated[Number, Limits(0)]
# s since the start of the run or of the log; at an operator's station, which has no such start, since 1970.
Time = Annotated[float, Limits(0), "s since the start of the run, or of the log that contains this"]
Since1970 = Annotated[float, Limits(0, 2**32 - 1)]
Clock = Annotated[float, Limits(-(10**12), 10**12)]  # s by some clock, or a difference of clocks
Size = Annotated[int, Limits(0, 10**8)]  # bytes or packets of a report
Span = Annotated[float, Limits(0, 3600)]
Packets = Annotated[int, Limits(0, 10**9)]
File = Annotated[str, "relative to the directory of the drive"]
CameraName = Annotated[str, "name of the camera"]
Json = dict[str, Any]
SLOW, SLOW_S = 0.7, 2.0  # a camera is slow if it has delivered less than this share of its rate for so long, s
Applied = Annotated[Mapping[str, Any], "by knob, the value read back; empty for a camera without a pipeline"]
T = TypeVar("T")


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


# --- decisions --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class CameraDecision:
    """The decision for one camera, see `runner.core.decision.Setting`.

    on             whether the camera is switched on
    sending        whether anything of it is encoded
    demand_kbps    Eq. (1), kbit/s
    kbps           allocated, kbit/s
    scaling        selected factor; None while the camera is off or its source cannot be opened
    width, height  of the encoded picture, px; 0 while the camera is off
    reason         why, in words
    """

    on: bool
    sending: bool
    demand_kbps: Amount
    kbps: Count
    scaling: Annotated[Number, Limits(above=0, most=1)] | None
    roi: Roi
    width: Count
    height: Count
    reason: str

    @classmethod
    def of(cls, setting: Setting) -> CameraDecision:
        return cls(**_decided(setting))


@dataclass(frozen=True, slots=True)
class Turned:
    """A knob of a camera that was turned.

    value  the new one
    """

    camera: CameraName
    knob: Annotated[str, Limits(among=("sending", "roi", "size", "bitrate")), "name of the knob"]
    value: Any


@dataclass(frozen=True, slots=True)
class DecisionMade:
    """A decision that changed something, its cause, and the resulting commands.

    cause       the event that it comes from, in words
    total_kbps  before the cap at demand, kbit/s
    cameras     settings by camera
    commands    knobs that were turned
    believed    absent: no rule believes anything of the uplink
    """

    t: Time
    cause: str
    mode: Mode
    total_kbps: Amount
    cameras: Mapping[str, CameraDecision]
    commands: tuple[Turned, ...]
    believed: Believed | UnsetType = UNSET

    @classmethod
    def of(cls, t: float, cause: str, decision: Decision, commands: tuple[Command, ...]) -> DecisionMade:
        cameras = {name: CameraDecision.of(setting) for name, setting in decision.settings.items()}
        turned = tuple(Turned(**command.to_json()) for command in commands)
        believed = decision.believed or UNSET
        return cls(t, cause, decision.mode, plain(decision.total), cameras, turned, believed)


# --- from the vehicle -------------------------------------------------------------------------------------------------


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
    def at(
        cls,
        setting: Setting,
        weight: Number,
        applied: Applied,
        fault: str | None,
        untimed: bool = False,
        slow_fps: int | None = None,
    ) -> CameraState:
        return cls(
            **_decided(setting),
            weight=weight,
            applied=applied,
            fault=fault,
            untimed=untimed or UNSET,
            slow_fps=slow_fps or UNSET,
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
class CameraTelemetry:
    """Values read back as applied, and the encoder's output since its pipeline was built.

    frames, bytes  that the encoder has put out
    capture_ms, encode_ms  ms of the last sampled picture from its capture to the encoder, and through it; None: unknown
    """

    applied: Applied
    frames: Count
    bytes: Count
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


# --- from the operator's side -----------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class LatencyStages:
    """Parts of the latency from capture to decoding, ms, each of a recently sampled picture; None: unknown.

    capture  to the encoder's input on the vehicle, with conversion, cropping and scaling
    encode   through the encoder
    link     from there to the operator's side: the remainder. The only part that depends on the clocks, accurate to
             within `clock_bound_ms`
    buffer   in the jitter buffer
    decode   from the complete access unit to its picture
    """

    capture: float | None = None
    encode: float | None = None
    link: float | None = None
    buffer: float | None = None
    decode: float | None = None


@dataclass(frozen=True, slots=True)
class CameraSample:
    """Reception of one camera. Rates cover the last second, counters run since the start.

    fps         frames received, Hz
    kbps        encoded video received, kbit/s
    allocated_kbps, demand_kbps, scaling  as the vehicle has decided; None while the camera is off or nothing is known
    width, height  of the decoded picture, px; 0 before the first
    lost        RTP packets that never arrived
    frames, bytes  access units received, and their size
    damaged     frames whose picture shows packet loss, until it is healed
    buffer_ms   how long a picture waits for retransmitted packets, ms; None: no retransmission
    foreign     packets from senders other than the vehicle, dropped
    rebuilt     how often the receiver's pipeline was rebuilt
    latency_ms  capture to decode of the last sampled frame, ms; None: unknown
    stages_ms   the parts of it
    arrivals    in a log, of each access unit since the previous sample: time, s, and ms since its capture if known

    Latencies are accurate to within the sample's `clock_bound_ms`.
    """

    fps: NonNegative
    kbps: NonNegative
    allocated_kbps: Amount
    demand_kbps: Amount
    scaling: Number | None
    width: Count
    height: Count
    latency_ms: float | None
    lost: Count
    rebuilt: Count
    frames: Count
    bytes: Count
    damaged: Count
    stages_ms: LatencyStages
    arrivals: tuple[tuple[float, float | None], ...]
    foreign: Count = 0
    buffer_ms: Count | None = None


@dataclass(frozen=True, slots=True)
class Sample:
    """What the operator's side measures a few times a second.

    predicted_kbps  as in `Telemetry`
    allocated_kbps  sum over the cameras, kbit/s
    actual_kbps     received in the last second, sum over the cameras, kbit/s
    refused         as in `Telemetry`
    cameras         what was received, by camera
    dropped         invalid messages on the control link
    speed_factor    as in `SpeedAdvice`; None: not advised
    clock_ahead_ms  how far the vehicle's clock is ahead, ms; None: unknown, as are all latencies
    clock_bound_ms  maximum error of that and of each latency, ms; None: unknown. Older logs lack it: there
                    `clock_ahead_ms` was derived from negative latencies, and latencies are differences of both clocks
    """

    t: Time
    predicted_kbps: Amount | None
    allocated_kbps: Amount
    actual_kbps: NonNegative
    position: Position | None
    refused: Count
    cameras: Mapping[str, CameraSample]
    dropped: Count = 0
    clock_ahead_ms: float | None = None
    clock_bound_ms: NonNegative | None = None
    speed_factor: Share | None = None


class Arrival(NamedTuple):
    """Arrival of an encoded frame.

    arrived   of its last packet, s by this machine's monotonic clock
    captured  s by the vehicle's clock; from an arbitrary origin if the transport carries only the RTP timestamp
    whole     whether no packet of it was initially missing
    first     as `arrived`, of its first packet, by the kernel; None: the kernel does not state both
    """

    arrived: float
    captured: float
    bytes: int
    whole: bool = True
    first: float | None = None


ArrivedPacket = tuple[float, int]  # s by this machine's monotonic clock, bytes without headers; there are thousands a s


class SentFrame(NamedTuple):
    """A frame that a camera's payloader has output, seen by looking now and then; s since 1970 by the vehicle's clock.

    unsent  when the camera was last seen sending an older one
    sent    when it was first seen sending this one
    """

    captured: float
    unsent: float
    sent: float


class CameraReading(NamedTuple):
    """What the elements of a camera on the vehicle say; without a pipeline, as the defaults.

    applied        by knob, the values read back
    frames, bytes  that its encoder has output since its pipeline was built
    fault          of its source: it has failed, is awaited, refuses the login, or repeats a picture; None: none
    lost           why its source cannot be opened; None: it can
    untimed        whether its source does not know the capture time of its last picture
    slow_fps       the rate of its pictures, Hz, if that has been well below its own for a while; else None
    copies         viewers outside the vehicle: each is sent a copy of the stream
    """

    applied: KnobValues = NOTHING
    frames: int = 0
    bytes: int = 0
    fault: str | None = None
    lost: str | None = None
    untimed: bool = False
    slow_fps: int | None = None
    copies: int = 0


class Arrivals(NamedTuple):
    """What the operator's side has received since the last call.

    frames         by camera, without waiting for missing packets
    newest         by camera, the newest access unit that has left the jitter buffer
    packets, lost  RTP packets of all cameras received, and initially missing
    damaged        cameras whose newest picture shows unrecovered packet loss
    arrived        packets of all cameras, those of `frames` and maybe later ones, repeated ones included; in no order
    """

    frames: Mapping[str, Sequence[Arrival]]
    newest: Mapping[str, Arrival]
    packets: int = 0
    lost: int = 0
    damaged: Sequence[str] = ()
    arrived: Sequence[ArrivedPacket] = ()


class UnitReceived(NamedTuple):
    """A frame as the operator's side received it; a list in JSON, since there are hundreds a second.

    ago_s    s from the arrival of its last packet to the report
    delay_s  s from its capture, by the vehicle's clock, to that arrival; minus a constant, since clocks differ
    bytes    without packet headers
    whole    whether no packet of it was initially missing
    train_s  s from the arrival of its first packet to that of its last
    train_packets, train_bytes  what arrived in that time of all cameras, repeated packets included, without the first
             packet; 0: it was one packet, or the transport does not tell
    carried_packets, carried_bytes  what arrived of all cameras after the last packet of the previous unit and until the
             last packet of this one, repeated packets included; 0: the transport does not tell
    """

    camera: str
    ago_s: Span
    delay_s: Clock
    bytes: Size
    whole: bool = True
    train_s: Span = 0.0
    train_packets: Size = 0
    train_bytes: Size = 0
    carried_packets: Size = 0
    carried_bytes: Size = 0

    @classmethod
    def of(
        cls, camera: str, frame: Arrival, at: float, base_s: float, train: tuple[int, int], carried: tuple[int, int]
    ) -> UnitReceived:
        """As a report made at a time says it; delays are less by base_s."""
        ago_s, delay_s = round(at - frame.arrived, 4), round(frame.arrived - frame.captured - base_s, 4)
        train_s = 0.0 if frame.first is None else round(frame.arrived - frame.first, 5)
        return cls(camera, ago_s, delay_s, frame.bytes, frame.whole, train_s, *train, *carried)

    def captured(self, at: float) -> float:
        """When it was captured, if the report was made then."""
        return at - self.ago_s - self.delay_s


@dataclass(frozen=True, slots=True)
class ReceptionReport:
    """What the operator's side has received since its previous report; the vehicle estimates the uplink from it.

    at             s, by the operator's monotonic clock
    as_of          s, the operator's estimate of the vehicle's time, see `runner.vehicle.operators`
    units          in order of arrival
    packets, lost  RTP packets of all cameras received, and initially missing: some may have been recovered
    latency_ms     upper bound of the age of the oldest displayed picture, capture to decoding, ms; absent: unknown
    damaged        cameras whose newest picture shows unrecovered packet loss; absent: none
    sent           s since 1970 by the operator's clock; present if the vehicle should answer with a `ClockAnswer`
    run            random number of this run of the operator's side, to which delays and times are relative
    offset_s       the constant that delays are less by, s; absent: no unit
    """

    at: Clock
    as_of: Clock
    units: Annotated[tuple[UnitReceived, ...], Limits(most=2000)]
    packets: Packets
    lost: Packets
    latency_ms: Annotated[float, Limits(0, 10**12)] | UnsetType = UNSET
    damaged: Annotated[tuple[str, ...], Limits(most=1000, unique=True)] | UnsetType = UNSET
    sent: Clock | UnsetType = UNSET
    run: Annotated[int, Limits(0, 2**32 - 1)] | UnsetType = UNSET
    offset_s: Clock | UnsetType = UNSET


@dataclass(frozen=True, slots=True)
class ReceptionReported:
    """A reception report that arrived at the vehicle at t.

    operator      id of its sender
    in_control    whether that operator was in control; only its reports are used
    late_s        of each unit: s by which the vehicle at least took longer than usual to send it; absent: none was late
    all_received  nothing was on its way when the report was made; absent: unknown, or not so, or the report has units
    """

    t: Time
    operator: str
    in_control: bool
    report: ReceptionReport
    late_s: Annotated[tuple[NonNegative, ...], Limits(most=2000)] | UnsetType = UNSET
    all_received: bool | UnsetType = UNSET


# --- other log lines --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Began:
    """First line of a log: side, versions and configuration.

    side      who wrote it
    format    version of the format
    time      its start, s since 1970
    versions  of the software in use, by name
    config    the composed configuration
    replayed  words of the replay that decided it anew, without input and output; absent: it was driven
    """

    t: Time
    side: Annotated[str, Limits(among=("vehicle", "operator", "link"))]
    format: Annotated[int, Limits(1)]
    time: Since1970
    versions: Mapping[str, str]
    config: Mapping[str, Any]
    replayed: tuple[str, ...] | UnsetType = UNSET


@dataclass(frozen=True, slots=True)
class Note:
    """A note for the user.

    text  one sentence
    """

    t: Time
    text: str


@dataclass(frozen=True, slots=True)
class VideoBegan:
    """A video file has started.

    captured  capture time of its first frame, s since 1970
    """

    t: Time
    camera: CameraName
    file: File
    captured: Since1970


@dataclass(frozen=True, slots=True)
class VideoShifted:
    """From a frame on, the offset of times in a video file changes, by a pause or a receiver that smooths them.

    after_s   s from the file's first frame to this one, by the file
    captured  capture time of this one, s since 1970
    """

    t: Time
    camera: CameraName
    file: File
    after_s: NonNegative
    captured: Since1970


@dataclass(frozen=True, slots=True)
class LinkSample:
    """State of the limited link between the sides; counters run since it was made.

    kbps       rate in force, kbit/s
    queue_ms   how long a packet that arrives now waits, ms
    bytes, packets  forwarded from vehicle to operator
    dropped    packets that its queue dropped
    lost       packets lost at random, after the queue
    tcp_bytes  that competing TCP flows have delivered, without headers
    """

    t: Time
    kbps: NonNegative
    queue_ms: NonNegative
    bytes: Count
    packets: Count
    dropped: Count
    lost: Count = 0
    tcp_bytes: Count = 0


@dataclass(frozen=True, slots=True)
class ClockSet:
    """The wall clock of this side's machine was set; `t` does not follow it.

    by_s  how far forward, s
    """

    t: Time
    by_s: Annotated[float, Limits(1 - 2**32, 2**32 - 1)]


@dataclass(frozen=True, slots=True)
class LinesDropped:
    """Lines were not written because the disk was too slow.

    lines  their number
    """

    t: Time
    lines: Annotated[int, Limits(1)]


@dataclass(frozen=True, slots=True)
class Ended:
    """Last line of a log that was closed."""

    t: Time


Record = (
    Began
    | DecisionMade
    | Telemetry
    | VehicleState
    | Offline
    | Sample
    | ReceptionReported
    | Note
    | VideoBegan
    | VideoShifted
    | LinkSample
    | ClockSet
    | LinesDropped
    | Ended
)
KINDS: dict[type[Any], str] = {  # value of a line's key `log`
    Began: "began",
    DecisionMade: "decision",
    Telemetry: "telemetry",
    VehicleState: "state",
    Offline: "state",
    Sample: "sample",
    ReceptionReported: "reception",
    Note: "note",
    VideoBegan: "video",
    VideoShifted: "video_shift",
    LinkSample: "link",
    ClockSet: "clock_set",
    LinesDropped: "dropped",
    Ended: "ended",
}


# --- JSON -------------------------------------------------------------------------------------------------------------


def to_json(record: Any) -> Json:
    """The JSON object of a record."""
    document: Json = msgspec.to_builtins(record)
    return document


def from_json(kind: type[T], document: Mapping[str, Any]) -> T:
    """The record described by a JSON object that satisfies its schema.

    raises  msgspec.ValidationError, a ValueError
    """
    if kind not in _prepared:
        _prepare(kind)
    return msgspec.convert(document, kind)


_preparing = threading.Lock()
_prepared = set[type[Any]]()


def _prepare(kind: type[Any]) -> None:
    """Let msgspec build its description of a type: msgspec (0.22) crashes if two threads race to do so on first use."""
    with _preparing:
        msgspec.json.Decoder(kind)
        _prepared.add(kind)


def state_to_json(state: VehicleState | None) -> Json:
    """The JSON object of a vehicle's state; None: it is offline."""
    return {"online": False} if state is None else to_json(state)


def line_to_json(record: Record) -> Json:
    """A record as a log line."""
    document = to_json(record)
    return {"t": document.pop("t"), "log": KINDS[type(record)], **document}


def line_from_json(document: Mapping[str, Any]) -> Record:
    """The record described by a log line that satisfies its schema."""
    kind = _BY_KIND[document["log"]]
    kind = Offline if kind is VehicleState and not document["online"] else kind
    try:
        record: Record = from_json(kind, document)
    except msgspec.ValidationError:  # to a schema, 1920.0 is a whole number, too
        record = msgspec.convert(document, kind, strict=False)
    return record


_BY_KIND: dict[str, type[Any]] = {name: kind for kind, name in KINDS.items() if kind is not Offline}


def decision_to_json(decision: Decision) -> Json:
    """The JSON object of a decision; without an intermediate record, since a replay writes thousands per second."""
    cameras = {name: _decided(setting) | {"roi": setting.roi.to_json()} for name, setting in decision.settings.items()}
    document = {"mode": decision.mode, "total_kbps": plain(decision.total), "cameras": cameras}
    return document if decision.believed is None else {**document, "believed": to_json(decision.believed)}


def applied_to_json(camera: str, knobs: KnobValues) -> Applied:
    """Current values of a camera's knobs, by name."""
    return {knob: Command(camera, knob, value).to_json()["value"] for knob, value in knobs.items()}


def _decided(setting: Setting) -> Json:
    return {
        "on": setting.on,
        "sending": setting.sending,
        "demand_kbps": plain(setting.demand),
        "kbps": setting.kbps,
        "scaling": None if setting.scaling is None else plain(setting.scaling),
        "roi": setting.roi,
        "width": setting.width,
        "height": setting.height,
        "reason": setting.reason,
    }
