"""What changes on the vehicle, as phrases for the operator. Pure."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from fractions import Fraction
from typing import TYPE_CHECKING

from msgspec import UNSET

from runner.core.driving import Control, Driving
from runner.core.events import EVENTS
from runner.core.model import Mode
from runner.operator.sound import sound_notes, voice_notes
from runner.records.vehicle import CameraState, VehicleState

if TYPE_CHECKING:
    from runner.apply import Reception

EXPLAINED_S = 1.0  # after a refusal, until the vehicle's state has said why
UNEXPLAINED = "no room on the vehicle's uplink: media.max_viewers"

# First words of a note, by the event that caused the decision, where its name is not enough; fields as in
# `runner.core.events.describe`.
CAUSES = {
    "bitrate_predicted": "Prediction {kbps} kbit/s",
    "mode_selected": "Mode {mode}",
    "position_reported": "New position",
    "steering_reported": "New steering angle",
    "total_set": "Total set to {kbps} kbit/s",
    "camera_switched": "{camera} switched",
    "roi_set": "ROI of {camera} set",
    "camera_configured": "{camera} configured",
    "copies_counted": "Number of viewers changed",
    "source_reported": "{camera}'s source",
    "clock_advanced": "Time elapsed",
}


NAMED_SIZES = {Fraction(1): "full", Fraction(1, 2): "half", Fraction(1, 4): "quarter"}


def change_notes(before: VehicleState, state: VehicleState) -> Iterator[str]:
    """Who drives or speaks, that rules fail or decide again, uplinks stall, cameras move, sound is lost; a decision."""
    if state.driving is not UNSET and (before.driving is UNSET or state.driving.why != before.driving.why):
        yield state.driving.why
    if state.fault != before.fault:
        yield f"{state.fault}; the previous decision stays in force" if state.fault else "the rules decide again"
    yield from _uplink_notes(before, state)
    yield from sound_notes(before, state)
    yield from voice_notes(before, state)
    if text := decision_note(before, state):
        yield text


def driver_words(driving: Driving, own: str, since: float) -> str:
    """Who drives, and what operators have asked or offered.

        you are in control since 14:03:12; bob asks for control
        alice is in control since 14:03:12; offered to you
        nobody is in control

    own    the operator of this side, who is called you
    since  the time of `Driving.since`, s since 1970
    """

    def named(name: str) -> str:
        return "you" if name == own else name

    parts = ["nobody is in control"]
    if driving.holder:
        be = "are" if driving.holder == own else "is"
        state = "lost" if driving.state is Control.LOST else "in control"
        at = time.strftime("%H:%M:%S", time.localtime(since))
        parts = [f"{named(driving.holder)} {be} {state} since {at}"]
    if driving.offered is not None:
        parts.append(f"offered to {named(driving.offered)}")
    asking = [named(name) for name in driving.requested if name != driving.offered]
    if driving.stop:
        parts.append(f"{named(driving.stop)} asked to stop: advised speed 0")
    if asking:
        parts.append(f"{', '.join(asking)} {'ask' if asking[1:] or asking == ['you'] else 'asks'} for control")
    return "; ".join(parts)


def decision_note(before: VehicleState, state: VehicleState) -> str | None:
    """The changes made by a decision, and why.

        Prediction 900 kbit/s: rear smaller, at quarter size (300 of 4000 kbit/s)
        Mode automatic: front, rear smaller, at quarter size; mast on, at 1/8 size (3 of 8 cameras, total 900 kbit/s)
        Mode single: total 3000 kbit/s, cameras keep what mode collective gave them

    before, state  as the vehicle publishes them; the formula behind a size is the camera's `reason`
    returns        None if neither the mode nor any camera's stream changes
    """
    cameras = state.cameras
    changes = {name: _change(before.cameras.get(name, now), now) for name, now in cameras.items()}
    changed = {name: change for name, change in changes.items() if change}
    cause = _cause(state.cause)
    if before.mode != state.mode and not cause.startswith("Mode "):
        cause = f"Mode {state.mode}; {cause}"
    if not changed:
        kept = f", cameras keep what mode {before.mode} gave them" if state.mode is Mode.SINGLE else ""
        return None if before.mode == state.mode else f"{cause}: total {state.total_words} kbit/s{kept}"
    # Each has the camera's own reason first, then those of the whole decision.
    common = [cameras[name].reason.split("; ")[1:] for name in changed]
    shared = [_limit_words(part) for part in common[0] if all(part in parts for parts in common)]
    what = f"{len(changed)} of {len(cameras)} cameras, total {state.total_words} kbit/s"
    if len(changed) == 1:
        what = _rate(cameras[next(iter(changed))])
    why = "; ".join(filter(None, (what, *shared)))
    names_by_change: dict[str, list[str]] = {}
    for name, change in changed.items():
        names_by_change.setdefault(change, []).append(name)
    listed = "; ".join(f"{', '.join(names)} {change}" for change, names in names_by_change.items())
    return f"{cause}: {listed}" + (f" ({why})" if why else "")


def _uplink_notes(before: VehicleState, state: VehicleState) -> Iterator[str]:
    """Which uplinks stall or work again, and which cameras go over another one.

    uplink a: nothing arrives; rear, mast go over b
    rear goes over b
    """
    if before.uplinks is UNSET or state.uplinks is UNSET:
        return
    moved: dict[tuple[str, str], list[str]] = {}
    for name, camera in state.cameras.items():
        was, now = (_carriers(each) for each in (before.cameras.get(name, camera), camera))
        if was and now and now[0] not in was:  # otherwise it has carried the camera already, as of a redundant one
            moved.setdefault((was[0], now[0]), []).append(name)
    for uplink, own in state.uplinks.items():
        if uplink in before.uplinks and before.uplinks[uplink].stalled != own.stalled:
            away = [_go(moved.pop(way), way[1]) for way in list(moved) if own.stalled and way[0] == uplink]
            yield "; ".join((f"uplink {uplink}: {'nothing arrives' if own.stalled else 'works again'}", *away))
    yield from (_go(names, to) for (_, to), names in moved.items())


def _carriers(camera: CameraState) -> Sequence[str]:
    return () if camera.uplinks is UNSET else camera.uplinks


def _go(names: Sequence[str], uplink: str) -> str:
    return f"{', '.join(names)} {'go' if names[1:] else 'goes'} over {uplink}"


def _cause(described: str) -> str:
    """The event's phrase; its unchanged text if the event is unknown."""
    event, *words = described.split(" ")
    if event not in EVENTS:
        return described
    phrase = CAUSES.get(event, event.replace("_", " ").capitalize())
    values = dict(zip(words[::2], words[1::2], strict=False))
    try:
        return phrase.format_map(values) + (f", uplink {values['uplink']}" if values.get("uplink") else "")
    except KeyError:
        return described


