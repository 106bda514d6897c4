"""Calmer pictures: modes=steady, and modes=safe while the link is measured."""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction

from runner.core.decision import Draft
from runner.core.model import Vehicle, least_float, plain
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
