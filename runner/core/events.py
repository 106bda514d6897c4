"""Events: one vocabulary for the control link, the drive log and `replay`.

An `Event` is valid once built; `parse` turns JSON that schemas/event.schema.json accepts into one. That schema is made
from the classes below: from their docstrings, and the limits and notes in their types.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields
from enum import StrEnum
from fractions import Fraction
from typing import Annotated, Any, NamedTuple, get_args

from runner.core.limits import Count, Limits, NonNegative, Share
from runner.core.model import Kbps, Mode, Roi, exact, plain
from runner.core.roles import Role
from runner.core.view import Seen

LEAST_ERROR = 0.01  # of a prediction's deviation
Rate = Annotated[Kbps, Limits(0)]
Latitude = Annotated[float, Limits(-90, 90)]
Longitude = Annotated[float, Limits(-180, 180)]
Steering = Annotated[float, Limits(-1.5, 1.5)]
BACK_S = 60.0  # of a marked moment that does not state how long ago it began
CameraName = Annotated[str, Limits(1), "name of a camera of the vehicle"]
Asker = Annotated[str, Limits(1), "its id; the vehicle takes it from the topic of the request"]


class Refused(Exception):
    """A well-formed event cannot be accepted now; the text gives the reason and the valid values."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Event:
    """Something that happened."""

    t: Annotated[NonNegative, "s since the start of the run; never decreases"]


@dataclass(frozen=True, slots=True, kw_only=True)
class ModeSelected(_Event):
    """The operator selects the video rate control mode."""

    mode: Mode


@dataclass(frozen=True, slots=True, kw_only=True)
class BitratePredicted(_Event):
    """Prediction of the bitrate available for all cameras together, from pQoS; its source may know more of it.

    Modes that go beyond the paper use the other values, follow_link bias and error until it knows better.
    """

    uplink: Annotated[str, "the one that it is for; empty: all together"] = ""
    kbps: Annotated[Rate, "the prediction, kbit/s"]
    lower_kbps: Annotated[Rate | None, "likely lower bound, kbit/s"] = None
    valid_s: Annotated[NonNegative | None, "how long it may be used, s"] = None
    bias: Annotated[float | None, Limits(-10, 10), "mean of ln(capacity / kbps)"] = None
    error: Annotated[float | None, Limits(LEAST_ERROR, 10), "standard deviation of ln(capacity / kbps)"] = None


@dataclass(frozen=True, slots=True, kw_only=True)
class PositionReported(_Event):
    """Where the vehicle is."""

    lat: Annotated[Latitude, "degrees north (WGS-84)"]
    lon: Annotated[Longitude, "degrees east (WGS-84)"]
    speed_mps: Annotated[NonNegative | None, "speed over ground, m/s"] = None
    heading_deg: Annotated[float | None, Limits(0, 360), "direction of travel, degrees clockwise from north"] = None


class Gear(StrEnum):
    """Gear of the vehicle, as its lever names it."""

    PARK = "P"
    REVERSE = "R"
    NEUTRAL = "N"
    DRIVE = "D"


@dataclass(frozen=True, slots=True, kw_only=True)
class SteeringReported(_Event):
    """The front wheels are turned; what reports them usually knows the gear, too."""

    rad: Annotated[Steering, "their angle (bicycle model), rad, positive to the left"]
    gear: Annotated[Gear | None, "in which the vehicle is"] = None


@dataclass(frozen=True, slots=True, kw_only=True)
class TotalSet(_Event):
    """The operator sets the total bitrate, mode collective."""

    kbps: Annotated[Rate, "of all cameras, kbit/s"]


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraSwitched(_Event):
    """The operator switches a camera on or off, any mode."""

    camera: CameraName
    on: Annotated[bool, "true: on, false: off"]


@dataclass(frozen=True, slots=True, kw_only=True)
class RoiSet(_Event):
    """The operator sets the region of interest of a camera, mode single; the full image in every mode.

    It must lie inside the full image and be at least 16x16; otherwise the event is refused.
    """

    camera: CameraName
    roi: Roi


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraConfigured(_Event):
    """The operator sets bitrate, scaling factor or both of a camera, mode single; None: unchanged."""

    camera: CameraName
    kbps: Annotated[Rate | None, "from 1 to its b_full, kbit/s"] = None
    scaling: Annotated[Fraction | None, Limits(0), "factor of its resolution, in ]0, 1]"] = None


@dataclass(frozen=True, slots=True, kw_only=True)
class WeightsSet(_Event):
    """The operator changes explicit camera weights; cameras not named keep theirs.

    weights  by camera, no unit; 0 gives the camera nothing beyond its floor in modes A and C
    """

    weights: Annotated[Mapping[str, Annotated[Fraction, Limits(0)]], Limits(1)]


