"""Send what is seen: regions, sizes and bitrates by what the operator in control looks at; modes=seen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from functools import reduce
from math import ceil, inf
from typing import NamedTuple

from runner.core import allocation
from runner.core.decision import NOTHING, Draft, Shown
from runner.core.events import Attention
from runner.core.hull import Contender, Curve, best_shares
from runner.core.model import SMALLEST_SIDE_PX, Camera, Kbps, Roi, Vehicle, least_float
from runner.core.rules.paper import demands
from runner.core.rules.registry import Last, Memory, Step, rule
from runner.core.rules.safe import lowest_of_all_copies, share_above_floors, shared_above_floors
from runner.core.state import State
from runner.core.view import Seen, enclosing

STEP_PX = 16  # of the edges of regions, so that small changes of a view are none
MOVED_STEP_PX = 64  # of the sides of a region that moves: each other length scales the picture anew
STEPS = 32  # of the scale at which screens show an image
OVERSAMPLED = 2  # px of a picture for each of the screen; with more, nothing more is seen
SLOW_MPS = 1.0
DENSER = 0.75  # of a part of an image: what a camera is aimed at needs more than its share of the bits
DETAIL = Fraction(3, 2)
GLANCE = Fraction(1, 100)  # least weight of a camera, as a share of what all screens show


class _Wanted(NamedTuple):
    """What a view needs, from a time on: a region, and how large screens show it."""

    since: float
    roi: Roi
    scale: Fraction


class _Region(NamedTuple):
    """A region in force and how large screens show it; and what has been wanted of late, the newest last."""

    roi: Roi
    scale: Fraction
    recent: tuple[_Wanted, ...]


@dataclass(frozen=True, slots=True)
class _Memory:
    """Regions by camera, and what was given for them, so that rules notice that nothing has changed."""

    regions: Mapping[str, _Region]
    shown: Mapping[str, Shown]


@rule(gives=["shown"], reads=["attention", "on", "position", "rois", "t", "view"])
def roi_from_view(
    vehicle: Vehicle,
    state: State,
    draft: Draft,
    memory: Memory,
    *,
    margin: Fraction = Fraction(1, 16),
    narrow_s: Fraction = Fraction(1),
) -> Step:
    """Of each camera, only what the operator in control sees is sent, with a margin, and what is always sent.

    A region widens at once; it narrows once less has been wanted for `narrow_s`, and follows a driver who pans. What
    was wanted within that time is sent. It never leaves the operator's own region. Everything is sent while no view is
    stated, or nobody can look at it.

    margin  on each side, as a share of what is seen, for a driver who pans
    Memory: by camera, the region in force and what was wanted within `narrow_s`.
    """
    past: _Memory = memory.get("shown", _Memory(NOTHING, NOTHING))
    is_seen, may_narrow = _is_stated(state), _may_narrow(state)
    regions: dict[str, _Region] = {}
    given: dict[str, Shown] = {}
    for name, camera in vehicle.cameras.items():
        if not state.on[name]:
            continue
        seen = state.view.get(name) if is_seen and not camera.graph.passes else None
        own = state.rois[name]
        wanted = (own, Fraction(1)) if seen is None else _wanted(camera, own, seen, margin)
        region = _followed(past.regions.get(name), wanted, own, state.t, least_float(narrow_s), may_narrow)
        area = own.pixels if seen is None else seen.screen_width * seen.screen_height
        regions[name], given[name] = region, Shown(region.roi, region.scale, _largest(camera, region.scale), area)
    shown = past.shown if given == past.shown else given  # the same object: later rules have nothing new to compute
    if shown is past.shown and regions == past.regions:
        return draft.replaced(shown=shown), memory
    return draft.replaced(shown=shown), {"shown": _Memory(regions, shown)}


def _is_stated(state: State) -> bool:
    return bool(state.view) and state.attention in (None, Attention.WATCHING)


def _may_narrow(state: State) -> bool:
    """Whether pictures may be taken away: while the vehicle drives, only from a driver who is known to watch."""
    speed = state.position.speed_mps if state.position else None
    return state.attention is Attention.WATCHING or (speed is not None and speed <= SLOW_MPS)


def _wanted(camera: Camera, own: Roi, seen: Seen, margin: Fraction) -> tuple[Roi, Fraction]:
    """Region that a view needs, within the operator's own, and the px of the screen for each of its own."""
    region = camera.kept_roi
    if not seen.is_empty:
        across, down = ceil(seen.width * margin), ceil(seen.height * margin)
        left, top = max(0, seen.x - across), max(0, seen.y - down)
        width, height = seen.x + seen.width + across - left, seen.y + seen.height + down - top
        region = enclosing(region, Roi(left, top, width, height))
    # Where pictures do not say what they show, a page would draw them in the wrong place until it knew of a new region.
    needed = _within(own, region) if camera.graph.places else own
    return needed, min(Fraction(1), Fraction(max(1, ceil(seen.scale * STEPS)), STEPS))


