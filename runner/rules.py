"""A mode is an ordered list of named rules; each takes the draft of a decision one step further.

A rule is a pure function `rule(vehicle, state, draft, memory, *, parameters) -> (draft, memory)`, made known by the
decorator `rule`, which states what it needs from earlier rules, what it gives, and which fields of the state it reads.
Memory is frozen and keyed by rule; only rules that need a past touch it. Rules of other packages are found by the
entry point group `tod_runner.rules`.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cache
from typing import Any

from runner import allocation, scaling
from runner.decision import Decision, Draft, Setting
from runner.model import Kbps, Mode, ModelError, Vehicle, exact, plain, suggest
from runner.state import State

Memory = Mapping[str, Any]
Step = tuple[Draft, Memory]

GIVEN = ("total", "demand", "bitrate", "scaling")  # what the rules of a mode must have given at its end


@dataclass(frozen=True, slots=True)
class Rule:
    """A rule and what it states about itself.

    needs  parts of the draft that earlier rules must have given
    gives  parts of the draft that are there after it
    reads  fields of the state whose change makes the mode decide again
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
    """A rule with the parameters that a modes file gives it."""

    rule: Rule
    parameters: Mapping[str, Any] = field(default_factory=dict)

    def __call__(self, vehicle: Vehicle, state: State, draft: Draft, memory: Memory) -> Step:
        return self.rule.function(vehicle, state, draft, memory, **self.parameters)


RULES: dict[str, Rule] = {}


def rule(
    *, needs: Iterable[str] = (), gives: Iterable[str] = (), reads: Iterable[str] = ()
) -> Callable[[Callable[..., Step]], Callable[..., Step]]:
    """Make a function known as a rule under its own name."""

    def register(function: Callable[..., Step]) -> Callable[..., Step]:
        name = function.__name__
        RULES[name] = Rule(name, function, frozenset(needs), frozenset(gives), frozenset(reads))
        return function

    return register


# --- the paper's rules ------------------------------------------------------------------------------------------------


@rule(gives=["total"], reads=["prediction"])
def total_from_prediction(vehicle: Vehicle, state: State, draft: Draft, memory: Memory, *, start_kbps: Kbps) -> Step:
    """Mode A: the total is the last prediction of pQoS; `start_kbps` until the first one comes."""
    return draft.but(total=start_kbps if state.prediction is None else state.prediction.kbps), memory


@rule(gives=["total"], reads=["collective_total"])
def total_from_operator(vehicle: Vehicle, state: State, draft: Draft, memory: Memory, *, start_kbps: Kbps) -> Step:
    """Mode C: the total is the operator's; `start_kbps` where a run starts in C and none was set yet."""
    return draft.but(total=start_kbps if state.collective_total is None else state.collective_total), memory


@rule(gives=["total"])
def total_fixed(vehicle: Vehicle, state: State, draft: Draft, memory: Memory, *, kbps: Kbps) -> Step:
    """The total is what the file says, whatever is predicted: for comparison."""
    return draft.but(total=kbps), memory


@rule(gives=["demand"], reads=["on", "rois"])
def demand_from_roi(vehicle: Vehicle, state: State, draft: Draft, memory: Memory) -> Step:
    """Eq. (1): each camera that is on asks in proportion to the pixels of its ROI."""
    demands = {
        name: allocation.demand(camera.rate_quality.b_full, state.rois[name], camera.full_roi)
        if state.on[name]
        else allocation.ZERO
        for name, camera in vehicle.cameras.items()
    }
    return draft.but(demand=demands), memory


@rule(needs=["total", "demand"], gives=["bitrate"], reads=["weights"])
def share_by_demand(vehicle: Vehicle, state: State, draft: Draft, memory: Memory) -> Step:
    """Eq. (2): the total is shared in proportion to demand times weight, nobody gets more than the demand."""
    assert draft.total is not None
    return draft.but(bitrate=allocation.allocate(draft.demand, draft.total, state.weights)), memory


@rule(needs=["total", "demand"], gives=["bitrate"], reads=["weights"])
def share_equally(vehicle: Vehicle, state: State, draft: Draft, memory: Memory) -> Step:
    """Each camera that is on gets the same, times its weight, and nobody more than the demand: for comparison."""
    assert draft.total is not None
    # Eq. (2) shares in proportion to weight times demand; this takes the demand out of it.
    wanted = {name: demand for name, demand in draft.demand.items() if demand}
    weights = {name: state.weights[name] / wanted.get(name, 1) for name in draft.demand}
    return draft.but(bitrate=allocation.allocate(draft.demand, draft.total, weights)), memory