@dataclass(frozen=True, slots=True, kw_only=True)
class MomentMarked(_Event):
    """Somebody marks what has just happened: the drive is to be kept. It changes nothing else."""

    back_s: Annotated[NonNegative, "how long ago it began, s"] = BACK_S


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

    busy_kbit: NonNegative = 0.0
    busy_s: NonNegative = 0.0
    train_kbit: NonNegative = 0.0
    train_s: NonNegative = 0.0
    trains: Count = 0
    idle_kbit: NonNegative = 0.0
    idle_s: NonNegative = 0.0
    idle: Count = 0
    unqueued: Count = 0
    kbit: NonNegative = 0.0
    wait_s: NonNegative = 0.0
    longest_s: NonNegative = 0.0
    shorter_s: NonNegative = 0.0
    growth: float = 0.0
    lost_kbit: NonNegative = 0.0
    age_s: float = 0.0
    silent_s: NonNegative = 0.0
    backlog: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkMeasured(_Event):
    """The uplink, by what the operator's side received of all cameras, see `runner.core.evidence`."""

    uplink: Annotated[str, "its name; empty: the vehicle has one, without a name"] = ""
    kbps: Annotated[Rate, "received in the last 0.5 s, kbit/s"]
    queue_ms: Annotated[NonNegative, "standing queue in front of the link, ms"]
    loss: Annotated[Share, "share of the packets of the last second that was lost, 0 to 1"]
    state: Annotated[LinkState, "stalled: nothing arrives"]
    rtt_ms: Annotated[NonNegative, "round trip of the control link, ms"]
    evidence: Annotated[Evidence, "of the link's capacity"]


@dataclass(frozen=True, slots=True, kw_only=True)
class CopiesCounted(_Event):
    """Another number of viewers receives a camera's stream.

    copies  by camera, how many leave the vehicle, one per viewer; 1 for cameras not named
    """

    copies: Mapping[str, Annotated[int, Limits(1, 1000)]]


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamMeasured(_Event):
    """What a camera sends whose pictures are passed on as it encodes them; until this is reported, its b_full.

    Of a camera whose bitrate can be set, what it sends although it was asked for less; 0: it does as asked.
    """

    camera: CameraName
    kbps: Annotated[Rate, "mean of the last seconds, kbit/s"]


@dataclass(frozen=True, slots=True, kw_only=True)
class SourceReported(_Event):
    """A camera's source cannot be opened, or can be again; until this is reported, it can."""

    camera: CameraName
    works: Annotated[bool, "whether it can"]
    reason: Annotated[str | None, "why it cannot, for the operator; None: it can"] = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlPassed(_Event):
    """Another operator is in control; measurements of the previous one are no longer valid."""

    operator: Annotated[str, 'its id; "": none']


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlRequested(_Event):
    """An operator asks for control: it gets that of a free vehicle at once, else the holder sees that it asks."""

    operator: Asker


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlOffered(_Event):
    """The operator in control offers it to another one, which then receives the pictures, too."""

    operator: Asker
    to: Annotated[str, 'id of the other; "": the offer is withdrawn']


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlAccepted(_Event):
    """An operator accepts the offer made to it; unless the vehicle stands, it has to see every camera that is sent."""

    operator: Asker
    live: Annotated[tuple[str, ...], "the cameras whose pictures have been live at its station for 1 s or longer"]


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlDenied(_Event):
    """The operator in control declines the request of another one, which may ask again."""

    operator: Asker
    to: Annotated[str, "id of the other"]


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlReleased(_Event):
    """An operator gives up what it has: control of a vehicle that stands, an offer made to it, or its request."""

    operator: Asker


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlTaken(_Event):
    """A supervisor takes control, whoever has it, also while the vehicle moves."""

    operator: Asker


@dataclass(frozen=True, slots=True, kw_only=True)
class StopRequested(_Event):
    """An operator, also one that only watches, asks the vehicle to stop: the advised speed is 0 until it is lifted."""

    operator: Asker


@dataclass(frozen=True, slots=True, kw_only=True)
class StopLifted(_Event):
    """The operator in control, or a supervisor, lifts what was asked: the vehicle may go on."""

    operator: Asker


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlRestored(_Event):
    """The vehicle has restarted; the operator that was in control before counts as lost until it returns.

    stop  id of the operator that asked to stop, which still stands; None: nobody did
    """

    operator: Annotated[str, 'its id; "": nobody was in control']
    stop: str | None = None


