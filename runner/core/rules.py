"""A mode is an ordered list of named rules; each adds to the draft of a decision.

A rule is a pure function `rule(vehicle, state, draft, memory, *, parameters) -> (draft, memory)`, registered by the
decorator `rule`, which declares what it needs from earlier rules, what it gives, and which state fields it reads.
Memory is frozen and keyed by rule; only rules that need history use it.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from enum import StrEnum
from fractions import Fraction
from functools import cache
from math import ceil, inf, isfinite, sqrt
from typing import Any

from runner.core import allocation, link_cap, scaling
from runner.core import belief as uplink_belief
from runner.core.belief import Belief
from runner.core.budget import video_kbps, wire_kbps
from runner.core.decision import Believed, Decision, Draft, Setting
from runner.core.events import LinkMeasured
from runner.core.evidence import Evidence
from runner.core.learned import WRONG
from runner.core.link_memory import LEAST, UNCAPPED, LinkCap
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
    # At the start, sizes are chosen for the larger total that follows.
    later = draft.sized_for / draft.total if draft.sized_for and draft.total else None
    factors, reasons = _scaled(vehicle, state.on, state.rois, draft.demand, draft.bitrate, later)
    return draft.replaced(scaling=factors, reasons=reasons), memory


@_Last
def _scaled(
    vehicle: Vehicle,
    on: Mapping[str, bool],
    rois: Mapping[str, Roi],
    demand: Mapping[str, Kbps],
    bitrate: Mapping[str, Kbps],
    later: Fraction | None,
) -> tuple[Mapping[str, Fraction], Mapping[str, str]]:
    """Factor and reason by camera. later: the total that follows, in multiples of the present one."""
    factors, reasons = {}, {}
    for name, camera in vehicle.cameras.items():
        if not on[name]:
            continue
        allocated, roi, full = bitrate[name], rois[name], camera.full_roi
        kbps, sized_for = _whole(allocated), allocated if later is None else allocated * later
        of_full = scaling.as_full_image(sized_for, roi, full)
        # A camera that cannot be sent gets the smallest factor, however few its pixels.
        factors[name], why = scaling.select_scaling(camera.rate_quality, of_full if kbps else allocation.ZERO)
        seen = ""
        if kbps and (later is not None or (roi is not full and roi != full)):
            seen = f", as {_whole(of_full)} for the full image" + ("" if later is None else " after the start")
        reasons[name] = f"{kbps} of {_short(demand[name])} kbit/s{seen}, {why}"
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
    """Mode S under a cap: Eq. (2) in proportion to what the operator has set, with floors as in `share_above_floors`.

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
            for kbps in (draft.bitrate[name], bitrates[name])
        )
        if fitted < asked and draft.sized_for is None:
            factors[name] = min(own, fitted)
        reasons[name] += f", sent with {_whole(bitrates[name])} kbit/s and {plain(factors[name])}"
    return draft.replaced(bitrate=bitrates, scaling=factors, reasons=reasons), memory


# --- responses to stale or lost inputs: modes=safe --------------------------------------------------------------------


@rule(needs=["total"], gives=["total"], reads=["prediction"])
def cap_at_lower_bound(vehicle: Vehicle, state: State, draft: Draft, memory: Memory) -> Step:
    """The total is at most the lower bound of the prediction, if it states one."""
    lower = None if state.prediction is None else state.prediction.lower_kbps
    assert draft.total is not None
    if lower is None or lower >= draft.total:
        return draft, memory
    note = f"total {_short(draft.total)} -> {_short(lower)}: lower bound of the prediction"
    return draft.noted(note, total=lower), memory