@rule(needs=["bitrate"], gives=["scaling"], reads=["rois"])
def scaling_from_rate_quality(vehicle: Vehicle, state: State, draft: Draft, memory: Memory) -> Step:
    """Eq. (4): the factor whose bitrate range the allocation, seen as for the full image, falls into."""
    factors, reasons = {}, {}
    for name, camera in vehicle.cameras.items():
        if not state.on[name]:
            continue
        model, roi, full = camera.rate_quality, state.rois[name], camera.full_roi
        bitrate = scaling.as_full_image(draft.bitrate[name], roi, full)
        # What cannot be sent is not a picture to look at: however few its pixels, the smallest factor.
        nothing = draft.bitrate[name] < 1
        r = 0 if nothing else scaling.select_range(model, bitrate)
        factors[name] = model.scaling[r]
        seen = "" if nothing or roi == full else f", as {int(bitrate)} for the full image"
        reasons[name] = f"{int(draft.bitrate[name])} of {_short(draft.demand[name])} kbit/s{seen}, {model.ranges[r]}"
    return draft.but(scaling=factors, reasons=reasons), memory


@rule(needs=["demand"], gives=["total", "bitrate", "scaling"], reads=["manual", "on"])
def keep_operator_settings(vehicle: Vehicle, state: State, draft: Draft, memory: Memory) -> Step:
    """Mode S: each camera is sent as the operator has set it; the total is what that comes to."""
    on = [name for name in vehicle.cameras if state.on[name]]
    bitrates = {name: Kbps(state.manual[name].kbps) if name in on else allocation.ZERO for name in vehicle.cameras}
    factors = {name: state.manual[name].scaling for name in on}
    reasons = {name: f"{int(bitrates[name])} kbit/s and {plain(factors[name])} as set in mode single" for name in on}
    total = sum(bitrates.values(), allocation.ZERO)
    return draft.but(total=total, bitrate=bitrates, scaling=factors, reasons=reasons), memory


# --- answers to inputs that are stale or lost: modes=safe -------------------------------------------------------------


@rule(needs=["total"], gives=["total"], reads=["prediction"])
def cap_at_lower_bound(vehicle: Vehicle, state: State, draft: Draft, memory: Memory) -> Step:
    """The total is at most what the prediction says the bitrate will hardly fall below, where it says so."""
    lower = None if state.prediction is None else state.prediction.lower_kbps
    assert draft.total is not None
    if lower is None or lower >= draft.total:
        return draft, memory
    note = f"total {_short(draft.total)} -> {_short(lower)}: lower bound of the prediction"
    return draft.noted(note, total=lower), memory


@rule(needs=["total"], gives=["total"], reads=["prediction", "t"])
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
    """A prediction that is too old is trusted less and less.

    Older than its own `valid_s`, else than `after_s`, the total is halved, and again every `halve_every_s`, down to
    `floor_kbps`; never above the prediction. Where none has come yet, the age counts from the start of the run.
    """
    made = state.prediction
    limit = after_s if made is None or made.valid_s is None else exact(made.valid_s)
    age = exact(state.t) - (exact(made.t) if made else 0)
    assert draft.total is not None
    if age <= limit:
        return draft, memory
    halvings = int((age - limit) / halve_every_s) + 1
    # 64 halvings are below any floor; more would only make the numbers long.
    total = max(draft.total / 2 ** min(halvings, 64), min(floor_kbps, draft.total))
    why = f"no prediction for {float(age):.1f} s, limit {plain(limit)} s"
    note = f"total {_short(draft.total)} -> {_short(total)}: {why}"
    return draft.noted(note, total=total), memory


@rule(reads=["operator_lost", "t"])
def pause_without_operator(vehicle: Vehicle, state: State, draft: Draft, memory: Memory, *, after_s: Fraction) -> Step:
    """Nothing is sent while the operator's side has been gone for longer than `after_s`; it resumes with its return."""
    lost = state.operator_lost
    if lost is None or state.t - lost <= after_s:
        return draft, memory
    return draft.noted(f"not sending: operator gone for {state.t - lost:.1f} s", sending=False), memory


# --- calmer pictures: modes=steady ------------------------------------------------------------------------------------


