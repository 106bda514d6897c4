"""What was decided, commanded and applied, as records."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any

from msgspec import UNSET, UnsetType

from runner.core.commands import Command, KnobValues
from runner.core.decision import Believed, Decision, Setting, UplinkShare
from runner.core.limits import Count, Limits
from runner.core.model import Mode, Roi, plain
from runner.records import Amount, CameraName, Json, Number, Time, to_json

KNOBS = ("sending", "roi", "size", "bitrate", "fps", "wave_s", "uplinks")
Applied = Annotated[Mapping[str, Any], "by knob, the value read back; empty for a camera without a pipeline"]


@dataclass(frozen=True, slots=True)
class CameraDecision:
    """The decision for one camera, see `runner.core.decision.Setting`.

    scaling        selected factor; None while the camera is off or its source cannot be opened
    width, height  of the encoded picture, px; 0 while the camera is off
    """

    on: Annotated[bool, "whether the camera is switched on"]
    sending: Annotated[bool, "whether anything of it is encoded"]
    demand_kbps: Annotated[Amount, "Eq. (1), kbit/s"]
    kbps: Annotated[Count, "allocated, kbit/s"]
    scaling: Annotated[Number, Limits(above=0, most=1)] | None
    roi: Roi
    width: Count
    height: Count
    reason: Annotated[str, "why, in words"]
    uplinks: Annotated[tuple[str, ...] | UnsetType, "that carry it, its own first; absent: there is one"] = field(
        default=UNSET, kw_only=True
    )
    fps: Annotated[
        Number | UnsetType, Limits(above=0), "Hz at which its pictures are sent; absent: the camera's own rate"
    ] = field(default=UNSET, kw_only=True)
    wave_s: Annotated[
        Number | UnsetType, Limits(above=0), "between two refresh waves, s; absent: none is asked for"
    ] = field(default=UNSET, kw_only=True)

    @classmethod
    def of(cls, setting: Setting) -> CameraDecision:
        return cls(**decided(setting))


@dataclass(frozen=True, slots=True)
class UplinkDecision:
    """What one of several uplinks is to carry, see `runner.core.decision.UplinkShare`."""

    total_kbps: Annotated[Amount, "of all cameras and copies on it, kbit/s"]
    stalled: Annotated[bool, "whether nothing arrives over it"]
    reason: Annotated[str, "what limits the total, in words; empty: nothing"]
    believed: Annotated[Believed | UnsetType, "absent: no rule believes anything of it"] = UNSET

    @classmethod
    def of(cls, share: UplinkShare) -> UplinkDecision:
        return cls(plain(share.total), share.stalled, share.reason, share.believed or UNSET)


UplinkDecisions = Annotated[
    Mapping[str, UplinkDecision] | UnsetType, "by uplink; absent: no rule shares the total among several"
]


@dataclass(frozen=True, slots=True)
class Turned:
    """A knob of a camera that was turned."""

    camera: CameraName
    knob: Annotated[
        str, Limits(among=("sending", "roi", "size", "bitrate", "fps", "wave_s", "uplinks")), "name of the knob"
    ]
    value: Annotated[Any, "the new one"]


@dataclass(frozen=True, slots=True)
class DecisionMade:
    """A decision that changed something, its cause, and the resulting commands."""

    t: Time
    cause: Annotated[str, "the event that it comes from, in words"]
    mode: Mode
    total_kbps: Annotated[Amount, "before the cap at demand, kbit/s"]
    cameras: Annotated[Mapping[str, CameraDecision], "settings by camera"]
    commands: Annotated[tuple[Turned, ...], "knobs that were turned"]
    believed: Annotated[Believed | UnsetType, "absent: no rule believes anything of the uplink"] = UNSET
    uplinks: UplinkDecisions = UNSET

    @classmethod
    def of(cls, t: float, cause: str, decision: Decision, commands: tuple[Command, ...]) -> DecisionMade:
        cameras = {name: CameraDecision.of(setting) for name, setting in decision.settings.items()}
        turned = tuple(Turned(**command.to_json()) for command in commands)
        believed, uplinks = decision.believed or UNSET, uplinks_decided(decision)
        return cls(t, cause, decision.mode, plain(decision.total), cameras, turned, believed, uplinks)


def decision_to_json(decision: Decision) -> Json:
    """The JSON object of a decision; without an intermediate record, since a replay writes thousands per second."""
    cameras = {name: decided(setting) | {"roi": setting.roi.to_json()} for name, setting in decision.settings.items()}
    document = {"mode": decision.mode, "total_kbps": plain(decision.total), "cameras": cameras}
    if decision.believed is not None:
        document["believed"] = to_json(decision.believed)
    if decision.uplinks:
        document["uplinks"] = to_json(uplinks_decided(decision))
    return document


def uplinks_decided(decision: Decision) -> Mapping[str, UplinkDecision] | UnsetType:
    return {name: UplinkDecision.of(share) for name, share in decision.uplinks.items()} or UNSET


def applied_to_json(camera: str, knobs: KnobValues) -> Applied:
    """Current values of a camera's knobs, by name."""
    return {knob: Command(camera, knob, value).to_json()["value"] for knob, value in knobs.items()}


def decided(setting: Setting) -> Json:
    """The fields of a `CameraDecision`."""
    values: Json = {
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
    if setting.fps is not None:
        values["fps"] = plain(setting.fps)
    if setting.wave_s is not None:
        values["wave_s"] = plain(setting.wave_s)
    if setting.uplinks:
        values["uplinks"] = setting.uplinks
    return values
