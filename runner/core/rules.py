"""A mode is an ordered list of named rules; each adds to the draft of a decision.

A rule is a pure function `rule(vehicle, state, draft, memory, *, parameters) -> (draft, memory)`, registered by the
decorator `rule`, which declares what it needs from earlier rules, what it gives, and which state fields it reads.
Memory is frozen and keyed by rule; only rules that need history use it.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from fractions import Fraction
from functools import cache
from math import ceil, inf
from typing import Any

from runner.core import allocation, scaling
from runner.core import follow_link as follow
from runner.core.belief import LOWEST, Belief
from runner.core.budget import video_kbps, wire_kbps
from runner.core.decision import Decision, Draft, Setting, short
from runner.core.follow_link import FLOOR, Ceiling, Reports
from runner.core.model import Camera, Kbps, Mode, Roi, Vehicle, exact, least_float, plain
from runner.core.state import State
from runner.errors import RunError

Memory = Mapping[str, Any]
Step = tuple[Draft, Memory]

BITRATE_RULE = "must be kbit/s from 0 as an exact number (int or Fraction)"
FACTOR_RULE = "must be a Fraction in ]0, 1]"
GIVEN = ("total", "demand", "bitrate", "scaling")  # parts that a mode's rules must give together


class RuleFailed(RunError):
    """A rule raised an exception or gave a value that cannot be used; the text names rule and value."""


@dataclass(frozen=True, slots=True)
class Rule:
    """A rule and what it declares about itself.

    needs  parts of the draft that earlier rules must have given
    gives  parts of the draft that exist after it
    reads  fields of the state whose change triggers a new decision
    """

    name: str
    function: Callable[..., Step]
    needs: frozenset[str]
    gives: frozenset[str]
    reads: frozenset[str]

    @property
    def parameters(self) -> Mapping[str, inspect.Parameter]:
        every = inspect.signature(self.function).parameters
        return {name: p for name, p in every.items() if p.kind is inspect.Parameter.KEYWORD_ONLY}


@dataclass(frozen=True, slots=True)
class RuleCall:
    """A rule with its parameters from a modes file."""

    rule: Rule
    parameters: Mapping[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        return self.rule.name

    @property
    def reads(self) -> frozenset[str]:
        return self.rule.reads

    def __call__(self, vehicle: Vehicle, state: State, draft: Draft, memory: Memory) -> Step:
        return self.rule.function(vehicle, state, draft, memory, **self.parameters)


RULES: dict[str, Rule] = {}


EVERYTHING = frozenset(part.name for part in fields(State))


def rule(
    *, needs: Iterable[str] = (), gives: Iterable[str] = (), reads: Iterable[str] = EVERYTHING
) -> Callable[[Callable[..., Step]], Callable[..., Step]]:
    """Register a function as a rule under its own name.

    reads   fields of the state that the rule depends on; default: all, so that any change triggers a new decision
    raises  ValueError if `reads` names something other than a field of the state: the rule would miss its changes
    """
    read = frozenset(reads)
    if unknown := sorted(read - EVERYTHING):
        raise ValueError(
            f"reads: {', '.join(unknown)}: unknown; expected fields of State: {', '.join(sorted(EVERYTHING))}"
        )

    def register(function: Callable[..., Step]) -> Callable[..., Step]:
        name = function.__name__
        RULES[name] = Rule(name, function, frozenset(needs), frozenset(gives), read)
        return function

    return register


class _Last:
    """A pure function that remembers its last result: most events leave its arguments as they were."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function
        self._last: tuple[tuple[Any, ...], Any] = ((), None)

    def __call__(self, *arguments: Any) -> Any:
        before, result = self._last  # one object, in case several threads decide
        if arguments != before:
            result = self._function(*arguments)
            self._last = (arguments, result)
        return result


_allocated = _Last(allocation.allocate_above_floors)


# --- the paper's rules ------------------------------------------------------------------------------------------------


