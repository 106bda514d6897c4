"""Events: one vocabulary for the control link, the drive log and `replay` (schemas/event.schema.json).

An `Event` is valid once built; `parse` turns JSON that the schema accepts into one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from enum import StrEnum
from fractions import Fraction
from typing import Any, NamedTuple

from runner.core.model import Kbps, Mode, Roi, exact, plain


@dataclass(frozen=True, slots=True, kw_only=True)
class _Event:
    """Something that happened `t` seconds after the start of the run; `t` never decreases."""

    t: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ModeSelected(_Event):
    mode: Mode


@dataclass(frozen=True, slots=True, kw_only=True)
class BitratePredicted(_Event):
    """Prediction of the bitrate available for all cameras together, from pQoS.

    kbps        the prediction
    lower_kbps  likely lower bound, if the source knows it
    valid_s     how long it may be used, if the source knows it
    bias, error mean of ln(capacity / kbps), and the deviation from it, if the source knows them
    """

    kbps: Kbps
    lower_kbps: Kbps | None = None
    valid_s: float | None = None
    bias: float | None = None
    error: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class PositionReported(_Event):
    """WGS-84 position of the vehicle; heading in degrees clockwise from north."""

    lat: float
    lon: float
    speed_mps: float | None = None
    heading_deg: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class SteeringReported(_Event):
    """Angle of the front wheels (bicycle model), rad, positive to the left."""

    rad: float


@dataclass(frozen=True, slots=True, kw_only=True)
class TotalSet(_Event):
    """The operator's total for mode collective."""

    kbps: Kbps


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraSwitched(_Event):
    camera: str
    on: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class RoiSet(_Event):
    camera: str
    roi: Roi


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraConfigured(_Event):
    """The operator's bitrate and scaling factor of one camera, mode single; None: unchanged."""

    camera: str
    kbps: Kbps | None = None
    scaling: Fraction | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class WeightsSet(_Event):
    weights: Mapping[str, Fraction]


class LinkState(StrEnum):
    """State of the queue in front of the link."""

    CLEAR = "clear"
    FILLING = "filling"
    DRAINING = "draining"
    STALLED = "stalled"


class Evidence(NamedTuple):
    """What one report tells of the uplink's capacity, see `runner.core.evidence`.

    busy_kbit, busy_s         carried while the link was known to be busy, and the time this took
    train_kbit, train_s       the same for the packet trains of frames that found it busy
    trains                    their number
    idle_kbit, idle_s, idle   the same for trains of frames that met no queue: an idle link may pass the first packets
                              of each at once
    unqueued                  number of frames that met no queue
    kbit      all that arrived since the previous report
    wait_s    the standing queue: the shortest wait in the last frame interval
    longest_s the longest wait in it
    shorter_s by which the path of a camera proved shorter than known: what was first measured held a queue
    growth    by which waits grew, s per s
    lost_kbit lost since the previous report
    age_s     from the middle of these services to the report
    silent_s  without arrivals beyond `evidence.GAP_S`, although something is on its way
    backlog   the newest frame was sent before a stall had ended
    """

    busy_kbit: float = 0.0
    busy_s: float = 0.0
    train_kbit: float = 0.0
    train_s: float = 0.0
    trains: int = 0
    idle_kbit: float = 0.0
    idle_s: float = 0.0
    idle: int = 0
    unqueued: int = 0
    kbit: float = 0.0
    wait_s: float = 0.0
    longest_s: float = 0.0
    shorter_s: float = 0.0
    growth: float = 0.0
    lost_kbit: float = 0.0
    age_s: float = 0.0
    silent_s: float = 0.0
    backlog: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkMeasured(_Event):
    """The uplink, by what the operator's side received of all cameras, see `runner.core.evidence`.

    kbps      received in the last 0.5 s, kbit/s
    queue_ms  standing queue in front of the link
    loss      share of the packets of the last second that was lost, 0 to 1
    rtt_ms    round trip of the control link
    evidence  of the link's capacity
    """

    kbps: Kbps
    queue_ms: float
    loss: float
    state: LinkState
    rtt_ms: float
    evidence: Evidence


@dataclass(frozen=True, slots=True, kw_only=True)
class CopiesCounted(_Event):
    """Number of copies of each camera's stream that leave the vehicle, one per viewer; 1 for cameras not named."""

    copies: Mapping[str, int]


