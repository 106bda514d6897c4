"""The state, and how an event changes it."""

from __future__ import annotations

from collections.abc import Mapping, Set
from dataclasses import dataclass, field, fields, replace
from fractions import Fraction
from operator import attrgetter
from typing import Any, assert_never

from runner.core import driving as dr
from runner.core import events as ev
from runner.core.budget import SOUND, with_sound
from runner.core.decision import NOTHING, Decision
from runner.core.events import Refused
from runner.core.model import SMALLEST_SIDE_PX, Camera, Kbps, Mode, Roi, Vehicle, plain
from runner.core.view import View
from runner.errors import suggest


@dataclass(frozen=True, slots=True)
class Manual:
    """A camera's bitrate (kbit/s) and factor in mode single."""

    kbps: int
    scaling: Fraction


@dataclass(frozen=True, slots=True)
class State:
    """Inputs of the rules: by camera, or the newest that was reported. What no event has set yet is None."""

    mode: Mode
    on: Mapping[str, bool]  # as the operator has it; the rules see a camera that is lost as off
    rois: Mapping[str, Roi]
    weights: Mapping[str, Fraction]
    manual: Mapping[str, Manual]  # settings of mode single, or the last ones of a camera that is off
    t: float = 0.0  # s, time of the last event
    prediction: ev.BitratePredicted | None = None  # for all uplinks together, whatever the mode when it arrived
    predictions: Mapping[str, ev.BitratePredicted] = field(default_factory=lambda: NOTHING)  # by uplink with a name
    total_set: Kbps | None = None  # kbit/s, the operator's last total
    collective_total: Kbps | None = None  # kbit/s, total of mode collective
    operator_since: float | None = None  # t of its side's connection, or of control of an unmeasured link; None: gone
    operator_lost: float | None = None  # t at which the operator's side disconnected
    attention: ev.Attention | None = None  # of the driver, as the operator in control states it
    attention_since: float | None = None  # t of its last change
    view: View = field(default_factory=lambda: NOTHING)  # what the operator in control sees; others: in full
    link: ev.LinkMeasured | None = None  # None: no operator measures it, or uplinks have names
    links: Mapping[str, ev.LinkMeasured] = field(default_factory=lambda: NOTHING)  # by uplink with a name
    position: ev.PositionReported | None = None
    steering: ev.SteeringReported | None = None
    copies: Mapping[str, int] = field(default_factory=lambda: NOTHING)  # that leave the vehicle; 1 for others
    streams: Mapping[str, Kbps] = field(default_factory=lambda: NOTHING)  # of cameras that encode by themselves, kbit/s
    lost: Mapping[str, str] = field(default_factory=lambda: NOTHING)  # why its source cannot be opened
    driving: dr.Driving = field(default_factory=dr.Driving)
    motion: dr.Motion = field(default_factory=dr.Motion)

    @staticmethod
    def initial(vehicle: Vehicle, mode: Mode) -> State:
        """Every camera on, with its full image as ROI."""
        cameras = vehicle.cameras
        return State(
            mode=mode,
            on=dict.fromkeys(cameras, True),
            rois={name: camera.full_roi for name, camera in cameras.items()},
            weights={name: camera.weight for name, camera in cameras.items()},
            manual={},
        )

    @property
    def predicted_kbps(self) -> Kbps | None:
        """For all uplinks together: the newest prediction for these, otherwise the sum of those for single ones."""
        if self.prediction:
            return self.prediction.kbps
        return sum((own.kbps for own in self.predictions.values()), Kbps(0)) if self.predictions else None

    def over(self, uplink: str, uplinks: int) -> State:
        """As if this uplink, one of several, were the only one.

        Without predictions of its own it has an equal part of those for all together.
        """
        own, of_all = self.predictions.get(uplink), self.prediction
        if own is None and of_all:
            lower = None if of_all.lower_kbps is None else of_all.lower_kbps / uplinks
            own = replace(of_all, kbps=of_all.kbps / uplinks, lower_kbps=lower)
        return replace(self, link=self.links.get(uplink), prediction=own)


_FIELDS = tuple(part.name for part in fields(State))
_values = attrgetter(*_FIELDS)


def advance(vehicle: Vehicle, state: State, event: ev.Event, in_force: Decision) -> State:
    """The state after an event.

    in_force  the decision in force when the event arrives, as it would be without the measured link: entering S or
              C starts from it
    raises    Refused
    """
    # As dataclasses.replace, in half the time.
    values = dict(zip(_FIELDS, _values(state), strict=True))
    return State(**(values | {"t": event.t} | _changes(vehicle, state, event, in_force)))


