"""Several uplinks: which of them carries which camera."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from math import inf

from runner.core.allocation import ZERO
from runner.core.decision import Draft
from runner.core.model import Vehicle, exact
from runner.core.placement import Carries, Placement, Wanted, in_words, place
from runner.core.rules.registry import Memory, Step, rule
from runner.core.state import State


@rule(
    needs=["total", "uplinks", "demand"],
    gives=["placed", "total", "uplinks", "sized_for"],
    reads=["on", "t", "weights"],
    uses=["weights"],
)
def spread_over_uplinks(
    vehicle: Vehicle, state: State, draft: Draft, memory: Memory, *, clear_s: Fraction = Fraction(5)
) -> Step:
    """Cameras are spread over the uplinks by what these carry; see `runner.core.placement`.

    Those with `redundant` are on every uplink. An uplink that stalls loses its other cameras at once; they return once
    it has been clear for `clear_s`. With a single uplink, this rule does nothing. What they move to carries little more
    than before at first.

    Memory: `Placement`.
    """
    if not draft.uplinks:
        return draft, memory
    cameras = {
        name: Wanted(float(kbps), float(state.weights[name]), vehicle.cameras[name].redundant)
        for name, kbps in (draft.bitrate or draft.demand).items()
        if kbps
    }
    uplinks = {name: Carries(float(share.total), share.stalled) for name, share in draft.uplinks.items()}
    placement = place(memory.get("placement", Placement()), cameras, uplinks, state.t, float(clear_s))
    totals = {
        name: replace(share, total=min(share.total, exact(round(most, 1))))
        for name, share in draft.uplinks.items()
        if (most := placement.most(name, state.t)) < inf
    }
    if totals:
        shares = {**draft.uplinks, **totals}
        total = sum((each.total for each in shares.values()), ZERO)
        draft = draft.replaced(uplinks=shares, total=total, sized_for=draft.sized_for or draft.total)
    words = {name: in_words(on, placement.why.get(name)) for name, on in placement.uplinks.items()}
    return draft.replaced(placed=placement.uplinks, placed_words=words), {"placement": placement}
