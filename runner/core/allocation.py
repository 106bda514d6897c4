"""Bitrate demand and allocation (paper, section II-A). Exact: float noise never decides a bitrate on a bound."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from fractions import Fraction
from math import lcm

from runner.core.model import Kbps, Roi

ZERO = Fraction(0)
RETURN = Fraction(11, 10)  # hysteresis on the floors, so that a varying total does not switch a camera on and off


def demand(b_full: Kbps, roi: Roi, full: Roi) -> Kbps:
    """Bitrate that a camera asks for, in proportion to the pixels of its region of interest.

        b_dem = p_set / p_full * b_full                                  (paper, Eq. 1)

    b_full   kbit/s for the full image
    roi      px, what the operator has set
    full     px, the full image
    returns  kbit/s; not to be called for a camera that is off, whose p_set is 0
    """
    return Fraction(roi.pixels * b_full, full.pixels) if roi is not full and roi != full else b_full


def allocate(demands: Mapping[str, Kbps], total: Kbps, weights: Mapping[str, Fraction]) -> dict[str, Kbps]:
    """Share the total bitrate among the cameras in proportion to their demand.

        b_alloc,i = b_dem,i / sum_j(b_dem,j) * b_pred                    (paper, Eq. 2)

    and, with the explicit weights that the paper leaves to the reader,

        b_alloc,i = min(b_dem,i, lambda * w_i * b_dem,i),   sum_i b_alloc,i = min(b_pred, sum_{w_i > 0} b_dem,i)

    demands  kbit/s per camera, 0 for a camera that is off
    total    kbit/s, predicted by pQoS or set by the operator
    weights  >= 0 per camera; all 1: as in the paper; 0: no bitrate
    returns  kbit/s per camera, in the order of `demands`

    The paper leaves two cases open. All cameras off: each gets 0. More than demanded: the surplus stays unused.
    """
    open_demands = {name: own for name, own in demands.items() if own and weights[name]}
    demanded = _sum(open_demands.values())
    if total >= demanded:
        return {name: open_demands.get(name, ZERO) for name in demands}
    allocated = dict.fromkeys(demands, ZERO)
    if _all_equal([weights[name] for name in open_demands]):
        # As total / demanded * own, with one reduction instead of several.
        p, q = total.numerator * demanded.denominator, total.denominator * demanded.numerator
        shares = {name: Fraction(own.numerator * p, own.denominator * q) for name, own in open_demands.items()}
        return allocated | shares
    left = total
    # Heaviest first: once lambda does not fill a camera, it fills no lighter one, and the rest share the remainder.
    for name in sorted(open_demands, key=weights.__getitem__, reverse=True):
        share = left / sum(weights[other] * own for other, own in open_demands.items())
        if share * weights[name] < 1:
            return allocated | {other: own * share * weights[other] for other, own in open_demands.items()}
        allocated[name] = open_demands.pop(name)
        left -= allocated[name]
    return allocated


def allocate_above_floors(
    demands: Mapping[str, Kbps], total: Kbps, weights: Mapping[str, Fraction], floors: Mapping[str, Kbps]
) -> dict[str, Kbps]:
    """Eq. (2) with a lower bound for each camera.

        b_alloc,i = max(f_i, b_i),   sum_i b_alloc,i = min(b_pred, sum_i b_dem,i)

    where b_i is the share by `allocate` of what the floors of the others leave. If the total is less than all floors
    together, it is shared in proportion to them.

    demands  kbit/s per camera, 0 for a camera that is off
    floors   kbit/s per camera, 0 or missing: none; a floor above the demand counts as the demand
    returns  kbit/s per camera; without floors the same as `allocate`
    """
    lowest = {name: min(floor, demands[name]) for name, floor in floors.items() if floor and demands.get(name)}
    if not lowest:
        return allocate(demands, total, weights)
    if total <= _sum(lowest.values()):
        return dict.fromkeys(demands, ZERO) | allocate(lowest, total, dict.fromkeys(lowest, Fraction(1)))
    at_floor: dict[str, Kbps] = {}
    while True:
        others = {name: own for name, own in demands.items() if name not in at_floor}
        shares = allocate(others, total - _sum(at_floor.values()), weights)
        below = {name: floor for name, floor in lowest.items() if name not in at_floor and shares[name] < floor}
        if not below:
            return {name: at_floor[name] if name in at_floor else shares[name] for name in demands}
        at_floor |= below


def shed(
    demands: Mapping[str, Kbps],
    total: Kbps,
    floors: Mapping[str, Kbps],
    order: Sequence[str],
    before: Iterable[str] = (),
) -> tuple[str, ...]:
    """Cameras to give up, in order, until the total covers the floors of all others.

    order    cameras that may be given up, in this order
    before   those given up so far; each returns only once the total exceeds the floors by a margin
    returns  the first part of `order`, without cameras that are off
    """
    given_up: list[str] = []
    lowest = {name: min(floors.get(name, ZERO), own) for name, own in demands.items()}
    for name in (name for name in order if demands[name]):
        needed = _sum(floor for other, floor in lowest.items() if other not in given_up)
        if total >= needed * (RETURN if name in before else 1):
            break
        given_up.append(name)
    return tuple(given_up)


def _sum(bitrates: Iterable[Kbps]) -> Kbps:
    """Sum over a common denominator: bitrates are mostly whole, and adding fractions one by one is slow."""
    terms = list(bitrates)
    denominator = lcm(*(term.denominator for term in terms))
    return Fraction(sum(term.numerator * (denominator // term.denominator) for term in terms), denominator)


def _all_equal(weights: Sequence[Fraction]) -> bool:
    return all(weight is weights[0] or weight == weights[0] for weight in weights)