@rule(gives=["total"], reads=["prediction"])
def total_from_prediction(vehicle: Vehicle, state: State, draft: Draft, memory: Memory, *, start_kbps: Kbps) -> Step:
    """Mode A: the total is the last prediction of pQoS; `start_kbps` until the first one arrives."""
    return draft.replaced(total=start_kbps if state.prediction is None else state.prediction.kbps), memory


@rule(gives=["total"], reads=["collective_total"])
def total_from_operator(vehicle: Vehicle, state: State, draft: Draft, memory: Memory, *, start_kbps: Kbps) -> Step:
    """Mode C: the total is the operator's; `start_kbps` if a run starts in C and none was set yet."""
    return draft.replaced(total=start_kbps if state.collective_total is None else state.collective_total), memory


@rule(gives=["total"], reads=[])
def total_fixed(vehicle: Vehicle, state: State, draft: Draft, memory: Memory, *, kbps: Kbps) -> Step:
    """The total is a constant, independent of the prediction; for comparison."""
    return draft.replaced(total=kbps), memory


@rule(gives=["demand"], reads=["on", "rois"])
def demand_from_roi(vehicle: Vehicle, state: State, draft: Draft, memory: Memory) -> Step:
    """Eq. (1): each camera that is on asks in proportion to the pixels of its ROI."""
    return draft.replaced(demand=_demands(vehicle, state)), memory


def _demands(vehicle: Vehicle, state: State) -> dict[str, Kbps]:
    """kbit/s by camera, Eq. (1); 0 when off."""
    return {
        name: allocation.demand(camera.rate_quality.b_full, state.rois[name], camera.full_roi)
        if state.on[name]
        else allocation.ZERO
        for name, camera in vehicle.cameras.items()
    }


@rule(needs=["total", "demand"], gives=["bitrate"], reads=["weights"])
def share_by_demand(vehicle: Vehicle, state: State, draft: Draft, memory: Memory) -> Step:
    """Eq. (2): the total is shared in proportion to demand times weight, no camera gets more than its demand."""
    assert draft.total is not None
    return draft.replaced(bitrate=allocation.allocate(draft.demand, draft.total, state.weights)), memory


@rule(needs=["total", "demand"], gives=["bitrate"], reads=["copies", "weights"])
def share_above_floors(vehicle: Vehicle, state: State, draft: Draft, memory: Memory) -> Step:
    """As `share_by_demand`, but each camera first gets its `floor_kbps`; those with `shed` are given up first.

    Memory: the cameras given up.
    """
    total = draft.total
    assert total is not None
    draft, given_up, memory = _give_up(vehicle, state, draft, draft.demand, memory, "share_above_floors")
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
    vehicle: Vehicle, state: State, draft: Draft, wanted: Mapping[str, Kbps], memory: Memory, key: str
) -> tuple[Draft, tuple[str, ...], Memory]:
    """The draft with a note of the cameras given up for the floors of others, these cameras, and the memory with them.

    key  of the memory, where they are kept
    """
    before: tuple[str, ...] = memory.get(key, ())
    given_up: tuple[str, ...] = ()
    if order := _shed_order(vehicle):
        assert draft.total is not None
        floors = {name: floor * state.copies.get(name, 1) for name, floor in _floors(vehicle).items()}
        of_all = {name: own * state.copies.get(name, 1) for name, own in wanted.items()}
        given_up = allocation.shed(of_all, draft.total, floors, order, before)
    if given_up != before:
        memory = {**memory, key: given_up}
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


@rule(needs=["total", "demand"], gives=["bitrate"], reads=["weights"])
def share_equally(vehicle: Vehicle, state: State, draft: Draft, memory: Memory) -> Step:
    """Each camera that is on gets the same, times its weight, but no more than its demand; for comparison."""
    assert draft.total is not None
    # Eq. (2) shares in proportion to weight times demand; this cancels the demand.
    wanted = {name: demand for name, demand in draft.demand.items() if demand}
    weights = {name: state.weights[name] / wanted.get(name, 1) for name in draft.demand}
    return draft.replaced(bitrate=allocation.allocate(draft.demand, draft.total, weights)), memory


