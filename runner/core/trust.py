"""How far a limit is trusted, after limits that proved too high. Pure.

A prediction that is too high fills the queue each time it is followed. So it is trusted less for some time, and again
when the vehicle returns to the place where it failed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction
from math import cos, hypot, radians

from runner.core.events import PositionReported

FALL_S = 1.0  # cuts within this time belong to the same drop of the link
EPISODE_S, FEW = 8.0, 3  # a limit is doubted after FEW drops of the link within EPISODE_S ...
LATE_S = 2.5  # ... and at least this long after the first: by then a merely late prediction is right
CONFIRM_S = 0.5  # a limit that follows a drop of the link within this time, as a prediction does, is not doubted
REGAINED = Fraction(3, 100)  # of the limit, regained per second
NEAR_M = 100.0  # a place reaches this far: about as far as the shadow of a building
REMEMBERED_S = 600  # a place is gradually forgotten in this time: load and coverage of a cell change
KNOWN_S = 2.0  # an older position is stale
MOST_PLACES = 50
METRES_PER_DEGREE = 111_195.0  # of latitude


@dataclass(frozen=True, slots=True)
class DoubtedPlace:
    """Where and when (t) a limit proved too high, and the share of limits that was believed then.

    near  whether the last known position of the vehicle was near it
    """

    at: PositionReported
    t: float
    share: Fraction
    near: bool = True

    def share_at(self, t: float) -> Fraction:
        """Share of limits that is believed when the vehicle returns at time t."""
        age = Fraction(min(REMEMBERED_S, int(t - self.t)), REMEMBERED_S)
        return thousandths(self.share + (1 - self.share) * age)


@dataclass(frozen=True, slots=True)
class Trust:
    """Memory between measurements.

    share    share of the limit that is believed
    changed  t of its last change
    doubts   (t, share of the limit that the link carried) at the last cuts
    places   oldest first
    """

    share: Fraction = Fraction(1)
    changed: float = -float("inf")
    doubts: tuple[tuple[float, Fraction], ...] = ()
    places: tuple[DoubtedPlace, ...] = ()


UNDOUBTED = Trust()


def update_trust(trust: Trust, t: float, least: Fraction, position: PositionReported | None) -> Trust:
    """Trust at time t: it falls after doubts and at a place where it fell before, and recovers with time.

    least  minimum share that is believed
    """
    trust = _confirm(trust, t, least, position)
    places, share = trust.places, trust.share
    if position is not None and places and t - position.t <= KNOWN_S:
        seen = [(place, is_near(place.at, position)) for place in places if t - place.t <= REMEMBERED_S]
        places = tuple(replace(place, near=near) for place, near in seen)
        share = min((share, *(place.share_at(t) for place, near in seen if near and not place.near)))
    if share < trust.share:
        return replace(trust, share=share, changed=t, places=places)
    if share < 1 and t - trust.changed >= 1:
        return replace(trust, share=min(Fraction(1), share + REGAINED), changed=t, places=places)
    return trust if places is trust.places else replace(trust, places=places)


def add_doubt(trust: Trust, t: float, carried: Fraction) -> Trust:
    """Trust after a cut.

    carried  share of the limit that the link carried
    """
    doubts = tuple(doubt for doubt in trust.doubts if t - doubt[0] <= EPISODE_S)
    if doubts and t - doubts[-1][0] < FALL_S:
        doubts, carried = doubts[:-1], max(carried, doubts[-1][1])
    return replace(trust, changed=t, doubts=(*doubts, (t, carried)))


def relieve(trust: Trust, t: float, ratio: Fraction) -> Trust:
    """Trust after the limit has fallen to a ratio of what it was at the cut at time t."""
    if not trust.doubts or trust.doubts[-1][0] != t:
        return trust
    carried = min(Fraction(1), thousandths(trust.doubts[-1][1] / ratio))
    return replace(trust, doubts=(*trust.doubts[:-1], (t, carried)))


def _confirm(trust: Trust, t: float, least: Fraction, position: PositionReported | None) -> Trust:
    """Lower the trust some time after a cut, if the limit has been too high for a while and still is."""
    doubts = trust.doubts
    if len(doubts) < FEW or doubts[-1][0] - doubts[0][0] < LATE_S or trust.changed != doubts[-1][0]:
        return trust
    # Use the mildest of these drops: a limit that is only late is far off at first, and almost right soon after.
    share = max(least, *(part for _, part in doubts))
    if not CONFIRM_S <= t - doubts[-1][0] <= EPISODE_S or share >= trust.share:
        return trust
    places = trust.places
    if position is not None and t - position.t <= KNOWN_S:
        places = _add_place(places, DoubtedPlace(position, t, share))
    return replace(trust, share=share, changed=t, places=places)


def _add_place(places: tuple[DoubtedPlace, ...], new: DoubtedPlace) -> tuple[DoubtedPlace, ...]:
    """Add a place, or update the share of known ones nearby, which stay where the drop began."""
    close = [place for place in places if is_near(place.at, new.at, NEAR_M / 2)]
    others = [place for place in places if place not in close]
    return (*others, *(replace(new, at=place.at) for place in close or [new]))[-MOST_PLACES:]


def is_near(a: PositionReported, b: PositionReported, metres: float = NEAR_M) -> bool:
    """Whether two positions are at most `metres` apart, neglecting curvature."""
    north = abs(a.lat - b.lat) * METRES_PER_DEGREE
    if north > metres:
        return False
    degrees = (a.lon - b.lon + 180) % 360 - 180
    return hypot(north, degrees * METRES_PER_DEGREE * cos(radians(a.lat))) <= metres


def thousandths(share: Fraction) -> Fraction:
    """Round down to thousandths: fractions from many multiplications would grow long."""
    return Fraction(share.numerator * 1000 // share.denominator, 1000)
