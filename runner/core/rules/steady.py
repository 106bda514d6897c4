"""Calmer pictures: modes=steady, and modes=safe while the link is measured."""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction
from typing import NamedTuple

from runner.core import scaling
from runner.core.decision import Draft
from runner.core.model import Roi, Vehicle, least_float, plain
from runner.core.rules.paper import lasting_share
from runner.core.rules.registry import Memory, Step, rule
from runner.core.state import State


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
        view = (roi, shown and shown.scale)
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
    view: tuple[Roi, Fraction | None]

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