@rule(needs=["bitrate"], gives=["scaling"], reads=["rois"])
def scaling_from_rate_quality(vehicle: Vehicle, state: State, draft: Draft, memory: Memory) -> Step:
    """Eq. (4): the factor whose bitrate range contains the allocation, converted to the full image."""
    factors, reasons = _scaled(vehicle, state.on, state.rois, draft.demand, draft.bitrate, _lasting(draft))
    return draft.replaced(scaling=factors, reasons=reasons), memory


def _lasting(draft: Draft) -> Fraction | None:
    """The total for which sizes are chosen, in multiples of the present one; None: that one."""
    return draft.sized_for / draft.total if draft.sized_for and draft.total else None


@_Last
def _scaled(
    vehicle: Vehicle,
    on: Mapping[str, bool],
    rois: Mapping[str, Roi],
    demand: Mapping[str, Kbps],
    bitrate: Mapping[str, Kbps],
    lasting: Fraction | None,
) -> tuple[Mapping[str, Fraction], Mapping[str, str]]:
    """Factor and reason by camera. lasting: see `_lasting`."""
    factors, reasons = {}, {}
    for name, camera in vehicle.cameras.items():
        if not on[name]:
            continue
        allocated, roi, full = bitrate[name], rois[name], camera.full_roi
        kbps, sized_for = _whole(allocated), allocated if lasting is None else allocated * lasting
        of_full = scaling.as_full_image(sized_for, roi, full)
        # A camera that cannot be sent gets the smallest factor, however few its pixels.
        factors[name], why = scaling.select_scaling(camera.rate_quality, of_full if kbps else allocation.ZERO)
        seen = ""
        if kbps and (lasting is not None or (roi is not full and roi != full)):
            lasts = "" if lasting is None else " at the total that lasts"
            seen = f", as {_whole(of_full)} for the full image{lasts}"
        reasons[name] = f"{kbps} of {short(demand[name])} kbit/s{seen}, {why}"
    return factors, reasons


@rule(needs=["demand"], gives=["total", "bitrate", "scaling"], reads=["copies", "manual", "on"])
def keep_operator_settings(vehicle: Vehicle, state: State, draft: Draft, memory: Memory) -> Step:
    """Mode S: each camera is sent as the operator has set it; the total is the resulting sum."""
    on = [name for name in vehicle.cameras if state.on[name]]
    bitrates = {name: Kbps(state.manual[name].kbps) if name in on else allocation.ZERO for name in vehicle.cameras}
    factors = {name: state.manual[name].scaling for name in on}
    reasons = {name: f"{int(bitrates[name])} kbit/s and {plain(factors[name])} as set in mode single" for name in on}
    total = _of_all(state, bitrates)
    return draft.replaced(total=total, bitrate=bitrates, scaling=factors, reasons=reasons), memory


@rule(needs=["total", "bitrate", "scaling"], gives=["bitrate", "scaling"], reads=["copies", "rois", "weights"])
def fit_to_total(vehicle: Vehicle, state: State, draft: Draft, memory: Memory) -> Step:
    """Mode S with less: Eq. (2) in proportion to what the operator has set, with floors as in `share_above_floors`.

    Where the bitrate falls into a lower range of Eq. (4), the factor falls with it, never above the operator's own.
    The operator's settings are kept, and apply again once the total allows.

    Memory: the cameras given up.
    """
    total = draft.total
    assert total is not None
    if total >= _of_all(state, draft.bitrate):
        return draft, {**memory, "fit_to_total": ()} if memory.get("fit_to_total") else memory
    draft, given_up, memory = _give_up(vehicle, state, draft, draft.bitrate, memory, "fit_to_total")
    bitrates = _shared(vehicle, state, _without(given_up, draft.bitrate), total)
    factors, reasons = dict(draft.scaling), dict(draft.reasons)
    for name, own in factors.items():
        camera, roi = vehicle.cameras[name], state.rois[name]
        asked, fitted = (
            scaling.select_scaling(camera.rate_quality, scaling.as_full_image(kbps, roi, camera.full_roi))[0]
            for kbps in (draft.bitrate[name], bitrates[name] * (_lasting(draft) or 1))
        )
        if fitted < asked:
            factors[name] = min(own, fitted)
        reasons[name] += f", sent with {_whole(bitrates[name])} kbit/s and {plain(factors[name])}"
    return draft.replaced(bitrate=bitrates, scaling=factors, reasons=reasons), memory


