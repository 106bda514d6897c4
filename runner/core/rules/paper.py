"""The paper's rules, and those that it is compared with: modes=paper, fixed and equal."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from fractions import Fraction
from functools import partial

from runner.core import allocation, scaling
from runner.core.decision import NOTHING, Draft, Shown, short
from runner.core.model import Camera, Kbps, Roi, Vehicle, plain
from runner.core.rules.registry import Last, Memory, Step, rule
from runner.core.state import State

Shares = Mapping[str, Kbps]
AS_ENCODED = "as the camera encodes it"
AS_ASKED = "as the camera is asked to encode it"


@rule(gives=["total"], reads=["prediction", "predictions"])
def total_from_prediction(vehicle: Vehicle, state: State, draft: Draft, memory: Memory, *, start_kbps: Kbps) -> Step:
    """Mode A: the total is the last prediction of pQoS; `start_kbps` until the first one arrives."""
    return draft.replaced(total=start_kbps if (known := state.predicted_kbps) is None else known), memory


@rule(gives=["total"], reads=["collective_total"])
def total_from_operator(vehicle: Vehicle, state: State, draft: Draft, memory: Memory, *, start_kbps: Kbps) -> Step:
    """Mode C: the total is the operator's; `start_kbps` if a run starts in C and none was set yet."""
    return draft.replaced(total=start_kbps if state.collective_total is None else state.collective_total), memory


@rule(gives=["total"], reads=[])
def total_fixed(vehicle: Vehicle, state: State, draft: Draft, memory: Memory, *, kbps: Kbps) -> Step:
    """The total is a constant, independent of the prediction; for comparison."""
    return draft.replaced(total=kbps), memory


@rule(gives=["demand"], reads=["on", "rois", "streams"])
def demand_from_roi(vehicle: Vehicle, state: State, draft: Draft, memory: Memory) -> Step:
    """Eq. (1): each camera that is on asks in proportion to the pixels of its ROI, or for what it encodes by itself."""
    return draft.replaced(demand=demands(vehicle, state)), memory


def demands(vehicle: Vehicle, state: State) -> dict[str, Kbps]:
    """kbit/s by camera, Eq. (1); 0 when off."""
    return {
        name: allocation.demand(_full(vehicle, state, camera), state.rois[name], camera.full_roi)
        if state.on[name]
        else allocation.ZERO
        for name, camera in vehicle.cameras.items()
    }


def _full(vehicle: Vehicle, state: State, camera: Camera) -> Kbps:
    """kbit/s of the full image: its b_full, or what it was measured to send if nothing can change that."""
    b_full = camera.rate_quality.b_full
    return state.streams.get(camera.name, b_full) if camera.name in vehicle.fixed else b_full


def above_fixed(
    vehicle: Vehicle,
    state: State,
    wanted: Mapping[str, Kbps],
    total: Kbps,
    share: Callable[[Mapping[str, Kbps], Kbps], Shares],
    copies: Mapping[str, int] = NOTHING,
) -> Shares:
    """kbit/s by camera: what cameras encode by themselves comes off the total first; the others share the rest.

    A camera whose bitrate can be set shares with the others, but gets at least what it can be set to. One that sends
    more than it was asked for is asked for its share, and the others share what it leaves.

    share   returns kbit/s by camera, from demands and their total
    copies  by camera, of how many copies `wanted` and what is returned are; 1 for others
    """
    if not (vehicle.fixed or vehicle.lowest):
        return share(wanted, total)
    taken = {name: kbps for name, kbps in wanted.items() if name in vehicle.fixed}
    given = _beside(taken, wanted, total, share)
    settable = {name: copies.get(name, 1) for name in vehicle.lowest if wanted.get(name)}
    lowest = {name: min(wanted[name], vehicle.lowest[name] * number) for name, number in settable.items()}
    while below := {name: least for name, least in lowest.items() if given[name] < least}:
        taken |= below
        given = _beside(taken, wanted, total, share)
    sent = {name: state.streams.get(name, allocation.ZERO) * number for name, number in settable.items()}
    if over := {name: kbps for name, kbps in sent.items() if kbps > given[name]}:
        return {**_beside(taken | over, wanted, total, share), **{name: given[name] for name in over}}
    return given