@rule(needs=["total"], gives=["total"], reads=["copies", "on", "prediction", "t"])
def fade_when_stale(
    vehicle: Vehicle,
    state: State,
    draft: Draft,
    memory: Memory,
    *,
    after_s: Fraction,
    halve_every_s: Fraction,
    floor_kbps: Kbps,
) -> Step:
    """A stale prediction is trusted less and less, unless the measured link replaces it (`cap_by_link`).

    Once it is older than its own `valid_s`, otherwise `after_s`, the total is halved, and again every `halve_every_s`,
    down to `floor_kbps`; never above the prediction. After a prediction of 0 it is `floor_kbps`, or less if the link is
    known to carry less: with nothing sent, it could never be measured. Before the first prediction, the age counts from
    the start of the run; the halvings count from when the link last replaced the prediction, if it did since.
    """
    age, limit = _age(state, after_s)
    assert draft.total is not None
    if age <= limit or draft.measured:
        return draft, memory
    overdue, cap = age - limit, memory.get("cap_by_link", UNCAPPED)
    if isfinite(cap.replaced):
        overdue = min(overdue, max(allocation.ZERO, exact(state.t) - exact(cap.replaced)))
    halvings = int(overdue / halve_every_s) + 1
    # 64 halvings are below any floor; more would only produce long fractions.
    cameras = sent_cameras(vehicle, state)
    is_nothing = draft.total < max(1, len(cameras))
    least = floor_kbps if is_nothing else min(floor_kbps, draft.total)
    uncapped = total = max(Fraction(draft.total) / 2 ** min(halvings, 64), least)
    if is_nothing and cap.kbps is not None:
        total = min(total, _tenths(video_kbps(cameras, _carried(cap, cameras))))
    why = f"no prediction for {float(age):.1f} s, limit {plain(limit)} s"
    note = f"total {_short(draft.total)} -> {_short(total)}: {why}"
    is_capped = draft.uncapped is not None or total < uncapped
    return draft.noted(note, total=total, uncapped=uncapped if is_capped else None), memory


@rule(
    needs=["total"],
    gives=["total"],
    reads=["copies", "link", "on", "operator_lost", "operator_since", "position", "prediction", "rois", "t", "weights"],
)
def cap_by_link(
    vehicle: Vehicle,
    state: State,
    draft: Draft,
    memory: Memory,
    *,
    reserve_kbps: Kbps = allocation.ZERO,
    alone_after_s: Fraction | None = None,
    least_trust: Fraction = Fraction(1),
    start: Fraction = Fraction(1),
) -> Step:
    """The total is at most what the uplink carries, as the operator's side measures it; see `runner.core.link_cap`.

    The measured link also carries packet headers, and `reserve_kbps` of it are left to other traffic. The operator
    measures its own copy of each camera; other copies that leave the vehicle carry the same bitrates. While there is
    nothing to send, nothing can be measured. A prediction older than its own `valid_s`, otherwise `alone_after_s`,
    is ignored while the link is measured: the total then follows the measurement alone. A prediction that repeatedly
    proved too high is trusted less, down to the share `least_trust`; trust recovers with time, and drops again at
    places where it dropped before; see `runner.core.trust`. When an operator connects, the total starts at the share
    `start` of the limit and recovers once the link has been measured.

    Memory: the cap, `LinkCap`.
    """
    assert draft.total is not None
    if state.link is None and "cap_by_link" not in memory and (start == 1 or state.operator_since is None):
        return draft, memory  # never measured
    cameras = sent_cameras(vehicle, state)
    limit, least = wire_kbps(cameras, draft.total), _least(cameras)
    cap = memory.get("cap_by_link", UNCAPPED)._replace(reserve=reserve_kbps)
    link = _of_all_copies(vehicle, state, draft, memory, cameras, limit)
    alone = alone_after_s is not None and _is_stale(state, alone_after_s) and link_cap.is_fresh(link, state.t)
    if not cameras or state.operator_lost is not None or (draft.total < max(1, len(cameras)) and not alone):
        cap = cap._replace(idle=state.t)  # silence now, or soon after, is no stall
    else:
        if alone:
            most = sum((camera.rate_quality.b_full for camera in cameras), allocation.ZERO)
            draft, asked, limit = draft.replaced(measured=True, total=most), limit, wire_kbps(cameras, most)
            cap = link_cap.probe(cap, state.t, link_cap.believed_limit(cap, asked, least_trust), limit)
        else:
            cap = cap._replace(alone=False)  # `follow` relates the known capacity to the limit
        cap = link_cap.follow(cap, limit, state.mode is Mode.AUTOMATIC and not alone)
        cap = link_cap.start_cap(cap, link, state.operator_since, limit, start)
        cap = cap._replace(floors=_capped_floors(vehicle, state, draft, cameras, reserve_kbps))
        cap = link_cap.update_cap(cap, link, state.t, limit, least_trust, state.position)
        cap = link_cap.raise_cap(cap, least)  # with less, some cameras would not be sent, and so not measured
    memory = {**memory, "cap_by_link": cap}
    carried = link_cap.believed_limit(cap, limit, least_trust)
    why = f"{float(cap.trust.share):.0%} of a prediction that proved too high"
    if cap.kbps is not None and cap.kbps - reserve_kbps < carried:
        carried, why = _carried(cap, cameras), _why_capped(cap)
    lowered = _lower_total(draft, video_kbps(cameras, carried), why)
    # A new size restarts the encoder, so sizes at the start are chosen for the time after it.
    return lowered.replaced(sized_for=lowered.uncapped) if cap.provisional else lowered, memory