@dataclass(frozen=True, slots=True, kw_only=True)
class SourceReported(_Event):
    """Whether a camera's source can be opened; until it is reported, it can.

    reason  why it cannot, for the operator; None: it can
    """

    camera: str
    works: bool
    reason: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlPassed(_Event):
    """Another operator is in control, "" for none; measurements of the previous one are no longer valid."""

    operator: str


class Attention(StrEnum):
    """Whether the driver can see the pictures, as detected by the page in control."""

    WATCHING = "watching"
    UNFOCUSED = "unfocused"  # visible, but the page has no keyboard focus
    SLOW = "slow"  # fewer than 10 pictures a second are drawn
    HIDDEN = "hidden"
    ABSENT = "absent"  # the page is closed or does not respond


@dataclass(frozen=True, slots=True, kw_only=True)
class AttentionChanged(_Event):
    """The attention stated by the operator in control has changed; None: none stated, for example without a page."""

    attention: Attention | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class OperatorConnected(_Event):
    """attention  stated by the operator's page with its heartbeat; the vehicle derives `AttentionChanged` from it"""

    attention: Attention | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class OperatorDisconnected(_Event):
    pass


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockAdvanced(_Event):
    """Only time has passed; emitted every 100 ms while live, so that rules can wait without a clock."""


# A union, so that mypy reports a match that lacks one.
Event = (
    ModeSelected
    | BitratePredicted
    | PositionReported
    | SteeringReported
    | TotalSet
    | CameraSwitched
    | RoiSet
    | CameraConfigured
    | WeightsSet
    | LinkMeasured
    | CopiesCounted
    | SourceReported
    | ControlPassed
    | AttentionChanged
    | OperatorConnected
    | OperatorDisconnected
    | ClockAdvanced
)
EVENTS: dict[str, type[Event]] = {
    "mode_selected": ModeSelected,
    "bitrate_predicted": BitratePredicted,
    "position_reported": PositionReported,
    "steering_reported": SteeringReported,
    "total_set": TotalSet,
    "camera_switched": CameraSwitched,
    "roi_set": RoiSet,
    "camera_configured": CameraConfigured,
    "weights_set": WeightsSet,
    "link_measured": LinkMeasured,
    "copies_counted": CopiesCounted,
    "source_reported": SourceReported,
    "control_passed": ControlPassed,
    "attention_changed": AttentionChanged,
    "operator_connected": OperatorConnected,
    "operator_disconnected": OperatorDisconnected,
    "clock_advanced": ClockAdvanced,
}
OWN = (
    LinkMeasured,
    CopiesCounted,
    SourceReported,
    ControlPassed,
    AttentionChanged,
)  # made by the vehicle itself; no operator may request them
NAMES = {kind: name for name, kind in EVENTS.items()}

_EXACT = ("kbps", "lower_kbps", "scaling")
_ROI = ("x", "y", "width", "height")


def parse(document: Mapping[str, Any]) -> Event:
    """The event described by a JSON object that satisfies the schema."""
    values = dict(document)
    kind = EVENTS[values.pop("event")]
    for key in _EXACT:
        if key in values:
            values[key] = exact(values[key])
    if "attention" in values:
        values["attention"] = Attention(values["attention"])
    if kind is ModeSelected:
        values["mode"] = Mode(values["mode"])
    elif kind is LinkMeasured:
        values["state"] = LinkState(values["state"])
        values["evidence"] = Evidence(**values["evidence"])
    elif kind is RoiSet:
        values["roi"] = Roi(*(int(values.pop(key)) for key in _ROI))
    elif kind is WeightsSet:
        values["weights"] = {name: exact(weight) for name, weight in values["weights"].items()}
    return kind(**values)


def to_json(event: Event) -> dict[str, Any]:
    """The JSON object that `parse` reads back as the same event; unknown values are left out."""
    document: dict[str, Any] = {"t": event.t, "event": NAMES[type(event)]}
    for name in (f.name for f in fields(event) if f.name != "t"):
        value = getattr(event, name)
        if value is None:
            continue
        if isinstance(value, Roi):
            document |= {key: getattr(value, key) for key in _ROI}
        elif isinstance(value, Evidence):
            document[name] = value._asdict()
        elif isinstance(value, Mapping):
            document[name] = {camera: plain(Fraction(of)) for camera, of in value.items()}
        else:
            document[name] = plain(value) if isinstance(value, Fraction) else value
    return document


def describe(event: Event) -> str:
    """An event in one line: its name, keys and values; without a reason, which the decision states."""
    document = to_json(event)
    words = (f"{key} {value}" for key, value in document.items() if key not in ("t", "event", "reason"))
    return " ".join((document["event"], *words))
