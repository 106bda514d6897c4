"""Responses to stale or lost inputs: modes=safe."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from fractions import Fraction
from functools import cache
from math import ceil, inf

from runner.core import allocation, scaling
from runner.core import follow_link as follow
from runner.core.belief import LOWEST, Belief
from runner.core.budget import video_kbps, wire_kbps
from runner.core.decision import Draft
from runner.core.follow_link import FLOOR, Ceiling, Reports
from runner.core.model import Camera, Kbps, Mode, Vehicle, exact, plain
from runner.core.rules.paper import demands, lasting_share, of_all_copies, whole
from runner.core.rules.registry import Last, Memory, Step, rule
from runner.core.state import State

_allocated = Last(allocation.allocate_above_floors)


@rule(needs=["total", "demand"], gives=["bitrate"], reads=["copies", "weights"])
def share_above_floors(vehicle: Vehicle, state: State, draft: Draft, memory: Memory) -> Step:
    """As `share_by_demand`, but each camera first gets its `floor_kbps`; those with `shed` are given up first.

    Memory: the cameras given up.
    """
    total = draft.total
    assert total is not None
    draft, given_up, memory = _give_up(vehicle, state, draft, draft.demand, memory)
    wanted = _without(given_up, draft.demand)
    return draft.replaced(bitrate=_shared(vehicle, state, wanted, total)), memory


def _shared(vehicle: Vehicle, state: State, wanted: Mapping[str, Kbps], total: Kbps) -> Mapping[str, Kbps]:
    """kbit/s by camera: floors first, then Eq. (2); the total counts every copy of a camera that leaves the vehicle."""
    floors = _floors(vehicle)
    if not state.copies:
        allocated: Mapping[str, Kbps] = _allocated(wanted, total, state.weights, floors)
        return allocated
    copies = {name: state.copies.get(name, 1) for name in wanted}
    of_all = {name: own * copies[name] for name, own in wanted.items()}
    lowest = {name: floor * copies[name] for name, floor in floors.items()}
    shares = allocation.allocate_above_floors(of_all, total, state.weights, lowest)
    return {name: Fraction(share) / copies[name] for name, share in shares.items()}


def _give_up(
    vehicle: Vehicle, state: State, draft: Draft, wanted: Mapping[str, Kbps], memory: Memory
) -> tuple[Draft, tuple[str, ...], Memory]:
    """The draft with a note of the cameras given up for the floors of others, these cameras, the memory with them."""
    before: tuple[str, ...] = memory.get("given_up", ())
    given_up: tuple[str, ...] = ()
    if order := _shed_order(vehicle):
        assert draft.total is not None
        floors = {name: floor * state.copies.get(name, 1) for name, floor in _floors(vehicle).items()}
        of_all = {name: own * state.copies.get(name, 1) for name, own in wanted.items()}
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


@cache
def _shed_order(vehicle: Vehicle) -> tuple[str, ...]:
    numbers = {name: camera.shed for name, camera in vehicle.cameras.items() if camera.shed is not None}
    return tuple(sorted(numbers, key=lambda name: numbers[name]))


@rule(
    needs=["total", "bitrate", "scaling"],
    gives=["bitrate", "scaling"],
    reads=["copies", "rois", "weights"],
    uses=["sized_for"],
)
def fit_to_total(vehicle: Vehicle, state: State, draft: Draft, memory: Memory) -> Step:
    """Mode S with less: Eq. (2) in proportion to what the operator has set, with floors as in `share_above_floors`.

    Where the bitrate falls into a lower range of Eq. (4), the factor falls with it, never above the operator's own.
    The operator's settings are kept, and apply again once the total allows.

    Memory: the cameras given up.
    """
    total = draft.total
    assert total is not None
    if total >= of_all_copies(state, draft.bitrate):
        return draft, {} if memory else memory
    draft, given_up, memory = _give_up(vehicle, state, draft, draft.bitrate, memory)
    bitrates = _shared(vehicle, state, _without(given_up, draft.bitrate), total)
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
    gives=["total", "uncapped", "sized_for"],
    reads=["copies", "link", "on", "operator_since", "prediction", "rois", "t"],
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

    Memory: `Belief`.
    """
    asked = draft.total
    assert asked is not None
    cameras, is_automatic = sent_cameras(vehicle, state), state.mode is Mode.AUTOMATIC
    past: Belief | None = memory.get("belief")
    link = state.link if reports is Reports.FOLLOWED else None
    if not cameras or not follow.is_measured(state, link, past):
        if is_automatic:
            draft = follow.faded(state, draft, len(cameras), after_s, halve_every_s, floor_kbps)
        return follow.started(state, draft, start), memory
    limit = float(wire_kbps(cameras, asked) + reserve_kbps)
    has_limit = not is_automatic or ceiling is Ceiling.PREDICTION
    least = max(exact(LOWEST), Fraction(len(cameras)))
    belief = follow.updated(
        past,
        state,
        link,
        start=float(start * wire_kbps(cameras, asked)),
        most=float(wire_kbps(cameras, of_all_copies(state, _wanted(vehicle, state, draft)))),
        prediction=follow.predicted(state, cameras, after_s) if is_automatic else follow.NO_PREDICTION,
        floors=float(_wire_floors(vehicle, state, draft, cameras, reserve_kbps)),
        ceiling=limit if has_limit else inf,
    )

    def video(wire: float) -> Kbps:
        if has_limit and wire >= min(limit, belief.most):
            return asked
        carried = video_kbps(cameras, max(wire_kbps(cameras, least), exact(round(wire, 1)) - reserve_kbps))
        return min(asked, carried) if has_limit else carried

    draft = draft.replaced(measured=not has_limit and belief.learned.ln is None)
    draft = follow.followed(draft, video(belief.total), video(belief.lasting), belief, cameras, link)
    return draft, {"belief": belief}


def sent_cameras(vehicle: Vehicle, state: State) -> tuple[Camera, ...]:
    """The cameras that are on, with repetitions for those that leave the vehicle in several copies."""
    mounted = vehicle.cameras.items()
    return tuple(c for name, c in mounted if state.on[name] for _ in range(state.copies.get(name, 1)))


def _wanted(vehicle: Vehicle, state: State, draft: Draft) -> Mapping[str, Kbps]:
    """The most that each camera will get, kbit/s: in mode S what the operator has set, otherwise Eq. (1)."""
    return draft.bitrate or draft.demand or demands(vehicle, state)


def _wire_floors(vehicle: Vehicle, state: State, draft: Draft, cameras: tuple[Camera, ...], reserve: Kbps) -> Kbps:
    """Floors of all cameras that are never given up, on the wire, in tenths of a kbit/s; 0: none.

    cameras  that are on, with repetitions for copies
    """
    if not (lowest := _floors(vehicle)):
        return allocation.ZERO
    wanted = _wanted(vehicle, state, draft)
    floors = sum(
        (
            min(floor, wanted.get(name, allocation.ZERO)) * state.copies.get(name, 1)
            for name, floor in lowest.items()
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
