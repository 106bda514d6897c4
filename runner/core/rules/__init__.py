"""A mode is a sequence of named rules; each adds to the draft of a decision. `registry` says what a rule is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from fractions import Fraction
from functools import cache
from typing import Any

from runner.core import allocation, scaling
from runner.core.budget import beside_sound
from runner.core.decision import NOTHING, Decision, Draft, Picture, Setting, Shown, short
from runner.core.frame_rate import is_given, sent_rate
from runner.core.model import SMALLEST_SIDE_PX, Mode, Roi, Vehicle, exact
from runner.core.rules import motion, seen, spread, steady, waves  # noqa: F401  (register their rules, as the imports below do theirs)
from runner.core.rules.paper import whole
from runner.core.rules.registry import GIVEN, Last, Memories, Memory, Rule, RuleCall, Step, rule
from runner.core.rules.safe import follow_link
from runner.core.state import State
from runner.errors import RunError

__all__ = [
    "GIVEN",
    "Memories",
    "Memory",
    "Rule",
    "RuleCall",
    "RuleFailed",
    "Step",
    "decide",
    "decide_without_link",
    "follow_link",
    "reads",
    "rule",
]

BITRATE_RULE = "must be kbit/s from 0 as an exact number (int or Fraction)"
FACTOR_RULE = "must be a Fraction in ]0, 1]"
RATE_RULE = "must be Hz above 0 as an exact number (int or Fraction)"
WEIGHT_RULE = "must be 0 or more as an exact number (int or Fraction)"
SHOWN_RULE = (
    f"must be Shown, its region at least {SMALLEST_SIDE_PX}x{SMALLEST_SIDE_PX}, its factor a Fraction in ]0, 1]"
)
PICTURE_RULE = f"must be a Picture, its region and its even sides at least {SMALLEST_SIDE_PX}"


class RuleFailed(RunError):
    """A rule raised an exception or gave a value that cannot be used; the text names rule and value."""


def decide(vehicle: Vehicle, state: State, memory: Memories) -> tuple[Decision, Memories]:
    """Pure core of the runner: run the rules of the mode in force, in order.

    To the rules, a camera that is lost is off: the others get its share.

    raises  RuleFailed, since rules may be the user's own
    """
    draft, asked = Draft(), None
    inputs = replace(state, on={**state.on, **dict.fromkeys(state.lost, False)}) if state.lost else state
    for call in vehicle.modes[state.mode]:
        before, own = draft, memory.get(call.key, NOTHING)
        try:
            draft, kept = call(vehicle, inputs, draft, own)
        except (Exception, SystemExit) as error:
            raise RuleFailed(f"rule {call.name} failed: {type(error).__name__}: {error}") from error
        if problem := _draft_problem(inputs, before, draft):
            raise RuleFailed(f"rule {call.name} failed: {problem}")
        memory = memory if kept is own else {**memory, call.key: kept}
        if draft.shown is not before.shown:  # the rules that follow share the bits among these regions
            inputs = replace(inputs, rois={**inputs.rois, **{name: shown.roi for name, shown in draft.shown.items()}})
        if draft.weights is not before.weights:
            inputs = replace(inputs, weights=_weighted(state.weights, draft.weights))
        if asked is None and draft.total is not None:
            asked = draft.total
            if vehicle.sound and not draft.bitrate:  # in mode S the total is what the operator has set for cameras
                left = beside_sound(vehicle, state.copies, asked, max(1, len(vehicle.uplinks)))
                draft = draft.limited(left, f"sound takes {short(asked - left)}")
    assert draft.total is not None and asked is not None
    settings = _settings(
        vehicle,
        state.on,
        state.lost,
        inputs.rois,
        draft._replace(total=None, uncapped=None, measured=False, believed=None, uplinks=NOTHING),
    )
    # Without a prediction there is only the measurement, so the total without it is unknown.
    uncapped = draft.total if draft.uncapped is None or draft.measured else draft.uncapped
    return Decision(state.mode, draft.total, settings, asked, uncapped, draft.believed, draft.uplinks), memory


def decide_without_link(vehicle: Vehicle, state: State, memory: Memories) -> Decision:
    """What the rules would decide if no operator measured the uplink.

    raises  RuleFailed
    """
    unmeasured = {key: past for key, past in memory.items() if key[0] != follow_link.__name__}
    return decide(vehicle, replace(state, link=None, operator_since=None), unmeasured)[0]


def _draft_problem(state: State, before: Draft, draft: Any) -> str | None:
    """Why the parts of the draft that a rule has changed cannot be used; None if they can."""
    if not isinstance(draft, Draft):
        return "it must return a Draft and the memory"
    if draft is before:
        return None
    if draft.total is not before.total and not _is_bitrate(draft.total):
        return f"total {draft.total!r}: {BITRATE_RULE}"
    for part, fits, expected in PARTS:
        values = getattr(draft, part)
        if values is getattr(before, part):
            continue
        if not isinstance(values, Mapping):
            return f"{part} {values!r}: must be a mapping by camera"
        if values.keys() == state.on.keys() and all(map(fits, values.values())):
            continue
        for name, on in state.on.items():
            if on and not fits(values.get(name)):
                return f"{part} of {name} {values.get(name)!r}: {expected}"
    return None


def _is_bitrate(value: Any) -> bool:
    """A float is rejected even if it is whole: rounding noise must never decide a bitrate on a bound."""
    return type(value) in (Fraction, int) and value.numerator >= 0  # comparing fractions is slow


def _is_rate(value: Any) -> bool:
    return _is_bitrate(value) and value.numerator > 0


def _is_factor(value: Any) -> bool:
    return type(value) is Fraction and 0 < value.numerator <= value.denominator


def _is_shown(value: Any) -> bool:
    return (
        isinstance(value, Shown)
        and _is_factor(value.largest)
        and min(value.roi.width, value.roi.height) >= SMALLEST_SIDE_PX
    )


def _is_picture(value: Any) -> bool:
    return (
        isinstance(value, Picture)
        and min(value.width, value.height, value.roi.width, value.roi.height) >= SMALLEST_SIDE_PX
        and value.width % 2 == value.height % 2 == 0
    )


# Parts of a draft by camera, the check of their values, and its description.
PARTS = (
    ("demand", _is_bitrate, BITRATE_RULE),
    ("bitrate", _is_bitrate, BITRATE_RULE),
    ("scaling", _is_factor, FACTOR_RULE),
    ("shown", _is_shown, SHOWN_RULE),
    ("pictures", _is_picture, PICTURE_RULE),
    ("fps", _is_rate, RATE_RULE),
    ("weights", _is_bitrate, WEIGHT_RULE),
)


@cache
def reads(vehicle: Vehicle, mode: Mode) -> frozenset[str]:
    """Fields of the state whose change triggers a new decision."""
    of_sound = {"copies"} if vehicle.sound else set[str]()
    return frozenset({"mode", "on", "lost", "rois", *of_sound}).union(*(call.reads for call in vehicle.modes[mode]))


@Last
def _settings(
    vehicle: Vehicle, on: Mapping[str, bool], lost: Mapping[str, str], rois: Mapping[str, Roi], draft: Draft
) -> Mapping[str, Setting]:
    rates, intervals = _sent_rates(vehicle, draft.fps), _wave_intervals(vehicle, draft.wave_s)
    return {
        name: _setting(on[name], lost.get(name), rois[name], draft, name, rates.get(name), intervals.get(name))
        for name in vehicle.cameras
    }


@Last
def _weighted(weights: Mapping[str, Fraction], factors: Mapping[str, Fraction]) -> Mapping[str, Fraction]:
    return {name: own * factors.get(name, 1) for name, own in weights.items()}


def _sent_rates(vehicle: Vehicle, wanted: Mapping[str, Fraction]) -> Mapping[str, Fraction]:
    """Hz by camera; empty for a vehicle whose rules set none."""
    if not _varies_rate(vehicle):
        return NOTHING
    encoded = {name: camera for name, camera in vehicle.cameras.items() if not camera.graph.passes}
    return {name: sent_rate(camera, wanted.get(name, camera.fps)) for name, camera in encoded.items()}


def _wave_intervals(vehicle: Vehicle, wanted: Mapping[str, Fraction]) -> Mapping[str, Fraction]:
    """s by camera whose waves are asked for one by one."""
    least = {name: camera.graph.settings.shortest_wave_s for name, camera in vehicle.cameras.items()}
    return {name: wanted.get(name, exact(shortest)) for name, shortest in least.items() if shortest}


@cache
def _varies_rate(vehicle: Vehicle) -> bool:
    return is_given("fps", vehicle.modes)


def _setting(on: bool, lost: str | None, roi: Roi, draft: Draft, name: str, *more: Fraction | None) -> Setting:
    if not on or lost is not None:
        why = f"lost: {lost}" if on else "switched off"
        return Setting(on, False, allocation.ZERO, 0, 0, None, roi, 0, 0, why)
    kbps, factor = whole(draft.bitrate[name]), draft.scaling[name]
    sending = draft.sending and kbps >= 1
    picture = draft.pictures.get(name) or Picture(roi, *scaling.output_size(roi, factor))
    reason = ", ".join(filter(None, (draft.reasons.get(name), draft.placed_words.get(name))))
    if draft.sending and not sending:
        reason += ", below 1 kbit/s: not sending"
    if draft.notes:
        reason = "; ".join((reason, *draft.notes))
    video = (kbps if sending else 0, kbps, factor, *picture)
    return Setting(True, sending, draft.demand[name], *video, reason, draft.placed.get(name, ()), *more)