def _beside(
    taken: Shares, wanted: Mapping[str, Kbps], total: Kbps, share: Callable[[Mapping[str, Kbps], Kbps], Shares]
) -> Shares:
    """kbit/s by camera: some take what they take, the others share the rest."""
    others = {name: kbps for name, kbps in wanted.items() if name not in taken}
    given = share(others, max(allocation.ZERO, total - sum(taken.values())))
    return {name: taken[name] if name in taken else given[name] for name in wanted}


def as_sent(vehicle: Vehicle, state: State, kbps: Shares) -> Shares:
    """kbit/s by camera, with what those send that were asked for less."""
    sending = [name for name in vehicle.lowest if kbps.get(name)]
    return {**kbps, **{name: max(kbps[name], state.streams.get(name, allocation.ZERO)) for name in sending}}


def with_excess_noted(vehicle: Vehicle, state: State, draft: Draft) -> Draft:
    """With a note if what cameras encode by themselves is more than the total."""
    assert draft.total is not None
    sent = as_sent(vehicle, state, draft.bitrate)
    fixed = sum((sent[name] for name in (*vehicle.fixed, *vehicle.lowest)), allocation.ZERO)
    if fixed <= draft.total:
        return draft
    return draft.noted(f"cameras that encode by themselves send {whole(fixed)} of {whole(draft.total)} kbit/s")


@rule(needs=["total", "demand"], gives=["bitrate"], reads=["streams", "weights"], uses=["weights"])
def share_by_demand(vehicle: Vehicle, state: State, draft: Draft, memory: Memory) -> Step:
    """Eq. (2): the total is shared in proportion to demand times weight, no camera gets more than its demand."""
    assert draft.total is not None
    share = partial(allocation.allocate, weights=state.weights)
    given = above_fixed(vehicle, state, draft.demand, draft.total, share)
    return with_excess_noted(vehicle, state, draft.replaced(bitrate=given)), memory


@rule(needs=["total", "demand"], gives=["bitrate"], reads=["streams", "weights"], uses=["weights"])
def share_equally(vehicle: Vehicle, state: State, draft: Draft, memory: Memory) -> Step:
    """Each camera that is on gets the same, times its weight, but no more than its demand; for comparison."""
    assert draft.total is not None
    # Eq. (2) shares in proportion to weight times demand; this cancels the demand.
    wanted = {name: demand for name, demand in draft.demand.items() if demand}
    weights = {name: state.weights[name] / wanted.get(name, 1) for name in draft.demand}
    share = partial(allocation.allocate, weights=weights)
    given = above_fixed(vehicle, state, draft.demand, draft.total, share)
    return with_excess_noted(vehicle, state, draft.replaced(bitrate=given)), memory


@rule(needs=["bitrate"], gives=["scaling"], reads=["rois", "streams"], uses=["shown", "sized_for"])
def scaling_from_rate_quality(vehicle: Vehicle, state: State, draft: Draft, memory: Memory) -> Step:
    """Eq. (4): the factor whose bitrate range contains the allocation, converted to the full image.

    If an earlier rule has given what the operator sees, the ranges are those of pictures of that size on the screen.
    """
    lasting, streams = lasting_share(draft), state.streams
    factors, reasons = _scaled(
        vehicle, state.on, state.rois, streams, draft.demand, draft.bitrate, lasting, draft.shown
    )
    return draft.replaced(scaling=factors, reasons=reasons), memory


def lasting_share(draft: Draft) -> Fraction | None:
    """The total for which sizes are chosen, in multiples of the present one; None: that one."""
    return draft.sized_for / draft.total if draft.sized_for and draft.total else None


