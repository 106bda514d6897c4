"""How much of a limit is believed, after limits that proved too high. Pure.

A prediction that is too high fills the queue again each time it is followed. So less of it is believed in the time that
follows, and at the place where it happened when the vehicle comes there again.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction
from math import cos, hypot, radians

from runner.core.events import PositionReported

FALL_S = 1.0  # cuts within this time answer the same fall of the link
EPISODE_S, FEW = 8.0, 3  # a limit is doubted after this many falls within this time ...
LATE_S = 2.5  # ... and at least this long after the first: a prediction that is only late is right by then
REGAINED = Fraction(3, 100)  # share of the limit that is believed again in each second
NEAR_M = 100.0  # a place reaches this far: about as far as the shadow of a building
REMEMBERED_S = 600.0  # a place is forgotten after this time: load and coverage of a cell change
MOST_PLACES = 50
METRES_PER_DEGREE = 111_195.0  # of latitude


@dataclass(frozen=True, slots=True)
class DoubtedPlace:
    """Where a limit proved too high, when (t), and the share of limits that is believed there."""

    at: PositionReported
    t: float
    share: Fraction


@dataclass(frozen=True, slots=True)
class Trust:
    """Memory between measurements.

    share    share of the limit that is believed
    changed  t of its last change
    doubts   (t, share of the limit that the link carried) of the last cuts
    places   oldest first
    """

    share: Fraction = Fraction(1)
    changed: float = -float("inf")
    doubts: tuple[tuple[float, Fraction], ...] = ()
    places: tuple[DoubtedPlace, ...] = ()


UNDOUBTED = Trust()


def regained(trust: Trust, t: float, position: PositionReported | None) -> Trust:
    """Trust at time t: it returns while nothing speaks against the limit, and falls where it had fallen before.

    While the vehicle is near such a place, the place's share returns with it.
    """
    share, changed = trust.share, trust.changed
    if share < 1 and t - changed >= 1:
        share, changed = min(Fraction(1), share + REGAINED), t
    if position is None or not trust.places:
        return trust if share is trust.share else replace(trust, share=share, changed=changed)
    places = tuple(place for place in trust.places if t - place.t <= REMEMBERED_S)
    near = [place for place in places if is_near(place.at, position)]
    lowest = min((place.share for place in near), default=share)
    if share is trust.share and lowest < share:
        share, changed = lowest, t
    places = tuple(replace(place, share=max(place.share, share)) if place in near else place for place in places)
    return replace(trust, share=share, changed=changed, places=tuple(p for p in places if p.share < 1))


def doubted(trust: Trust, t: float, carried: Fraction, least: Fraction, position: PositionReported | None) -> Trust:
    """Trust after a cut: less, if the limit has been too high for some time.

    carried  share of the limit that the link carried
    least    share that is believed at least
    """
    doubts = tuple(doubt for doubt in trust.doubts if t - doubt[0] <= EPISODE_S)
    if doubts and t - doubts[-1][0] < FALL_S:
        doubts, carried = doubts[:-1], max(carried, doubts[-1][1])
    doubts, share = (*doubts, (t, carried)), trust.share
    if len(doubts) >= FEW and t - doubts[0][0] >= LATE_S:
        # By the mildest: a limit that is only late is far off at first, and almost right soon after.
        share = max(least, min(share, max(part for _, part in doubts)))
    places = trust.places
    if position is not None and share < trust.share:
        places = _with(places, DoubtedPlace(position, t, share))
    return Trust(share, t, doubts, places)


def _with(places: tuple[DoubtedPlace, ...], new: DoubtedPlace) -> tuple[DoubtedPlace, ...]:
    """Places with a new one, or with its share where known ones are close: they stay where the fall began."""
    close = [place for place in places if is_near(place.at, new.at, NEAR_M / 2)]
    if not close:
        return (*places, new)[-MOST_PLACES:]
    return tuple(replace(new, at=place.at) if place in close else place for place in places)


def is_near(a: PositionReported, b: PositionReported, metres: float = NEAR_M) -> bool:
    """Whether two positions are that close, on a sphere that is flat between them."""
    north = abs(a.lat - b.lat) * METRES_PER_DEGREE
    if north > metres:
        return False
    degrees = (a.lon - b.lon + 180) % 360 - 180
    return hypot(north, degrees * METRES_PER_DEGREE * cos(radians(a.lat))) <= metres