class Attention(StrEnum):
    """Whether the driver can see the pictures, as detected by the page in control."""

    WATCHING = "watching"
    UNFOCUSED = "unfocused"  # visible, but the page has no keyboard focus
    SLOW = "slow"  # fewer than 10 pictures a second are drawn
    HIDDEN = "hidden"
    ABSENT = "absent"  # the page is closed or does not respond


@dataclass(frozen=True, slots=True, kw_only=True)
class AttentionChanged(_Event):
    """The attention stated by the operator in control has changed."""

    attention: Annotated[Attention | None, "None: none stated, for example without a page"] = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewReported(_Event):
    """The operator in control sees other parts of the images.

    view  by camera; those not named are seen in full: nothing is stated of them, or nobody is in control
    """

    view: Mapping[str, Seen]


@dataclass(frozen=True, slots=True, kw_only=True)
class OperatorConnected(_Event):
    """An operator's side is connected.

    operator   its id; the vehicle takes it from the topic of the request. Absent: not stated, as in earlier logs
    role       by its keys, stated by the vehicle; without keys everybody is a supervisor
    attention  stated by the operator's page with its heartbeat; the vehicle derives `AttentionChanged` from it
    watching   true: it only watches, and must not be given control
    """

    operator: str | None = None
    role: Role | None = None
    attention: Attention | None = None
    watching: bool | None = None


class Departure(StrEnum):
    """How an operator has left."""

    SIGNED_OFF = "signed off"
    SILENT = "has been silent for 1 s"
    WITHDRAWN = "its keys were withdrawn"


@dataclass(frozen=True, slots=True, kw_only=True)
class OperatorDisconnected(_Event):
    """An operator's side has disconnected, or the control link to it is lost.

    operator, departure  stated by the vehicle, as `operator` of `OperatorConnected`
    """

    operator: str | None = None
    departure: Departure | None = None


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
    | MomentMarked
    | LinkMeasured
    | CopiesCounted
    | StreamMeasured
    | SourceReported
    | ControlPassed
    | ControlRequested
    | ControlOffered
    | ControlAccepted
    | ControlDenied
    | ControlReleased
    | ControlTaken
    | StopRequested
    | StopLifted
    | ControlRestored
    | AttentionChanged
    | ViewReported
    | OperatorConnected
    | OperatorDisconnected
    | ClockAdvanced
)
EVENTS: dict[str, type[Event]] = {  # mode_selected: ModeSelected
    re.sub(r"\B[A-Z]", r"_\g<0>", kind.__name__).lower(): kind for kind in get_args(Event)
}
OWN = (
    LinkMeasured,
    CopiesCounted,
    StreamMeasured,
    SourceReported,
    ControlPassed,
    ControlRestored,
    AttentionChanged,
    ViewReported,
)  # made by the vehicle itself; no operator may request them
NAMES = {kind: name for name, kind in EVENTS.items()}

_WORDS: Mapping[str, Callable[[Any], Any]] = {
    "mode": Mode,
    "state": LinkState,
    "attention": Attention,
    "role": Role,
    "departure": Departure,
    "gear": Gear,
    "live": tuple,
}
_EXACT = ("kbps", "lower_kbps", "scaling")
_ROI = ("x", "y", "width", "height")


def parse(document: Mapping[str, Any]) -> Event:
    """The event described by a JSON object that satisfies the schema."""
    values = dict(document)
    kind = EVENTS[values.pop("event")]
    for key in _EXACT:
        if key in values:
            values[key] = exact(values[key])
    for key, kind_of in _WORDS.items():
        if key in values:
            values[key] = kind_of(values[key])
    if kind is LinkMeasured:
        values["evidence"] = Evidence(**values["evidence"])
    elif kind is RoiSet:
        values["roi"] = Roi(*(int(values.pop(key)) for key in _ROI))
    elif kind is ViewReported:
        values["view"] = {name: Seen(**seen) for name, seen in values["view"].items()}
    elif kind is WeightsSet:
        values["weights"] = {name: exact(weight) for name, weight in values["weights"].items()}
    return kind(**values)


def to_json(event: Event) -> dict[str, Any]:
    """The JSON object that `parse` reads back as the same event; unknown values are left out."""
    document: dict[str, Any] = {"t": event.t, "event": NAMES[type(event)]}
    for name in (f.name for f in fields(event) if f.name != "t"):
        value = getattr(event, name)
        if value is None or (name, value) == ("uplink", ""):
            continue
        if isinstance(value, Roi):
            document |= {key: getattr(value, key) for key in _ROI}
        elif isinstance(value, Evidence):
            document[name] = value._asdict()
        elif isinstance(value, tuple):
            document[name] = list(value)
        elif isinstance(event, ViewReported):
            document[name] = {camera: asdict(seen) for camera, seen in event.view.items()}
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
