"""Weights and frame rates by what the vehicle does: it stands, creeps, reverses, drives fast; modes=motion."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from fractions import Fraction
from functools import cache
from typing import NamedTuple

from runner.core.decision import Draft
from runner.core.driving import KNOWN_S
from runner.core.events import Gear
from runner.core.model import Camera, Vehicle, least_float, plain
from runner.core.rules.registry import Memory, Step, rule
from runner.core.state import State

FRONT, SIDE, REAR = "front", "side", "rear"
FRONT_DEG, REAR_DEG = 60, 120  # of yaw to either side, up to which and from which on
ANY_MPS, ANY_HZ = Fraction(1000), Fraction(1000)  # more than there is
MARGIN = 0.2  # by which a speed must leave the range in force, as a share of its bounds
STEPS = 8  # in which weights blend: each is a new bitrate for all cameras


class Gears(StrEnum):
    """Gears in which a rule applies. An unknown gear counts as forwards."""

    ANY = "any"
    FORWARDS = "forwards"
    REVERSE = "reverse"


class _Applied(NamedTuple):
    """Whether the situation is in force, and since when it is met without being so; how far weights had blended."""

    is_on: bool = False
    met_since: float | None = None
    degree: float = 0.0
    at: float = 0.0  # of the degree, s

    def blended(self, t: float, blend_s: float) -> float:
        """How far weights have blended: 0 to 1."""
        moved = (t - self.at) / blend_s if blend_s else 1.0
        return min(1.0, self.degree + moved) if self.is_on else max(0.0, self.degree - moved)

    def followed(self, is_met: bool, t: float, for_s: float, blend_s: float) -> _Applied:
        if is_met == self.is_on:
            return self._replace(met_since=None)
        since = t if self.met_since is None else self.met_since
        if is_met and t - since < for_s:
            return self._replace(met_since=since)
        return _Applied(is_met, None, self.blended(t, blend_s), t)


@rule(gives=["fps", "weights"], reads=["motion", "steering", "t"])
def by_motion(
    vehicle: Vehicle,
    state: State,
    draft: Draft,
    memory: Memory,
    *,
    least_mps: Fraction = Fraction(0),
    most_mps: Fraction = ANY_MPS,
    gear: Gears = Gears.ANY,
    for_s: Fraction = Fraction(1),
    blend_s: Fraction = Fraction(2),
    front_weight: Fraction = Fraction(1),
    side_weight: Fraction = Fraction(1),
    rear_weight: Fraction = Fraction(1),
    front_fps: Fraction = ANY_HZ,
    side_fps: Fraction = ANY_HZ,
    rear_fps: Fraction = ANY_HZ,
) -> Step:
    """While speed and gear are as stated, cameras have other weights, and send at most so many pictures a second.

    A camera's direction is that of its `pose`; one without pose is left alone. The operator's weight is multiplied.
    Once the situation has lasted for `for_s` it is in force: rates change at once, weights within `blend_s`. It ends as
    soon as it is left, by a margin. While a speed is unknown, no situation with a speed is met.

    least_mps, most_mps  range of the speed
    Memory: `_Applied`.
    """
    past: _Applied = memory.get("applied", _Applied())
    is_met = _is_in(state, gear) and _is_within(state, past.is_on, least_mps, most_mps)
    within_s = least_float(blend_s)
    now = past.followed(is_met, state.t, least_float(for_s), within_s)
    memory = memory if now == past else {"applied": now}
    degree = Fraction(round(STEPS * now.blended(state.t, within_s)), STEPS)
    weights = {FRONT: front_weight, SIDE: side_weight, REAR: rear_weight}
    blended = {side: 1 + degree * (weight - 1) for side, weight in weights.items()}
    rates = {FRONT: front_fps, SIDE: side_fps, REAR: rear_fps} if now.is_on else dict.fromkeys(weights, ANY_HZ)
    sides = _sides(vehicle)
    draft = draft.replaced(
        weights={name: draft.weights.get(name, 1) * blended.get(side, 1) for name, side in sides.items()},
        fps={name: min(draft.fps.get(name, ANY_HZ), rates.get(side, ANY_HZ)) for name, side in sides.items()},
    )
    changed = [_words(side, blended[side], rates[side]) for side in weights if side in sides.values()]
    words = ", ".join(filter(None, changed))
    return draft.noted(f"{_situation(least_mps, most_mps, gear)}: {words}") if words else draft, memory


def _is_in(state: State, gear: Gears) -> bool:
    if gear is Gears.ANY:
        return True
    stated = state.steering
    reverses = stated is not None and stated.gear is Gear.REVERSE and state.t - stated.t < KNOWN_S
    return reverses is (gear is Gears.REVERSE)


def _is_within(state: State, is_on: bool, least: Fraction, most: Fraction) -> bool:
    if least == 0 and most == ANY_MPS:
        return True
    margin = MARGIN if is_on else 0.0
    speed = state.motion.speed_mps
    return state.motion.is_known(state.t) and least * (1 - margin) <= speed <= most * (1 + margin)


@cache
def _sides(vehicle: Vehicle) -> Mapping[str, str]:
    """By camera, where it looks; empty: unknown."""
    return {name: _side(camera) for name, camera in vehicle.cameras.items()}


def _side(camera: Camera) -> str:
    if camera.pose is None:
        return ""
    aside = abs((camera.pose.yaw_deg + 180) % 360 - 180)
    return FRONT if aside <= FRONT_DEG else REAR if aside >= REAR_DEG else SIDE


def _situation(least: Fraction, most: Fraction, gear: Gears) -> str:
    speeds = {
        (False, False): "",
        (False, True): f"{plain(most)} m/s or less",
        (True, False): f"{plain(least)} m/s or more",
        (True, True): f"{plain(least)} to {plain(most)} m/s",
    }
    gears = {Gears.ANY: "", Gears.FORWARDS: "forwards", Gears.REVERSE: "in reverse"}
    parts = (gears[gear], speeds[least > 0, most < ANY_MPS])
    return " at ".join(filter(None, parts)) or "always"


def _words(side: str, weight: Fraction, fps: Fraction) -> str:
    parts = [f"weight times {float(weight):.3g}"] if weight != 1 else []
    parts += [f"{float(fps):g} Hz"] if fps < ANY_HZ else []
    return f"{side} {' at '.join(parts)}" if parts else ""
