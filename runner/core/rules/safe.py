"""Responses to stale or lost inputs: modes=safe."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from fractions import Fraction
from functools import cache, partial
from math import ceil, inf
from typing import NamedTuple

from runner.core import allocation, scaling
from runner.core import follow_link as follow
from runner.core.belief import LOWEST, Belief
from runner.core.budget import beside_sound, unplaced, video_kbps, wire_kbps
from runner.core.decision import Draft, UplinkShare
from runner.core.events import LinkState
from runner.core.follow_link import FLOOR, Ceiling, Reports
from runner.core.frame_rate import slowed
from runner.core.model import Camera, Kbps, Mode, Vehicle, exact, plain
from runner.core.placement import shared
from runner.core.rules.paper import (
    above_fixed,
    as_sent,
    demands,
    lasting_share,
    of_all_copies,
    whole,
    with_excess_noted,
)
from runner.core.rules.registry import Last, Memory, Step, rule
from runner.core.state import State

FORGOTTEN_S = 10.0  # without anything that arrives over one of several uplinks, until what it carried counts no more
_allocated = Last(allocation.allocate_above_floors)

Share = Callable[[Mapping[str, Kbps], Kbps], Mapping[str, Kbps]]


@rule(
    needs=["total", "demand"],
    gives=["bitrate"],
    reads=["copies", "streams", "weights"],
    uses=["placed", "uplinks", "weights"],
)
def share_above_floors(vehicle: Vehicle, state: State, draft: Draft, memory: Memory) -> Step:
    """As `share_by_demand`, but each camera first gets its `floor_kbps`; those with `shed` are given up first.

    Memory: the cameras given up.
    """
    return shared_above_floors(vehicle, state, draft, memory, _by_demand(vehicle, state))


def shared_above_floors(vehicle: Vehicle, state: State, draft: Draft, memory: Memory, share: Share) -> Step:
    """The total shared, with cameras given up for the floors of others; memory: these cameras.

    share  returns kbit/s by camera, of all copies, from what is wanted for them, and their total
    """
    draft, given_up, memory = _give_up(vehicle, state, draft, draft.demand, memory)
    wanted = _without(given_up, draft.demand)
    given = _shared(vehicle, state, draft, wanted, share)
    return with_excess_noted(vehicle, state, draft.replaced(bitrate=given)), memory


def _by_demand(vehicle: Vehicle, state: State) -> Share:
    """Floors first, then Eq. (2)."""
    floors = lowest_of_all_copies(vehicle, state)
    return lambda wanted, total: _allocated(wanted, total, state.weights, floors)


def lowest_of_all_copies(vehicle: Vehicle, state: State) -> Mapping[str, Kbps]:
    """kbit/s by camera that has a floor, for every copy that leaves the vehicle."""
    floors = _floors(vehicle)
    return {name: own * state.copies.get(name, 1) for name, own in floors.items()} if state.copies else floors


def _shared(
    vehicle: Vehicle, state: State, draft: Draft, wanted: Mapping[str, Kbps], share_of_all: Share
) -> Mapping[str, Kbps]:
    """kbit/s by camera, of the total, or of what the uplinks carry that it is placed on."""
    assert draft.total is not None
    share = partial(_shared_among, vehicle, state, share_of_all)
    if not draft.placed:
        return share(wanted, draft.total)
    living = {
        name: [at for at in uplinks if not draft.uplinks[at].stalled]
        for name, uplinks in draft.placed.items()
        if vehicle.cameras[name].redundant
    }
    limits = {
        name: (living[name] or uplinks) if name in living else uplinks[:1] for name, uplinks in draft.placed.items()
    }
    totals = {name: share.total for name, share in draft.uplinks.items()}
    given = shared(limits, totals, wanted, share)
    copies = {name: others for name, on in draft.placed.items() if (others := set(on).difference(limits[name]))}
    if not copies:
        return given
    for name, others in copies.items():  # as of a camera that moves; they take from what the other cameras get
        totals |= {at: max(allocation.ZERO, totals[at] - given[name]) for at in others}
    again = shared(limits, totals, wanted, share)
    return again | {name: min(given[name], again[name]) for name in copies}


def _shared_among(
    vehicle: Vehicle, state: State, share: Share, wanted: Mapping[str, Kbps], total: Kbps
) -> Mapping[str, Kbps]:
    """kbit/s by camera; the total counts every copy of a camera that leaves the vehicle."""
    if not state.copies:
        return above_fixed(vehicle, state, wanted, total, share)
    copies = {name: state.copies.get(name, 1) for name in wanted}
    of_all = {name: own * copies[name] for name, own in wanted.items()}
    given = above_fixed(vehicle, state, of_all, total, share, copies)
    return {name: Fraction(own) / copies[name] for name, own in given.items()}


def _give_up(
    vehicle: Vehicle, state: State, draft: Draft, wanted: Mapping[str, Kbps], memory: Memory
) -> tuple[Draft, tuple[str, ...], Memory]:
    """The draft with a note of the cameras given up for the floors of others, these cameras, the memory with them."""
    before: tuple[str, ...] = memory.get("given_up", ())
    given_up: tuple[str, ...] = ()
    if order := _shed_order(vehicle):
        assert draft.total is not None
        sent = as_sent(vehicle, state, wanted)
        floors = {name: floor * state.copies.get(name, 1) for name, floor in _lowest(vehicle, state, sent).items()}
        of_all = {name: own * state.copies.get(name, 1) for name, own in sent.items()}
        given_up = allocation.shed(of_all, draft.total, floors, order, before)
    if given_up != before:
        memory = {"given_up": given_up}
    if given_up:
        draft = draft.noted(f"{', '.join(given_up)} given up for the floors of others")
    return draft, given_up, memory


def _without(given_up: Collection[str], wanted: Mapping[str, Kbps]) -> Mapping[str, Kbps]:
    """Demand by camera; 0 for those given up."""
    return {name: allocation.ZERO if name in given_up else own for name, own in wanted.items()} if given_up else wanted


@cache
def _floors(vehicle: Vehicle) -> Mapping[str, Kbps]:
    """kbit/s by camera, for those that have a floor."""
    return {name: camera.floor_kbps for name, camera in vehicle.cameras.items() if camera.floor_kbps}


def _lowest(vehicle: Vehicle, state: State, wanted: Mapping[str, Kbps]) -> Mapping[str, Kbps]:
    """The floors, with those of cameras that encode by themselves: they get that, or nothing."""
    floors = _floors(vehicle)
    if not (vehicle.fixed or vehicle.lowest):
        return floors
    fixed = {name: wanted[name] for name in vehicle.fixed if name in wanted}
    least = {
        name: max(own, floors.get(name, allocation.ZERO), state.streams.get(name, allocation.ZERO))
        for name, own in vehicle.lowest.items()
    }
    return {**floors, **fixed, **least}


@cache
def _shed_order(vehicle: Vehicle) -> tuple[str, ...]:
    numbers = {name: camera.shed for name, camera in vehicle.cameras.items() if camera.shed is not None}
    return tuple(sorted(numbers, key=lambda name: numbers[name]))


@rule(
    needs=["total", "bitrate", "scaling"],
    gives=["bitrate", "scaling"],
    reads=["copies", "rois", "streams", "weights"],
    uses=["placed", "sized_for", "uplinks", "weights"],
)
def fit_to_total(vehicle: Vehicle, state: State, draft: Draft, memory: Memory) -> Step:
    """Mode S with less: Eq. (2) in proportion to what the operator has set, with floors as in `share_above_floors`.

    Where the bitrate falls into a lower range of Eq. (4), the factor falls with it, never above the operator's own.
    The operator's settings are kept, and apply again once the total allows.

    Memory: the cameras given up.
    """
    total = draft.total
    assert total is not None
    if total >= of_all_copies(state, as_sent(vehicle, state, draft.bitrate)) and not draft.placed:
        return draft, {} if memory else memory
    draft, given_up, memory = _give_up(vehicle, state, draft, draft.bitrate, memory)
    wanted = _without(given_up, draft.bitrate)
    bitrates = _shared(vehicle, state, draft, wanted, _by_demand(vehicle, state))
    if bitrates == draft.bitrate:
        return draft, memory
    factors, reasons = dict(draft.scaling), dict(draft.reasons)
    for name, own in factors.items():
        camera, roi = vehicle.cameras[name], state.rois[name]
        asked, fitted = (
            scaling.select_scaling(camera.rate_quality, scaling.as_full_image(kbps, roi, camera.full_roi))[0]
            for kbps in (draft.bitrate[name], bitrates[name] * (lasting_share(draft) or 1))
        )
        if fitted < asked:
            factors[name] = min(own, fitted)
        reasons[name] += f", sent with {whole(bitrates[name])} kbit/s and {plain(factors[name])}"
    return draft.replaced(bitrate=bitrates, scaling=factors, reasons=reasons), memory


@rule(
    needs=["total"],
    gives=["total", "uncapped", "sized_for", "uplinks"],
    reads=["copies", "link", "links", "on", "operator_since", "prediction", "predictions", "rois", "streams", "t"],
    uses=["fps"],
)
def follow_link(
    vehicle: Vehicle,
    state: State,
    draft: Draft,
    memory: Memory,
    *,
    reports: Reports = Reports.FOLLOWED,
    ceiling: Ceiling = Ceiling.NONE,
    reserve_kbps: Kbps = allocation.ZERO,
    start: Fraction = Fraction(1, 2),
    after_s: Fraction = Fraction(2),
    halve_every_s: Fraction = Fraction(1),
    floor_kbps: Kbps = FLOOR,
) -> Step:
    """The total is what the uplink is believed to carry; see `runner.core.belief`.

    The belief follows the reports of the operator's side, and takes predictions for evidence, as far as they proved
    right. With `ceiling: prediction`, and in modes C and S, the total before this rule is a limit, too. Of the link,
    `reserve_kbps` are left to other traffic. When an operator connects, the total starts at the share `start`.

    Without reports, or with `reports: ignored`, a prediction is a limit that fades: the total is at most its lower
    bound, and once it is older than its own `valid_s`, otherwise `after_s`, the total is halved, and again every
    `halve_every_s`, down to `floor_kbps`. Before the first prediction, its age counts from the start of the run.

    Memory: `Belief`, or one by uplink.
    """
    how = _Following(reports, ceiling, reserve_kbps, start, after_s, halve_every_s, floor_kbps)
    if vehicle.uplinks:
        return _follow_each(vehicle, state, draft, memory, how)
    draft, belief = _follow(vehicle, state, draft, memory.get("belief"), how)
    return draft, memory if belief is None else {"belief": belief}


class _Following(NamedTuple):
    """The parameters of `follow_link`."""

    reports: Reports
    ceiling: Ceiling
    reserve_kbps: Kbps
    start: Fraction
    after_s: Fraction
    halve_every_s: Fraction
    floor_kbps: Kbps


def _follow(
    vehicle: Vehicle, state: State, draft: Draft, past: Belief | None, how: _Following, of_all: Kbps | None = None
) -> tuple[Draft, Belief | None]:
    """The total that one uplink carries, and what is believed of it; None: nothing new.

    of_all  total of several uplinks, which limits this one too; that before is what it begins with, and its prediction
            is part of one for all, no evidence of its capacity. None: the total before is its own, as is the prediction
    """
    begins = draft.total
    assert begins is not None
    asked = begins if of_all is None else of_all
    cameras, is_automatic = sent_cameras(vehicle, state, draft.fps), state.mode is Mode.AUTOMATIC
    link = state.link if how.reports is Reports.FOLLOWED else None
    if not cameras or not follow.is_measured(state, link, past):
        if is_automatic:
            draft = follow.faded(vehicle, state, draft, len(cameras), how.after_s, how.halve_every_s, how.floor_kbps)
        return follow.started(state, draft, how.start), None
    limit = float(wire_kbps(cameras, asked) + how.reserve_kbps)
    has_limit = not is_automatic or how.ceiling is Ceiling.PREDICTION
    is_predicted = is_automatic and of_all is None
    least = max(exact(LOWEST), Fraction(len(cameras)))
    belief = follow.updated(
        past,
        state,
        link,
        start=float(how.start * wire_kbps(cameras, begins)),
        most=float(wire_kbps(cameras, of_all_copies(state, _wanted(vehicle, state, draft)))),
        prediction=follow.predicted(vehicle, state, cameras, how.after_s) if is_predicted else follow.NO_PREDICTION,
        floors=float(_wire_floors(vehicle, state, draft, cameras, how.reserve_kbps)),
        ceiling=limit if has_limit else inf,
    )

    def video(wire: float) -> Kbps:
        if has_limit and wire >= min(limit, belief.most):
            return asked
        carried = video_kbps(cameras, max(wire_kbps(cameras, least), exact(round(wire, 1)) - how.reserve_kbps))
        return min(asked, carried) if has_limit else carried

    draft = draft.replaced(measured=not has_limit and belief.learned.ln is None)
    return follow.followed(draft, video(belief.total), video(belief.lasting), belief, cameras, link), belief


def _follow_each(vehicle: Vehicle, state: State, draft: Draft, memory: Memory, how: _Following) -> Step:
    """The same for each of several uplinks, as if it were the only one, with its own reports and predictions.

    Where the total before is a limit, it is one for all together; a prediction for one uplink limits that one.
    """
    asked, is_automatic = draft.total, state.mode is Mode.AUTOMATIC
    assert asked is not None
    alone, beliefs = {}, {}
    for name, reserve in vehicle.uplinks.items():
        own, past = state.over(name, len(vehicle.uplinks)), memory.get(name)
        begins = Fraction(asked) / len(vehicle.uplinks)
        if own.prediction and is_automatic:
            begins = beside_sound(vehicle, state.copies, own.prediction.kbps)
        if past and own.link and own.link.evidence.silent_s > FORGOTTEN_S:
            past = None  # it may be another cell, or another network
        follows = how._replace(reserve_kbps=how.reserve_kbps + reserve)
        of_all = None if name in state.predictions and is_automatic else asked
        alone[name], belief = _follow(vehicle, own, draft.replaced(total=begins, notes=()), past, follows, of_all)
        beliefs[name] = past if belief is None else belief
    stalled = {name for name, link in state.links.items() if link.state is LinkState.STALLED}
    has_limit = how.ceiling is Ceiling.PREDICTION and state.prediction is not None if is_automatic else True
    together = _together(draft, alone, stalled)
    return _limited(together, asked, shares=state.mode is not Mode.SINGLE) if has_limit else together, beliefs


def _together(draft: Draft, alone: Mapping[str, Draft], stalled: Collection[str]) -> Draft:
    """What all uplinks carry, from what each does."""
    totals = {name: own.total or allocation.ZERO for name, own in alone.items()}
    total = sum(totals.values(), allocation.ZERO)
    lasting = sum((own.sized_for or own.total or allocation.ZERO for own in alone.values()), allocation.ZERO)
    return draft.replaced(
        total=total,
        uplinks={
            name: UplinkShare(totals[name], name in stalled, own.believed, "; ".join(map(_why, own.notes)))
            for name, own in alone.items()
        },
        measured=all(own.measured for own in alone.values()),
        uncapped=sum((own.uncapped or own.total or allocation.ZERO for own in alone.values()), allocation.ZERO),
        sized_for=None if lasting == total else lasting,
    )


def _limited(draft: Draft, limit: Kbps, *, shares: bool) -> Draft:
    """With a limit for all uplinks together.

    shares  whether what each carries is limited in proportion; otherwise any of them may carry all of it
    """
    total = draft.total
    assert total is not None
    if total < limit:
        return draft.replaced(uncapped=limit)
    uplinks = draft.uplinks
    if shares and total:
        uplinks = {name: replace(each, total=each.total * limit / total) for name, each in uplinks.items()}
    lasting = None if draft.sized_for is None or draft.sized_for >= limit else draft.sized_for
    return draft.replaced(total=limit, uplinks=uplinks, uncapped=None, sized_for=lasting)


def _why(note: str) -> str:
    """A note without the total, which differs from that of all uplinks: see `Draft.limited`."""
    return note.partition(": ")[2] or note


def sent_cameras(vehicle: Vehicle, state: State, fps: Mapping[str, Fraction]) -> tuple[Camera, ...]:
    """The cameras that are on, with repetitions for those that leave the vehicle in several copies.

    fps  of those that send fewer pictures than they have
    """
    sent = {name: slowed(c, fps[name]) if name in fps else c for name, c in vehicle.cameras.items() if state.on[name]}
    sent |= {name: unplaced(camera) for name, camera in sent.items() if state.rois[name] == camera.full_roi}
    return tuple(camera for name, camera in sent.items() for _ in range(state.copies.get(name, 1)))


def _wanted(vehicle: Vehicle, state: State, draft: Draft) -> Mapping[str, Kbps]:
    """The most that each camera will get, kbit/s: in mode S what the operator has set, otherwise Eq. (1)."""
    return draft.bitrate or draft.demand or demands(vehicle, state)


def _wire_floors(vehicle: Vehicle, state: State, draft: Draft, cameras: tuple[Camera, ...], reserve: Kbps) -> Kbps:
    """Floors of all cameras that are never given up, on the wire, in tenths of a kbit/s; 0: none.

    cameras  that are on, with repetitions for copies
    """
    if not (vehicle.fixed or vehicle.lowest or _floors(vehicle)):
        return allocation.ZERO
    wanted = as_sent(vehicle, state, _wanted(vehicle, state, draft))
    floors = sum(
        (
            min(floor, wanted.get(name, allocation.ZERO)) * state.copies.get(name, 1)
            for name, floor in _lowest(vehicle, state, wanted).items()
            if vehicle.cameras[name].shed is None
        ),
        allocation.ZERO,
    )
    return Fraction(ceil(10 * (reserve + wire_kbps(cameras, floors))), 10) if floors else floors


@rule(reads=["operator_lost", "t"])
def pause_without_operator(vehicle: Vehicle, state: State, draft: Draft, memory: Memory, *, after_s: Fraction) -> Step:
    """Nothing is sent while the operator's side has been gone for over `after_s`; sending resumes on its return."""
    lost = state.operator_lost
    if lost is None or state.t - lost <= after_s:
        return draft, memory
    return draft.noted(f"not sending: operator gone for {state.t - lost:.1f} s", sending=False), memory