FLOOR = Kbps(500)


class Ceiling(StrEnum):
    """What the total never exceeds, beside what the cameras can use."""

    NONE = "none"
    PREDICTION = "prediction"


@rule(
    needs=["total"],
    gives=["total"],
    reads=["copies", "link", "on", "operator_lost", "operator_since", "prediction", "rois", "t", "weights"],
)
def follow_link(
    vehicle: Vehicle,
    state: State,
    draft: Draft,
    memory: Memory,
    *,
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

    Without reports, a prediction is a limit that fades: once it is older than its own `valid_s`, otherwise `after_s`,
    the total is halved, and again every `halve_every_s`, down to `floor_kbps`.

    Memory: `Belief`.
    """
    assert draft.total is not None
    cameras = sent_cameras(vehicle, state)
    belief: Belief | None = memory.get("follow_link")
    link = state.link
    evidence = None if link is None else link.evidence
    is_measured = link is not None and state.t - link.t < link_cap.START_S
    if not cameras or state.operator_since is None or link is None or evidence is None or not is_measured:
        return _unmeasured(state, draft, start, after_s, halve_every_s, floor_kbps), memory
    predicted, bias, error = None, 0.0, WRONG
    most = float(wire_kbps(cameras, _of_all(state, _wanted(vehicle, state, draft))))
    if state.mode is Mode.AUTOMATIC and state.prediction is not None and not _is_stale(state, after_s):
        predicted = float(wire_kbps(cameras, state.prediction.kbps))
        bias = state.prediction.bias or 0.0
        error = WRONG if state.prediction.error is None else state.prediction.error
    if belief is None or belief.since != state.operator_since:
        first = float(wire_kbps(cameras, draft.total))
        belief = uplink_belief.begin(state.operator_since, first * float(start), most, predicted, bias, error)
    belief = uplink_belief.predict(belief._replace(most=most), state.t, predicted, bias, error)
    if link.t > belief.reported:
        belief = uplink_belief.observe(belief, link.t, _of_every_copy(state, evidence), (link.rtt_ms or 0.0) / 1000)
    limit = inf
    if state.mode is not Mode.AUTOMATIC or ceiling is Ceiling.PREDICTION:
        limit = float(wire_kbps(cameras, draft.total) + reserve_kbps)
    floors = float(_capped_floors(vehicle, state, draft, cameras, reserve_kbps))
    belief = uplink_belief.decide(belief, state.t, evidence.silent_s, floors, limit)
    carried = video_kbps(cameras, max(_least(cameras), exact(round(belief.total, 1)) - reserve_kbps))
    total = _tenths(min(carried, draft.total) if limit < inf else carried)
    memory = {**memory, "follow_link": belief}
    believed, before = _believed(belief, cameras), draft.total
    draft = draft.replaced(measured=True, believed=believed)
    if total == before:
        return draft, memory
    note = f"total {_short(before)} -> {_short(total)}: {_why_believed(believed, evidence)}"
    return draft.noted(note, total=total, uncapped=max(before, total)), memory


def _unmeasured(
    state: State,
    draft: Draft,
    start: Fraction,
    after_s: Fraction,
    halve_s: Fraction,
    floor: Kbps,
) -> Draft:
    """A prediction is a limit, at most its lower bound, that fades; an operator's total stays."""
    assert draft.total is not None
    before, why = draft.total, ""
    total = before
    if state.mode is Mode.AUTOMATIC:
        lower = None if state.prediction is None else state.prediction.lower_kbps
        if lower is not None and lower < total:
            total, why = lower, "lower bound of the prediction"
        age, limit = _age(state, after_s)
        if age > limit:
            halvings = min(64, int((age - limit) / halve_s) + 1)  # 64 are below any floor
            total = max(Fraction(total) / 2**halvings, min(floor, total) if total >= 1 else floor)
            why = f"no prediction for {float(age):.1f} s, limit {plain(limit)} s"
    if state.operator_since is not None and state.t - state.operator_since < link_cap.START_S and start < 1:
        draft = draft.replaced(sized_for=total)
        total, why = total * start, "the link has not been measured yet"
    if total == before:
        return draft
    return draft.noted(f"total {_short(before)} -> {_short(total)}: {why}", total=_tenths(total), uncapped=before)


def _believed(belief: Belief, cameras: tuple[Camera, ...]) -> Believed:
    """As it is stated: for video, rounded."""
    learned, policer = belief.learned, belief.policer

    def video(wire: float) -> int:
        return int(video_kbps(cameras, Fraction(int(wire))))

    is_level_known = learned.ln is not None and learned.is_level_known
    return Believed(
        kbps=video(belief.kbps),
        deviation=round(sqrt(belief.v), 2),
        margin=round(belief.margin, 2),
        bias=round(learned.bias, 2) if is_level_known else None,
        error=round(sqrt(learned.error), 2) if is_level_known else None,
        gain=round(learned.gain, 2) if learned.ln is not None and learned.is_gain_known else None,
        policer_kbps=video(policer.kbps) if policer.proven else None,
    )


def _why_believed(believed: Believed, evidence: Evidence) -> str:
    if evidence.silent_s:
        return f"nothing has arrived for {evidence.silent_s:.1f} s"
    if believed.policer_kbps is not None and believed.policer_kbps < believed.kbps:
        return f"the link drops what exceeds {believed.policer_kbps}"
    return f"capacity of the link, believed to be {believed.kbps}"


def _of_every_copy(state: State, evidence: Evidence) -> Evidence:
    """The operator measures one copy of each camera."""
    if not state.copies:
        return evidence
    # All copies carry the same, so that a number of copies for each kbit is enough.
    names = [name for name, on in state.on.items() if on]
    ratio = sum(state.copies.get(name, 1) for name in names) / max(1, len(names))
    return evidence._replace(
        busy_kbit=ratio * evidence.busy_kbit,
        train_kbit=ratio * evidence.train_kbit,
        idle_kbit=ratio * evidence.idle_kbit,
        kbit=ratio * evidence.kbit,
        lost_kbit=ratio * evidence.lost_kbit,
    )


def sent_cameras(vehicle: Vehicle, state: State) -> tuple[Camera, ...]:
    """The cameras that are on, with repetitions for those that leave the vehicle in several copies."""
    mounted = vehicle.cameras.items()
    return tuple(c for name, c in mounted if state.on[name] for _ in range(state.copies.get(name, 1)))


def _least(cameras: tuple[Camera, ...]) -> Kbps:
    """kbit/s on the wire with which all cameras are sent, and so measured."""
    return wire_kbps(cameras, max(LEAST, Fraction(len(cameras))))


def _carried(cap: LinkCap, cameras: tuple[Camera, ...]) -> Kbps:
    """kbit/s on the wire under a cap in force."""
    assert cap.kbps is not None
    return max(_least(cameras), cap.kbps - cap.reserve)


def _wanted(vehicle: Vehicle, state: State, draft: Draft) -> Mapping[str, Kbps]:
    """The most that each camera will get, kbit/s: in mode S what the operator has set, otherwise Eq. (1)."""
    return draft.bitrate or draft.demand or _demands(vehicle, state)


def _capped_floors(vehicle: Vehicle, state: State, draft: Draft, cameras: tuple[Camera, ...], reserve: Kbps) -> Kbps:
    """The cap, in tenths of a kbit/s, that leaves the floors of all cameras that are never given up; 0: no floors.

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


def _why_capped(cap: LinkCap) -> str:
    if cap.measured < cap.connected:
        return "the link has not been measured yet"
    return "nothing arrives" if cap.stall else "measured capacity of the link"


def _lower_total(draft: Draft, total: Kbps, why: str) -> Draft:
    """The draft with a smaller total, in tenths of a kbit/s; unchanged if it would not be smaller."""
    assert draft.total is not None
    if total >= draft.total:
        return draft
    total = _tenths(total)
    return draft.noted(f"total {_short(draft.total)} -> {_short(total)}: {why}", total=total, uncapped=draft.total)


def _tenths(kbps: Kbps) -> Kbps:
    return Fraction(int(10 * kbps), 10)


def _of_all_copies(
    vehicle: Vehicle, state: State, draft: Draft, memory: Memory, cameras: tuple[Camera, ...], limit: Kbps
) -> LinkMeasured | None:
    """The measurement of one copy of each camera, scaled to all copies that leave the vehicle.

    kbps is None if all cameras are given up, so that nothing can arrive.

    cameras  that are on, with repetitions for copies
    limit    kbit/s on the wire, until the link has been measured under one
    """
    link = state.link
    if link is None or link.kbps is None:
        return link
    if link.kbps == 0 and not any(_sent_wanted(vehicle, state, draft, memory).values()):
        return replace(link, kbps=None)  # nothing arrives because all cameras are given up: the cap has to grow
    if not state.copies:
        return link
    cap, wanted = memory.get("cap_by_link", UNCAPPED), _sent_wanted(vehicle, state, draft, memory)
    total = video_kbps(cameras, cap.may_send(cap.limit.kbps or limit))
    fits = state.mode is Mode.SINGLE and total >= _of_all(state, wanted)
    sent = wanted if fits else _shared(vehicle, state, wanted, total)
    if not (of_one := sum(sent.values())):
        return link
    return replace(link, kbps=_tenths(link.kbps * _of_all(state, sent) / of_one))


def _of_all(state: State, kbps: Mapping[str, Kbps]) -> Kbps:
    """The sum over all copies that leave the vehicle."""
    return sum((own * state.copies.get(name, 1) for name, own in kbps.items()), allocation.ZERO)


def _sent_wanted(vehicle: Vehicle, state: State, draft: Draft, memory: Memory) -> Mapping[str, Kbps]:
    """As `_wanted`, without the cameras that the last decision gave up."""
    given_up = memory.get("fit_to_total" if state.mode is Mode.SINGLE else "share_above_floors", ())
    return _without(given_up, _wanted(vehicle, state, draft))


def _is_stale(state: State, after_s: Fraction) -> bool:
    """Whether the prediction (before the first one, the run) is older than its own `valid_s`, otherwise `after_s`."""
    age, limit = _age(state, after_s)
    return age > limit


def _age(state: State, after_s: Fraction) -> tuple[Fraction, Fraction]:
    """Age of the prediction, s, and how old it may be."""
    made = state.prediction
    limit = after_s if made is None or made.valid_s is None else exact(made.valid_s)
    return exact(state.t) - (exact(made.t) if made else 0), limit


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
    """As `hold_upscaling`, while the measured link caps the total: its rate is being probed, and new sizes cost bits.

    Memory: as there; empty while nothing caps the total.
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
    unmeasured = {name: past for name, past in memory.items() if name != cap_by_link.__name__}
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


def _short(bitrate: Kbps) -> int | str:
    return bitrate.numerator if bitrate.denominator == 1 else f"{float(bitrate):.1f}"