def _changes(vehicle: Vehicle, state: State, event: ev.Event, in_force: Decision) -> dict[str, Any]:  # noqa: PLR0911, PLR0912
    """Changes of the state by an event, by field."""
    match event:
        case ev.BitratePredicted(uplink=uplink):
            return {"predictions": _of_uplink(vehicle, state.predictions, event)} if uplink else {"prediction": event}
        case ev.ModeSelected(mode=mode):
            return _enter(vehicle, state, mode, in_force)
        case ev.TotalSet(kbps=kbps):
            _only_in(Mode.COLLECTIVE, state, event)
            return {"total_set": kbps, "collective_total": kbps}
        case ev.CameraSwitched(camera=name, on=on):
            _known(vehicle, name)
            return {"on": {**state.on, name: on}, "manual": _manual(state, in_force, name, on)}
        case ev.StreamMeasured(camera=name, kbps=kbps):
            _known(vehicle, name)
            return {"streams": {**state.streams, name: kbps}}
        case ev.SourceReported(camera=name, works=works, reason=reason):
            _known(vehicle, name)
            others = {other: why for other, why in state.lost.items() if other != name}
            lost = others if works else {**others, name: reason or "its source does not open"}
            return {"lost": lost, "manual": _manual(state, in_force, name, works)}
        case ev.RoiSet(camera=name, roi=roi):
            known = vehicle.cameras.get(name)
            if known is None or roi != known.full_roi:  # what a region leaves out can be had back at any time
                _only_in(Mode.SINGLE, state, event)
            _check_roi(_encoded_here(_known(vehicle, name), "choose the region on the page"), roi)
            return {"rois": {**state.rois, name: roi}}
        case ev.CameraConfigured(camera=name):
            _only_in(Mode.SINGLE, state, event)
            configured = _configured(_settable(vehicle, _known(vehicle, name), event), state.manual[name], event)
            return {"manual": {**state.manual, name: configured}}
        case ev.WeightsSet(weights=weights):
            for name in weights:
                _known(vehicle, name)
            return {"weights": {**state.weights, **weights}}
        case ev.LinkMeasured():
            return {"links": _of_uplink(vehicle, state.links, event)} if vehicle.uplinks else {"link": event}
        case ev.ControlPassed(operator=operator):
            # Another place, network path and person. If the link is not measured, it is as if they had just connected.
            unstated = {"attention": None, "attention_since": event.t, "view": NOTHING}
            is_new = bool(operator) and state.link is None and state.operator_since is not None
            since = event.t if is_new else state.operator_since
            return {"link": None, "links": NOTHING, "operator_since": since, **unstated}
        case ev.AttentionChanged(attention=attention):
            return {"attention": attention, "attention_since": event.t}
        case ev.ViewReported(view=view):
            for name, seen in view.items():
                _check_inside(_known(vehicle, name), seen.roi, "view")
            return {"view": view}
        case ev.CopiesCounted(copies=copies):
            for name in copies:
                if not (vehicle.sound and name == SOUND):
                    _known(vehicle, name)
            return {"copies": copies}
        case ev.OperatorConnected():
            since = event.t if state.operator_since is None else state.operator_since
            return {"operator_since": since, "operator_lost": None, **_driving(state, event)}
        case ev.OperatorDisconnected():
            changes = _driving(state, event)
            if changes["driving"].present or state.operator_lost is not None:
                return changes
            gone = {"operator_since": None, "operator_lost": event.t, "attention": None, "attention_since": event.t}
            return {**changes, **gone, "view": NOTHING, "link": None, "links": NOTHING}
        case ev.PositionReported():
            motion = state.motion.after(event)
            return {"position": event, "motion": motion, **_driving(replace(state, motion=motion), event)}
        case ev.SteeringReported():
            return {"steering": event}
        case (
            ev.ControlRequested()
            | ev.ControlOffered()
            | ev.ControlDenied()
            | ev.ControlReleased()
            | ev.ControlTaken()
            | ev.StopRequested()
            | ev.StopLifted()
            | ev.ControlRestored()
            | ev.ClockAdvanced()
        ):
            return _driving(state, event)
        case ev.ControlAccepted():
            return _driving(state, event, {name for name, setting in in_force.settings.items() if setting.sending})
        case ev.MomentMarked():
            return {}
        case _:
            assert_never(event)