@Last
def _scaled(
    vehicle: Vehicle,
    on: Mapping[str, bool],
    rois: Mapping[str, Roi],
    streams: Mapping[str, Kbps],
    demand: Mapping[str, Kbps],
    bitrate: Mapping[str, Kbps],
    lasting: Fraction | None,
    shown: Mapping[str, Shown],
) -> tuple[Mapping[str, Fraction], Mapping[str, str]]:
    """Factor and reason by camera. lasting: see `lasting_share`."""
    factors, reasons = {}, {}
    for name, camera in vehicle.cameras.items():
        if not on[name]:
            continue
        allocated, roi, full = bitrate[name], rois[name], camera.full_roi
        kbps, sized_for = whole(allocated), allocated if lasting is None else allocated * lasting
        of_full = scaling.as_full_image(sized_for, roi, full)
        # A camera that cannot be sent gets the smallest factor, however few its pixels.
        model = camera.rate_quality
        if name in shown:
            model = model.at(shown[name].scale)[1]
        factors[name], why = scaling.select_scaling(model, of_full if kbps else allocation.ZERO)
        as_full = ""
        if kbps and (lasting is not None or (roi is not full and roi != full)):
            as_full = f", as {whole(of_full)} for the full image"
            as_full += "" if lasting is None else " at the total that lasts"
        if camera.graph.passes:
            why = _as_encoded(vehicle, camera, streams.get(name))
        reasons[name] = f"{kbps} of {short(demand[name])} kbit/s{as_full}, {why}"
        if name in shown and shown[name].largest < factors[name]:
            factors[name] = shown[name].largest
            reasons[name] += f", the screen shows no more than {plain(factors[name])}"
    return factors, reasons


def _as_encoded(vehicle: Vehicle, camera: Camera, sent: Kbps | None) -> str:
    """Why a camera that encodes by itself costs what it costs.

    sent  as measured, see `StreamMeasured`
    """
    b_full = camera.rate_quality.b_full
    if camera.name in vehicle.lowest:
        return f"{AS_ASKED}, but it sends {whole(sent)}" if sent else AS_ASKED
    return f"{AS_ENCODED}, more than its b_full of {short(b_full)}" if sent and sent > b_full else AS_ENCODED


@rule(needs=["demand"], gives=["total", "bitrate", "scaling"], reads=["copies", "manual", "on", "streams"])
def keep_operator_settings(vehicle: Vehicle, state: State, draft: Draft, memory: Memory) -> Step:
    """Mode S: each camera is sent as the operator has set it; the total is the resulting sum."""
    on = [name for name in vehicle.cameras if state.on[name]]
    bitrates = dict.fromkeys(vehicle.cameras, allocation.ZERO)
    bitrates |= {name: _as_set(vehicle, state, draft, name) for name in on}
    factors = {name: state.manual[name].scaling for name in on}
    reasons = {name: f"{int(bitrates[name])} kbit/s and {plain(factors[name])} as set in mode single" for name in on}
    for name in {*vehicle.fixed, *vehicle.lowest}.intersection(on):
        why = _as_encoded(vehicle, vehicle.cameras[name], state.streams.get(name))
        reasons[name] = f"{int(bitrates[name])} kbit/s, {why}"
    total = of_all_copies(state, bitrates)
    return draft.replaced(total=total, bitrate=bitrates, scaling=factors, reasons=reasons), memory


def _as_set(vehicle: Vehicle, state: State, draft: Draft, name: str) -> Kbps:
    return draft.demand[name] if name in vehicle.fixed else Kbps(state.manual[name].kbps)


def of_all_copies(state: State, kbps: Mapping[str, Kbps]) -> Kbps:
    """The sum over all copies that leave the vehicle."""
    return sum((own * state.copies.get(name, 1) for name, own in kbps.items()), allocation.ZERO)


def whole(bitrate: Kbps) -> int:
    """A bitrate rounded down."""
    return bitrate.numerator // bitrate.denominator