# --- responses to stale or lost inputs: modes=safe --------------------------------------------------------------------


@rule(
    needs=["total"],
    gives=["total"],
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
    past: Belief | None = memory.get("follow_link")
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
        most=float(wire_kbps(cameras, _of_all(state, _wanted(vehicle, state, draft)))),
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
    return draft, {**memory, "follow_link": belief}


def sent_cameras(vehicle: Vehicle, state: State) -> tuple[Camera, ...]:
    """The cameras that are on, with repetitions for those that leave the vehicle in several copies."""
    mounted = vehicle.cameras.items()
    return tuple(c for name, c in mounted if state.on[name] for _ in range(state.copies.get(name, 1)))


def _wanted(vehicle: Vehicle, state: State, draft: Draft) -> Mapping[str, Kbps]:
    """The most that each camera will get, kbit/s: in mode S what the operator has set, otherwise Eq. (1)."""
    return draft.bitrate or draft.demand or _demands(vehicle, state)


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


def _of_all(state: State, kbps: Mapping[str, Kbps]) -> Kbps:
    """The sum over all copies that leave the vehicle."""
    return sum((own * state.copies.get(name, 1) for name, own in kbps.items()), allocation.ZERO)


@rule(reads=["operator_lost", "t"])
def pause_without_operator(vehicle: Vehicle, state: State, draft: Draft, memory: Memory, *, after_s: Fraction) -> Step:
    """Nothing is sent while the operator's side has been gone for over `after_s`; sending resumes on its return."""
    lost = state.operator_lost
    if lost is None or state.t - lost <= after_s:
        return draft, memory
    return draft.noted(f"not sending: operator gone for {state.t - lost:.1f} s", sending=False), memory


# --- calmer pictures: modes=steady ------------------------------------------------------------------------------------


@rule(needs=["scaling"], gives=["scaling"], reads=["t"])
def hold_upscaling(vehicle: Vehicle, state: State, draft: Draft, memory: Memory, *, for_s: Fraction) -> Step:
    """A larger factor is applied only after it has been requested continuously for `for_s`; a smaller one immediately.

    Memory: by camera, the factor in force and since when a larger one has been requested (None: it is not).
    """
    draft, held = _hold_back(state, draft, memory.get("hold_upscaling", {}), for_s)
    return draft, {**memory, "hold_upscaling": held}


@rule(needs=["scaling"], gives=["scaling"], reads=["t"])
def hold_while_capped(vehicle: Vehicle, state: State, draft: Draft, memory: Memory, *, for_s: Fraction) -> Step:
    """As `hold_upscaling`, while the measured link sets the total: its rate is being probed, and new sizes cost bits.

    Memory: as there; empty while it does not.
    """
    past: Mapping[str, _Hold] = memory.get("hold_while_capped", {})
    if draft.uncapped is None:
        return draft, {**memory, "hold_while_capped": {}} if past else memory
    draft, held = _hold_back(state, draft, past, for_s)
    return draft, {**memory, "hold_while_capped": held}


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


# --- running a list ---------------------------------------------------------------------------------------------------


def decide(vehicle: Vehicle, state: State, memory: Memory) -> tuple[Decision, Memory]:
    """Pure core of the runner: run the rules of the mode in force, in order.

    To the rules, a camera that is lost is off: the others get its share.

    raises  RuleFailed, since rules may be the user's own
    """
    draft, asked = Draft(), None
    seen = replace(state, on={**state.on, **dict.fromkeys(state.lost, False)}) if state.lost else state
    for call in vehicle.modes[state.mode]:
        before = draft
        try:
            draft, memory = call(vehicle, seen, draft, memory)
        except (Exception, SystemExit) as error:
            raise RuleFailed(f"rule {call.name} failed: {type(error).__name__}: {error}") from error
        if problem := _draft_problem(seen, before, draft):
            raise RuleFailed(f"rule {call.name} failed: {problem}")
        asked = draft.total if asked is None else asked
    assert draft.total is not None and asked is not None
    settings = _settings(
        vehicle,
        state.on,
        state.lost,
        state.rois,
        draft._replace(total=None, uncapped=None, measured=False, believed=None),
    )
    # Without a prediction there is only the measurement, so the total without it is unknown.
    uncapped = draft.total if draft.uncapped is None or draft.measured else draft.uncapped
    return Decision(state.mode, draft.total, settings, asked, uncapped, draft.believed), memory


def decide_without_link(vehicle: Vehicle, state: State, memory: Memory) -> Decision:
    """What the rules would decide if no operator measured the uplink.

    raises  RuleFailed
    """
    unmeasured = {name: past for name, past in memory.items() if name != follow_link.__name__}
    return decide(vehicle, replace(state, link=None, operator_since=None), unmeasured)[0]


def _draft_problem(state: State, before: Draft, draft: Any) -> str | None:
    """Why the parts of the draft that a rule has changed cannot be used; None if they can."""
    if not isinstance(draft, Draft):
        return "it must return a Draft and the memory"
    if draft is before:
        return None
    if draft.total is not before.total and not _is_bitrate(draft.total):
        return f"total {draft.total!r}: {BITRATE_RULE}"
    for part, fits, expected in PARTS:
        values = getattr(draft, part)
        if values is getattr(before, part):
            continue
        if not isinstance(values, Mapping):
            return f"{part} {values!r}: must be a mapping by camera"
        if values.keys() == state.on.keys() and all(map(fits, values.values())):
            continue
        for name, on in state.on.items():
            if on and not fits(values.get(name)):
                return f"{part} of {name} {values.get(name)!r}: {expected}"
    return None


def _is_bitrate(value: Any) -> bool:
    """A float is rejected even if it is whole: rounding noise must never decide a bitrate on a bound."""
    return type(value) in (Fraction, int) and value.numerator >= 0  # comparing fractions is slow


def _is_factor(value: Any) -> bool:
    return type(value) is Fraction and 0 < value.numerator <= value.denominator


# Parts of a draft by camera, the check of their values, and its description.
PARTS = (
    ("demand", _is_bitrate, BITRATE_RULE),
    ("bitrate", _is_bitrate, BITRATE_RULE),
    ("scaling", _is_factor, FACTOR_RULE),
)


@cache
def reads(vehicle: Vehicle, mode: Mode) -> frozenset[str]:
    """Fields of the state whose change triggers a new decision."""
    return frozenset({"mode", "on", "lost", "rois"}).union(*(call.reads for call in vehicle.modes[mode]))


@_Last
def _settings(
    vehicle: Vehicle, on: Mapping[str, bool], lost: Mapping[str, str], rois: Mapping[str, Roi], draft: Draft
) -> Mapping[str, Setting]:
    return {name: _setting(on[name], lost.get(name), rois[name], draft, name) for name in vehicle.cameras}


def _setting(on: bool, lost: str | None, roi: Roi, draft: Draft, name: str) -> Setting:
    if not on or lost is not None:
        why = f"lost: {lost}" if on else "switched off"
        return Setting(on, False, allocation.ZERO, 0, 0, None, roi, 0, 0, why)
    kbps, factor = _whole(draft.bitrate[name]), draft.scaling[name]
    sending = draft.sending and kbps >= 1
    width, height = scaling.output_size(roi, factor)
    reason = draft.reasons.get(name, "")
    if draft.sending and not sending:
        reason += ", below 1 kbit/s: not sending"
    if draft.notes:
        reason = "; ".join((reason, *draft.notes))
    return Setting(True, sending, draft.demand[name], kbps if sending else 0, kbps, factor, roi, width, height, reason)


def _is_at_most(factor: Fraction, bound: Fraction) -> bool:
    """As `factor <= bound`, which is slower."""
    return factor.numerator * bound.denominator <= bound.numerator * factor.denominator


def _whole(bitrate: Kbps) -> int:
    """A bitrate rounded down."""
    return bitrate.numerator // bitrate.denominator
