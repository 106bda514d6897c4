"""What the rules decide: one `Setting` per camera, and the `Draft` that a mode's rules fill in order."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from types import MappingProxyType
from typing import Any, NamedTuple

from runner.core.limits import Count, NonNegative, Share
from runner.core.model import Kbps, Mode, Roi

NOTHING: Mapping[str, Any] = MappingProxyType({})


@dataclass(frozen=True, slots=True)
class Setting:
    """How to send one camera.

    sending        False: nothing is encoded (off, or allocated below 1 kbit/s), the stream stays connectable
    demand         kbit/s, Eq. (1), 0 when off
    kbps           whole kbit/s, rounded down; 0 while nothing is sent
    given          the same, but kept while a rule stops all sending: the value with which the camera resumes
    scaling        selected factor; None when off, or when its source cannot be opened
    width, height  px of the encoded picture, 0 when off
    uplinks        that carry it, its own first, if the vehicle's have names and a rule places cameras on them
    wave_s         between two refresh waves; None: none is asked for
    fps            Hz at which pictures are sent, see `sent_rate`; None: no rule of the vehicle sets rates
    reason         for the operator; ignored in comparisons
    """

    on: bool
    sending: bool
    demand: Kbps
    kbps: int
    given: int
    scaling: Fraction | None
    roi: Roi
    width: int
    height: int
    reason: str = field(compare=False)
    uplinks: tuple[str, ...] = ()
    fps: Fraction | None = None
    wave_s: Fraction | None = None


@dataclass(frozen=True, slots=True)
class Believed:
    """What is believed of the uplink, and what predictions of it have proved to be worth; see `runner.core.belief`.

    kbps          capacity, kbit/s of video, as predictions are
    deviation     standard deviation of ln(kbps): how sure the belief is
    margin        by how much less is sent, as a difference of logarithms
    bias, error   mean of ln(capacity / prediction) of the last seconds, and the deviation from it; None: not known yet
    gain          share of a prediction's change that comes true, 0 to 1; None: it has not changed enough to know
    policer_kbps  rate above which the link drops packets, kbit/s of video; None: none was found
    """

    kbps: Count
    deviation: NonNegative
    margin: NonNegative
    bias: float | None
    error: NonNegative | None
    gain: Share | None
    policer_kbps: Count | None


@dataclass(frozen=True, slots=True)
class UplinkShare:
    """What one of several uplinks is to carry.

    total     kbit/s of all cameras and copies on it
    stalled   whether nothing arrives over it
    believed  as in `Decision`
    reason    what limits the total, for the operator; "": nothing
    """

    total: Kbps
    stalled: bool = False
    believed: Believed | None = None
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Decision:
    """What is in force: the mode, its total before the cap at demand, and a setting for each camera.

    asked     kbit/s of the prediction or the operator, before later rules lowered it; ignored in comparisons
    uncapped  kbit/s, the total without the limit of the measured link; ignored in comparisons
    believed  of the uplink; None: no rule believes anything, or no operator measures it; ignored in comparisons
    uplinks   of those that have names; empty: no rule shares the total among them; ignored in comparisons
    """

    mode: Mode
    total: Kbps
    settings: Mapping[str, Setting]
    asked: Kbps = field(default=Fraction(0), compare=False)
    uncapped: Kbps = field(default=Fraction(0), compare=False)
    believed: Believed | None = field(default=None, compare=False)
    uplinks: Mapping[str, UplinkShare] = field(default_factory=lambda: NOTHING, compare=False)

    def equals_with_reasons(self, other: Decision) -> bool:
        """Whether it is equal and for the same reasons."""
        is_same = self == other and (self.believed, self.uplinks) == (other.believed, other.uplinks)
        return is_same and all(s.reason == other.settings[name].reason for name, s in self.settings.items())


class Shown(NamedTuple):
    """What to send of a camera, by what its operator sees.

    roi      region of the full image
    scale    px of the screen for each px of the full image, at most 1
    largest  scaling factor above which no more is seen
    area     px of screens that show it
    """

    roi: Roi
    scale: Fraction
    largest: Fraction
    area: int


class Picture(NamedTuple):
    """The pictures that a camera's encoder gets: a region of the full image, and the size to which it is scaled, px."""

    roi: Roi
    width: int
    height: int

    @property
    def size(self) -> tuple[int, int]:
        return self.width, self.height


class Draft(NamedTuple):
    """A decision in progress. A rule reads what earlier ones gave and returns a draft with its own part replaced.

    shown      by camera that is on, what its operator sees; empty: everything
    fps        Hz by camera, at most this is sent; empty: every picture
    wave_s     by camera whose waves are asked for, time between two; empty: the shortest
    weights    by camera, what the operator's weight is multiplied by; empty: 1
    total      kbit/s of all cameras
    demand     kbit/s by camera, 0 when off
    bitrate    exact kbit/s by camera
    scaling    factor by camera that is on
    measured   True: the total is the measured capacity of the link, without a prediction or another limit
    uncapped   kbit/s, the total without the measured link, or the total if that is more; None: the link changed nothing
    sized_for  total for which picture sizes are chosen, kbit/s; None: the actual total
    sending    False stops all cameras, whatever their bitrate
    believed   of the uplink; None: nothing
    uplinks    what each uplink that has a name is to carry; their sum is the total
    placed     by camera that is on, the uplinks that carry it, its own first; empty: all go over the first uplink
    placed_words  the same with the reason, for the operator
    notes      reasons that concern all cameras
    reasons    reason by camera
    pictures   by camera that is on, what is encoded; empty: the regions in force, scaled by the factors
    """

    total: Kbps | None = None
    demand: Mapping[str, Kbps] = NOTHING
    bitrate: Mapping[str, Kbps] = NOTHING
    scaling: Mapping[str, Fraction] = NOTHING
    measured: bool = False
    uncapped: Kbps | None = None
    sized_for: Kbps | None = None
    sending: bool = True
    believed: Believed | None = None
    uplinks: Mapping[str, UplinkShare] = NOTHING
    placed: Mapping[str, tuple[str, ...]] = NOTHING
    placed_words: Mapping[str, str] = NOTHING
    notes: tuple[str, ...] = ()
    reasons: Mapping[str, str] = NOTHING
    shown: Mapping[str, Shown] = NOTHING
    pictures: Mapping[str, Picture] = NOTHING
    fps: Mapping[str, Fraction] = NOTHING
    weights: Mapping[str, Fraction] = NOTHING
    wave_s: Mapping[str, Fraction] = NOTHING

    def replaced(self, **changes: Any) -> Draft:
        """The draft with these parts replaced."""
        return self._replace(**changes)

    def noted(self, note: str, **changes: Any) -> Draft:
        """The draft with these parts replaced and the reason added."""
        return self._replace(notes=(*self.notes, note), **changes)

    def limited(self, total: Kbps, why: str) -> Draft:
        """The draft with another total, in tenths of a kbit/s, and the reason; unchanged if it is the same."""
        assert self.total is not None
        total = Fraction(int(10 * total), 10)
        if total == self.total:
            return self
        return self.noted(f"total {short(self.total)} -> {short(total)}: {why}", total=total)


def short(bitrate: Kbps) -> int | str:
    return bitrate.numerator if bitrate.denominator == 1 else f"{float(bitrate):.1f}"
