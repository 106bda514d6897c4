"""Calmer pictures: modes=steady, modes=safe while the link is measured, and modes=seen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from math import cos, inf, radians
from typing import NamedTuple

from runner.core import scaling
from runner.core.decision import NOTHING, Draft, Picture
from runner.core.model import Camera, Roi, Vehicle, least_float, plain
from runner.core.rules.paper import lasting_share
from runner.core.rules.registry import Memory, Step, rule
from runner.core.state import State
from runner.core.view import Seen

NEAR = Fraction(9, 8)  # sides that differ by less look the same


@rule(needs=["scaling"], gives=["scaling"], reads=["t"])
def hold_upscaling(vehicle: Vehicle, state: State, draft: Draft, memory: Memory, *, for_s: Fraction) -> Step:
    """A larger factor is applied only after it has been requested continuously for `for_s`; a smaller one immediately.

    Memory: by camera, the factor in force and since when a larger one has been requested (None: it is not).
    """
    draft, held = _hold_back(state, draft, memory.get("held", {}), for_s)
    return draft, {"held": held}


@rule(needs=["scaling"], gives=["scaling"], reads=["t"], uses=["uncapped"])
def hold_while_capped(vehicle: Vehicle, state: State, draft: Draft, memory: Memory, *, for_s: Fraction) -> Step:
    """As `hold_upscaling`, while the measured link sets the total: its rate is being probed, and new sizes cost bits.

    Memory: as there; empty while it does not.
    """
    past: Mapping[str, _Hold] = memory.get("held", {})
    if draft.uncapped is None:
        return draft, {} if past else memory
    draft, held = _hold_back(state, draft, past, for_s)
    return draft, {"held": held}


@rule(needs=["bitrate", "scaling"], gives=["scaling"], reads=["rois", "t"], uses=["shown", "sized_for"])
def calm_scaling(
    vehicle: Vehicle, state: State, draft: Draft, memory: Memory, *, margin: Fraction, for_s: Fraction
) -> Step:
    """A factor stays while the bitrate is in its range of Eq. (4) or near it: at the bounds, neighbours look the same.

    It is left downwards at once, upwards after the bitrate has been that high for `for_s`. A view that changes it takes
    effect at once.

    margin  by which a bitrate must leave the range, as a share of it
    Memory: by camera, the factor in force, since when a larger one has been requested, and the view.
    """
    past: Mapping[str, _Calm] = memory.get("calm", {})
    lasting, enough_s = lasting_share(draft) or 1, least_float(for_s)
    now: dict[str, _Calm] = {}
    for name, requested in draft.scaling.items():
        camera, roi, shown = vehicle.cameras[name], state.rois[name], draft.shown.get(name)
        view = (roi.width, roi.height, shown and shown.scale)
        before = past.get(name)
        if before is None or before.view != view or before.factor == requested:
            now[name] = _Calm(requested, None, view)
            continue
        model = camera.rate_quality.at(shown.scale)[1] if shown else camera.rate_quality
        of_full = scaling.as_full_image(draft.bitrate[name] * lasting, roi, camera.full_roi)
        lower, upper = (scaling.select_scaling(model, of_full * (1 + by))[0] for by in (-margin, margin))
        now[name] = before.followed(requested, lower, upper, state.t, enough_s)
    held = {name: its.factor for name, its in now.items() if its.factor != draft.scaling[name]}
    reasons = {name: f"{draft.reasons[name]}, kept at {plain(factor)}" for name, factor in held.items()}
    if held:
        draft = draft.replaced(scaling={**draft.scaling, **held}, reasons={**draft.reasons, **reasons})
    return draft, memory if now == past else {"calm": now}


class _Calm(NamedTuple):
    """A factor in force, since when a larger one has been requested (None: it is not), and what it is seen for."""

    factor: Fraction
    since: float | None
    view: tuple[int, int, Fraction | None]

    def followed(self, requested: Fraction, lower: Fraction, upper: Fraction, t: float, enough_s: float) -> _Calm:
        """lower, upper: the factors of somewhat lower and higher bitrates."""
        if upper < self.factor:
            return self._replace(factor=requested, since=None)
        if lower <= self.factor:
            return self._replace(since=None)
        since = t if self.since is None else self.since
        if t - since < enough_s:
            return self._replace(since=since)
        return self._replace(factor=requested, since=None)


class _Wanted(NamedTuple):
    """What a picture is decided for: a region, a factor, and what is seen of the region, which may move inside."""

    roi: Roi
    factor: Fraction
    seen: Seen | None

    @property
    def best(self) -> Picture:
        return Picture(self.roi, *scaling.output_size(self.roi, self.factor))


class _Now(NamedTuple):
    """A picture in force, and what it was last decided for, since a time."""

    picture: Picture
    wanted: _Wanted
    since: float


@dataclass(frozen=True, slots=True)
class _Pictures:
    """By camera, its picture; and when new sizes last had their turn."""

    cameras: Mapping[str, _Now]
    turn: float = -inf


@rule(needs=["scaling"], gives=["pictures"], reads=["rois", "t", "view"], uses=["shown"])
def calm_pictures(
    vehicle: Vehicle,
    state: State,
    draft: Draft,
    memory: Memory,
    *,
    within: Fraction = Fraction(2),
    for_s: Fraction = Fraction(5),
    at_once: Fraction = Fraction(2),
    turn_s: Fraction = Fraction(3, 50),
) -> Step:
    """A region moves and zooms behind its encoded size; cameras that need another one get it in turn.

    A new size restarts the encoder: it begins with a key picture, and looks worse for a second. So the size stays as
    long as it suits the region to within a factor, and no longer than the region is unchanged for a while. Key pictures
    of many cameras together would fill the link: first come the front camera and the one that fills most of the screen.
    Until its turn, a camera is sent as before.

    within   how much larger or smaller a side may be than by the camera's factor, and than its aspect ratio
    for_s    after which an unchanged region gets the size by its factor
    at_once  cameras whose sizes change together
    turn_s   from one turn to the next
    Memory: by camera, its picture, what it is for, and since when; and the time of the last turn.
    """
    past: _Pictures = memory.get("pictures", _Pictures(NOTHING))
    still = state.t - least_float(for_s)
    now: dict[str, _Now] = {}
    waiting: dict[str, _Now] = {}
    for name, factor in draft.scaling.items():
        before, wanted = past.cameras.get(name), _Wanted(state.rois[name], factor, state.view.get(name))
        following = _following(vehicle.cameras[name], before, wanted, state.t, still, within)
        if before is None or before.picture.size == following.picture.size:
            now[name] = following
        else:
            now[name], waiting[name] = before, following
    turn = past.turn
    if waiting and state.t - turn >= least_float(turn_s):
        turn = state.t
        for name in _by_rank(vehicle, draft, waiting)[: max(1, int(at_once))]:
            now[name] = waiting.pop(name)
    draft = _with(draft, now, waiting)
    return draft, memory if now == past.cameras and turn == past.turn else {"pictures": _Pictures(now, turn)}


def _following(camera: Camera, before: _Now | None, wanted: _Wanted, t: float, still: float, within: Fraction) -> _Now:
    """What a camera should send next; a new size may have to wait."""
    if before and before.wanted == wanted:
        if before.since > still:
            return before
        return before if _suits(before.picture, wanted.best, NEAR) else before._replace(picture=wanted.best)
    if before and before.wanted.roi == wanted.roi and before.wanted.factor == wanted.factor:
        return _Now(before.picture, wanted, t)
    if before and before.wanted.roi != wanted.roi and camera.graph.places:
        moved = before.picture._replace(roi=wanted.roi)
        if moved.width <= moved.roi.width and moved.height <= moved.roi.height and _suits(moved, wanted.best, within):
            return _Now(moved, wanted, t)
    return _Now(wanted.best, wanted, t)


def _suits(picture: Picture, best: Picture, within: Fraction) -> bool:
    """Whether both sides, and the aspect ratio, are those of another picture to within a factor."""
    across, down = Fraction(picture.width, best.width), Fraction(picture.height, best.height)
    return all(within * ratio >= 1 and ratio <= within for ratio in (across, down, across / down))


def _by_rank(vehicle: Vehicle, draft: Draft, names: Mapping[str, _Now]) -> list[str]:
    """The front camera and the largest picture on the screen first, the others by their size there."""

    def area(name: str) -> int:
        return draft.shown[name].area if name in draft.shown else 0

    first = {max(vehicle.cameras.values(), key=_ahead).name, max(draft.scaling, key=area)}
    return sorted(names, key=lambda name: (name not in first, -area(name)))


def _ahead(camera: Camera) -> float:
    """How far a camera looks straight ahead, 1 to -1; -1 if its pose is unknown."""
    return cos(radians(camera.pose.yaw_deg)) * cos(radians(camera.pose.pitch_deg)) if camera.pose else -1.0


def _with(draft: Draft, now: Mapping[str, _Now], waiting: Mapping[str, _Now]) -> Draft:
    reasons = dict(draft.reasons)
    for name, own in now.items():
        if name in waiting:
            reasons[name] = f"{reasons.get(name, '')}, a new size waits for its turn"
        elif own.picture != own.wanted.best:
            reasons[name] = f"{reasons.get(name, '')}, size kept at {own.picture.width}x{own.picture.height}"
    return draft.replaced(pictures={name: own.picture for name, own in now.items()}, reasons=reasons)


_Hold = tuple[Fraction, float | None]


def _hold_back(
    state: State, draft: Draft, past: Mapping[str, _Hold], for_s: Fraction
) -> tuple[Draft, Mapping[str, _Hold]]:
    now: dict[str, _Hold] = {}
    enough_s = least_float(for_s)
    factors: dict[str, Fraction] = {}  # of the cameras whose larger factor is held back
    for name, requested in draft.scaling.items():
        held, since = past.get(name, (requested, None))
        if requested is held or _is_at_most(requested, held):
            now[name] = (requested, None)
            continue
        since = state.t if since is None else since
        if state.t - since >= enough_s:
            now[name] = (requested, None)
        else:
            now[name] = (held, since)
            factors[name] = held
    if not factors:
        return draft, now
    until = f"until it has been so for {plain(for_s)} s"
    reasons = {name: f"{draft.reasons[name]}, held at {plain(held)} {until}" for name, held in factors.items()}
    return draft.replaced(scaling={**draft.scaling, **factors}, reasons={**draft.reasons, **reasons}), now


def _is_at_most(factor: Fraction, bound: Fraction) -> bool:
    """As `factor <= bound`, which is slower."""
    return factor.numerator * bound.denominator <= bound.numerator * factor.denominator