def _driving(state: State, event: ev.Event, sent: Set[str] = frozenset()) -> dict[str, Any]:
    return {"driving": dr.advance(state.driving, state.motion, event, sent)}


def _manual(state: State, in_force: Decision, name: str, is_sent: bool) -> Mapping[str, Manual]:
    """The settings of mode single once a camera is sent or no longer sent.

    One that is sent again in S gets its last values; in S these are the operator's, whatever the link carries.
    """
    kept = {} if is_sent or state.mode is Mode.SINGLE else keep(in_force, name)
    return {**state.manual, **kept} if kept else state.manual


def keep(in_force: Decision, *names: str) -> dict[str, Manual]:
    """Bitrate and factor of the cameras that are on as settings of mode single, even without a connected operator."""
    settings = ((name, in_force.settings[name]) for name in names or in_force.settings)
    return {name: Manual(s.given, s.scaling) for name, s in settings if s.scaling is not None}


def _enter(vehicle: Vehicle, state: State, mode: Mode, in_force: Decision) -> dict[str, Any]:
    """Change the mode without a jump: S keeps the settings, C keeps the total unless the operator has set one."""
    if mode is state.mode:
        return {}
    match mode:
        case Mode.SINGLE:
            return {"mode": mode, "manual": {**state.manual, **keep(in_force)}}
        case Mode.COLLECTIVE:
            total = state.total_set
            if total is None:
                total = with_sound(vehicle, state.copies, in_force.total)
            return {"mode": mode, "collective_total": total}
        case Mode.AUTOMATIC:
            return {"mode": mode}


def _known(vehicle: Vehicle, name: str) -> Camera:
    if name in vehicle.cameras:
        return vehicle.cameras[name]
    raise Refused(f"unknown camera {name!r}{suggest(name, vehicle.cameras)}")


def _encoded_here(camera: Camera, instead: str) -> Camera:
    if not camera.graph.passes:
        return camera
    raise Refused(f"the pictures of {camera.name} are sent as the camera encodes them; {instead}")


def _settable(vehicle: Vehicle, camera: Camera, event: ev.CameraConfigured) -> Camera:
    """Of a camera that encodes by itself, at most the bitrate can be set."""
    if camera.name in vehicle.lowest and event.scaling is None:
        return camera
    return _encoded_here(camera, "set its bitrate" if camera.name in vehicle.lowest else "switch it off to send less")


def _of_uplink(
    vehicle: Vehicle, known: Mapping[str, Any], event: ev.BitratePredicted | ev.LinkMeasured
) -> Mapping[str, Any]:
    """What is known by uplink, with this event."""
    if event.uplink in vehicle.uplinks:
        return {**known, event.uplink: event}
    raise Refused(f"unknown uplink {event.uplink!r}{suggest(event.uplink, vehicle.uplinks)}")


def _only_in(mode: Mode, state: State, event: ev.Event) -> None:
    if state.mode is not mode:
        raise Refused(f"{ev.NAMES[type(event)]} is accepted in mode {mode} only, the mode is {state.mode}")


def _check_roi(camera: Camera, roi: Roi) -> None:
    if min(roi.width, roi.height) < SMALLEST_SIDE_PX:
        found = f"{roi.width}x{roi.height} at {roi.x},{roi.y}"
        raise Refused(f"ROI {found} is smaller than {SMALLEST_SIDE_PX}x{SMALLEST_SIDE_PX}")
    _check_inside(camera, roi, "ROI")


def _check_inside(camera: Camera, roi: Roi, what: str) -> None:
    if roi.x + roi.width > camera.width or roi.y + roi.height > camera.height:
        found = f"{what} {roi.width}x{roi.height} at {roi.x},{roi.y}"
        raise Refused(f"{found} leaves the {camera.width}x{camera.height} image of {camera.name}")


def _configured(camera: Camera, now: Manual, event: ev.CameraConfigured) -> Manual:
    least = camera.graph.settings.lowest_kbps if camera.graph.passes else 1
    b_full = camera.rate_quality.b_full
    if event.kbps is not None and not least <= event.kbps <= b_full:
        raise Refused(f"{plain(event.kbps)} kbit/s for {camera.name} is outside {least} to {plain(b_full)}, its b_full")
    if event.scaling is not None and not 0 < event.scaling <= 1:
        raise Refused(f"scaling {plain(event.scaling)} for {camera.name} is outside ]0, 1]")
    return Manual(
        kbps=now.kbps if event.kbps is None else int(event.kbps),
        scaling=now.scaling if event.scaling is None else event.scaling,
    )