def _change(was: CameraState, now: CameraState) -> str:
    """The change of one camera; "" if none."""
    parts = [_sent(was, now)] if _form(was) != _form(now) else []
    if was.roi != (roi := now.roi):
        parts.append(f"ROI {roi.width}x{roi.height} at {roi.x}, {roi.y}")
    return ", ".join(parts)


def _sent(was: CameraState, now: CameraState) -> str:
    """Whether, and at which size."""
    form, before = _form(now), _form(was)
    if isinstance(form, str):
        return form
    change = "on" if isinstance(before, str) else "smaller" if form < before else "larger"
    return f"{change}, at {size_words(form)}"


def _form(camera: CameraState) -> str | float:
    """The factor of a camera that is sent, or why it is not."""
    if not camera.on:
        return "off"
    if camera.scaling is None:
        return "lost"
    return camera.scaling if camera.sending else "paused"


def size_words(factor: float) -> str:
    """A scaling factor for a driver: half size, 3/8 size, 0.3 of full size."""
    exact = Fraction(factor).limit_denominator(16)
    name = NAMED_SIZES.get(exact, str(exact))
    return f"{name} size" if exact == factor else f"{factor:.2g} of full size"


def _limit_words(part: str) -> str:
    """What limits the total, without the totals: total 3000 -> 1690: capacity of the link, believed to be 1690."""
    words = part.partition(": ")[2] if part.startswith("total ") else part
    return f"{words} kbit/s" if words[-1:].isdigit() else words


def _rate(camera: CameraState) -> str:
    """The allocated bitrate of what the camera could use; of one that is not sent, why."""
    if not camera.sending:
        return camera.reason.split("; ")[0].removeprefix("lost: ") if camera.scaling is None and camera.on else ""
    return f"{camera.kbps:.0f} of {max(camera.kbps, camera.demand_kbps):.0f} kbit/s"


class Refusals:
    """Why the vehicle refuses this operator's receivers their pictures. Times are s by any steady clock.

    operator  id of this operator
    words     by refused camera, why
    """

    def __init__(self, operator: str) -> None:
        self._operator = operator
        self._since: dict[str, float] = {}  # when each camera was first refused
        self._noted: Mapping[str, str] = {}
        self.words: Mapping[str, str] = {}

    def update(self, received: Mapping[str, Reception], cameras: Mapping[str, CameraState], now: float) -> list[str]:
        """Take what the receivers met, and the vehicle's state; returns what there is to tell the operator.

        cameras  by the vehicle's state; none while it is offline
        """
        refused = [name for name, each in received.items() if each.refused]
        self._since = {name: self._since.get(name, now) for name in refused}
        told = {name: self._told(cameras.get(name)) for name in refused}
        self.words = {name: why or UNEXPLAINED for name, why in told.items()}
        if any(not why and now - self._since[name] < EXPLAINED_S for name, why in told.items()):
            return []  # it is about to be explained
        before, self._noted = self._noted, self.words
        names: dict[str, list[str]] = {}
        for name, why in self.words.items():
            if before.get(name) != why:
                names.setdefault(why, []).append(name)
        return [f"{', '.join(cameras)}: refused by the vehicle: {why}" for why, cameras in names.items()]

    def _told(self, camera: CameraState | None) -> str:
        return "" if camera is None or camera.refused is UNSET else camera.refused.get(self._operator, "")