def _largest(camera: Camera, scale: Fraction) -> Fraction:
    """The factor above which no more is seen."""
    least = camera.rate_quality.scaling[0] if camera.least_scaling is None else camera.least_scaling
    return min(Fraction(1), max(least, OVERSAMPLED * scale))


def _within(own: Roi, region: Roi) -> Roi:
    """The region in steps, inside another; all of that where too little is left."""
    left, right = _side(own.x, own.width, region.x, region.width)
    top, bottom = _side(own.y, own.height, region.y, region.height)
    if min(right - left, bottom - top) < SMALLEST_SIDE_PX:
        return own
    inside = Roi(left, top, right - left, bottom - top)
    return own if inside == own else inside


def _side(begin: int, length: int, wanted: int, wide: int) -> tuple[int, int]:
    end = -(-(wanted + wide) // STEP_PX) * STEP_PX
    return max(begin, wanted // STEP_PX * STEP_PX), min(begin + length, end)


def _followed(
    past: _Region | None, wanted: tuple[Roi, Fraction], own: Roi, t: float, narrow_s: float, may_narrow: bool
) -> _Region:
    newest = _Wanted(t, *wanted)
    if past is None or not _contains(own, past.roi):
        return _Region(*wanted, (newest,))
    recent = past.recent if past.recent[-1][1:] == wanted else (*past.recent, newest)
    if not may_narrow and len(recent) > 1:
        recent = (_Wanted(t, past.roi, past.scale), newest)
    while len(recent) > 1 and t - recent[1].since >= narrow_s:
        recent = recent[1:]
    if len(recent) == 1:
        return _Region(*wanted, recent)
    needed = reduce(enclosing, (each.roi for each in recent))
    roi = past.roi if _contains(past.roi, needed) else _moved(past.roi, needed, own)
    return _Region(roi, max(each.scale for each in recent), recent)


def _moved(region: Roi, needed: Roi, own: Roi) -> Roi:
    """The region as little moved as it must be to include what is needed, and no smaller."""
    across = _shifted(region.x, region.width, needed.x, needed.width, own.x, own.width)
    down = _shifted(region.y, region.height, needed.y, needed.height, own.y, own.height)
    return Roi(across[0], down[0], across[1], down[1])


def _shifted(begin: int, length: int, needed: int, needed_length: int, low: int, most: int) -> tuple[int, int]:
    """Begin and length along one axis, within `most` px from `low`."""
    if needed_length > length:
        length = -(-needed_length // MOVED_STEP_PX) * MOVED_STEP_PX
    end = needed + needed_length
    start = min(max(begin, end - length), needed, low + most - length) // STEP_PX * STEP_PX
    start = max(low, start)
    return start, min(max(end, start + length), low + most) - start


def _contains(outer: Roi, inner: Roi) -> bool:
    return outer is inner or enclosing(outer, inner) == outer


@rule(needs=["shown"], gives=["demand"], reads=["on", "rois", "streams"])
def demand_from_view(vehicle: Vehicle, state: State, draft: Draft, memory: Memory) -> Step:
    """Eq. (1) for the regions that are sent; less where screens show fewer pixels than a camera's largest factor."""
    wanted = demands(vehicle, state)
    for name, own in draft.shown.items():
        share = own.largest / vehicle.cameras[name].rate_quality.scaling[-1]
        if share < 1:
            wanted[name] *= share * share
    return draft.replaced(demand=wanted), memory


@rule(
    needs=["total", "demand", "shown"],
    gives=["bitrate"],
    reads=["copies", "weights"],
    uses=["placed", "uplinks", "weights"],
)
def share_by_quality(
    vehicle: Vehicle,
    state: State,
    draft: Draft,
    memory: Memory,
    *,
    kept: Fraction = Fraction(17, 20),
    worst: Fraction = Fraction(0),
    least_kbps: Kbps = Fraction(30),
    detail: Fraction = DETAIL,
) -> Step:
    """The total is shared so that what screens show looks best; see `runner.core.hull`.

    Weights are the px of the screens times the operator's weight. Floors come first, and cameras with `shed` are given
    up as by `share_above_floors`. Without `rate_quality.quality` of every camera, Eq. (2) shares.

    kept        share of what Eq. (2) would give, of the part of the image that is sent, that each camera gets at least;
                with 1 no camera looks worse than by the paper's rules
    worst       share of the worst camera in what is maximised
    least_kbps  that a camera gets first that has no floor
    detail      between measured scales: the bits that a picture needs grow with its scale to this power
    Memory: the cameras given up.
    """
    sent = [name for name, own in draft.demand.items() if own]
    lacking = [name for name in sent if vehicle.cameras[name].rate_quality.quality is None]
    if lacking:
        which = "no camera has" if lacking == sent else f"{', '.join(lacking)} without"
        draft = draft.noted(f"{which} measured quality: shared by demand")
        return share_above_floors(vehicle, state, draft, memory)
    how = _How(float(kept), float(worst), least_kbps, float(detail))
    floors, slopes = lowest_of_all_copies(vehicle, state), list[float]()

    def share(wanted: Mapping[str, Kbps], total: Kbps) -> Mapping[str, Kbps]:
        given: Mapping[str, Kbps]
        given, slope = _best(vehicle, state.weights, state.copies, floors, draft.shown, wanted, total, how)
        slopes.append(slope)
        return given

    draft, memory = shared_above_floors(vehicle, state, draft, memory, share)
    gain = 100 * max(slopes)
    return draft.noted(f"shared by quality: 100 kbit/s more would add {gain:.1g}") if 0 < gain < inf else draft, memory


def displayed_curve(camera: Camera, region: Roi, scale: Fraction, detail: float) -> Curve | None:
    """Quality of a region as screens show it over its bitrate, by the camera's model; None: not measured.

    scale   px of the screen for each px of the region, at most 1
    detail  see `share_by_quality`
    """
    measured, model = camera.rate_quality.at(scale)
    times = _part(camera, region) * float(scale / measured) ** detail
    return model.quality.stretched(times) if model.quality else None


def _part(camera: Camera, region: Roi) -> float:
    """The bits that a region needs, as a share of the full image's."""
    return float((region.pixels / camera.full_roi.pixels) ** DENSER)


class _How(NamedTuple):
    """The parameters of `share_by_quality`."""

    kept: float
    worst: float
    least_kbps: Kbps
    detail: float


@Last
def _best(
    vehicle: Vehicle,
    weights: Mapping[str, Fraction],
    copies: Mapping[str, int],
    floors: Mapping[str, Kbps],
    shown: Mapping[str, Shown],
    wanted: Mapping[str, Kbps],
    total: Kbps,
    how: _How,
) -> tuple[Mapping[str, Kbps], float]:
    """kbit/s by camera, of all copies, in tenths; and the gain of quality for another kbit/s."""
    names = [name for name, own in wanted.items() if own]
    glance = GLANCE * sum((shown[name].area for name in names), 1)
    hard = {name: floors.get(name) or how.least_kbps * copies.get(name, 1) for name in names}
    full = {name: vehicle.cameras[name].rate_quality.b_full * copies.get(name, 1) for name in names}
    equal = allocation.allocate_above_floors(full, total, weights, hard)
    contenders: dict[str, Contender] = {}
    for name in names:
        camera, own, times = vehicle.cameras[name], shown[name], copies.get(name, 1)
        part = _part(camera, own.roi)
        curve = displayed_curve(camera, own.roi, own.scale, how.detail)
        assert curve
        curve = curve.stretched(times)
        weight = float(weights[name] * max(glance, Fraction(own.area)))
        floor = max(float(hard[name]), how.kept * part * float(equal[name]))
        most = max(floor, float(wanted[name])) if weight else floor
        contenders[name] = Contender(curve, weight, floor, most)
    shares, slope = best_shares(list(contenders.values()), float(total), how.worst)
    given = {name: Fraction(int(10 * kbps), 10) for name, kbps in zip(contenders, shares, strict=True)}
    weight = sum(one.weight for one in contenders.values())
    return {name: given.get(name, allocation.ZERO) for name in wanted}, slope / weight if weight else 0.0