@rule(needs=["scaling"], gives=["scaling"], reads=["t"])
def hold_upscaling(vehicle: Vehicle, state: State, draft: Draft, memory: Memory, *, for_s: Fraction) -> Step:
    """A greater factor is taken only after it has been called for without a break for `for_s`; a smaller one at once.

    Memory: by camera, the factor in force and since when a greater one is called for (None: it is not).
    """
    past: Mapping[str, tuple[Fraction, float | None]] = memory.get("hold_upscaling", {})
    now: dict[str, tuple[Fraction, float | None]] = {}
    factors, reasons = dict(draft.scaling), dict(draft.reasons)
    for name, called_for in draft.scaling.items():
        held, since = past.get(name, (called_for, None))
        if called_for <= held:
            now[name] = (called_for, None)
            continue
        since = state.t if since is None else since
        if state.t - since >= for_s:
            now[name] = (called_for, None)
        else:
            now[name] = (held, since)
            factors[name] = held
            reasons[name] += f", held at {plain(held)} until it has been so for {plain(for_s)} s"
    return draft.but(scaling=factors, reasons=reasons), {**memory, "hold_upscaling": now}


# --- running a list ---------------------------------------------------------------------------------------------------


def decide(vehicle: Vehicle, state: State, memory: Memory) -> tuple[Decision, Memory]:
    """Pure heart of the runner: run the rules of the mode in force, in order."""
    draft = Draft()
    for call in vehicle.modes[state.mode]:
        draft, memory = call(vehicle, state, draft, memory)
    assert draft.total is not None
    return Decision(state.mode, draft.total, {name: _setting(state, draft, name) for name in vehicle.cameras}), memory


@cache
def reads(vehicle: Vehicle, mode: Mode) -> frozenset[str]:
    """Fields of the state whose change makes the mode decide again."""
    return frozenset({"mode", "on", "rois"}).union(*(call.rule.reads for call in vehicle.modes[mode]))


def _setting(state: State, draft: Draft, name: str) -> Setting:
    roi = state.rois[name]
    if not state.on[name]:
        return Setting(False, False, allocation.ZERO, 0, 0, None, roi, 0, 0, "switched off")
    kbps, factor = int(draft.bitrate[name]), draft.scaling[name]
    sending = draft.sending and kbps >= 1
    width, height = scaling.output_size(roi, factor)
    reason = draft.reasons.get(name, "")
    if draft.sending and not sending:
        reason += ", below 1 kbit/s: not sending"
    reason = "; ".join((reason, *draft.notes))
    return Setting(True, sending, draft.demand[name], kbps if sending else 0, kbps, factor, roi, width, height, reason)


def _short(bitrate: Kbps) -> int | str:
    return bitrate.numerator if bitrate.denominator == 1 else f"{float(bitrate):.1f}"


# --- from a modes file to a rule list ---------------------------------------------------------------------------------


def find_rule(name: str) -> Rule:
    """The rule of that name, from here or from an entry point.

    raises  ModelError with a suggestion
    """
    if name not in RULES:
        from importlib.metadata import entry_points

        for entry in entry_points(group="tod_runner.rules", name=name):
            entry.load()
    if name not in RULES:
        raise ModelError("", repr(name), f"unknown rule, {suggest(name, RULES)}")
    return RULES[name]


def call_rule(name: str, parameters: Mapping[str, Any]) -> RuleCall:
    """A rule with its parameters checked against the rule's own signature.

    Parameters are numbers >= 0, made exact, in the unit that their name ends in; `halve_every_s` and its like are > 0.
    raises  ModelError
    """
    found = find_rule(name)
    known = found.parameters
    for key, value in parameters.items():
        if key not in known:
            hint = suggest(key, known) if known else f"{name} takes none"
            raise ModelError(f"{name}.{key}", repr(value), f"unknown parameter, {hint}")
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < float("inf"):
            raise ModelError(f"{name}.{key}", repr(value), "must be a number from 0")
        if "_every_" in key and value == 0:
            raise ModelError(f"{name}.{key}", value, "must be above 0")
    for key, parameter in known.items():
        if key not in parameters and parameter.default is inspect.Parameter.empty:
            raise ModelError(f"{name}.{key}", "missing", "this rule needs it")
    return RuleCall(found, {key: exact(value) for key, value in parameters.items()})


def check_order(mode: Mode, calls: Sequence[RuleCall]) -> list[ModelError]:
    """Problems of a rule list: a rule before what it needs, or a part of the decision that no rule gives."""
    given: set[str] = set()
    problems = []
    for index, call in enumerate(calls):
        for part in sorted(call.rule.needs - given):
            rule_name = repr(call.rule.name)
            problems.append(ModelError(f"{mode}[{index}]", rule_name, f"needs {part}, no rule before gives it"))
        given |= call.rule.gives
    missing = [part for part in GIVEN if part not in given]
    if missing:
        problems.append(ModelError(f"{mode}", [c.rule.name for c in calls], f"no rule gives {', '.join(missing)}"))
    return problems
