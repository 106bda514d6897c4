"""Processes one event: the pure step shared by live runs, dry runs, replay and simulation."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from types import MappingProxyType

from runner.core import rules
from runner.core.commands import Command, KnobValues, after, difference
from runner.core.decision import Decision
from runner.core.events import CameraSwitched, Event, ModeSelected, Refused, SourceReported
from runner.core.model import Mode, Vehicle
from runner.core.rules import Memories
from runner.core.state import State, advance, keep

NOTHING: Mapping[str, KnobValues] = MappingProxyType({})


@dataclass(frozen=True, slots=True)
class Run:
    """State of a run after an event.

    commanded  by camera and knob, the value last commanded
    commands   the changes caused by this event
    refused    why the event was not accepted; None if it was
    fault      why the rules could not decide, so that an earlier decision stays in force; None if they could
    """

    state: State
    memory: Memories
    decision: Decision
    commanded: Mapping[str, KnobValues] = field(default_factory=lambda: NOTHING)
    commands: tuple[Command, ...] = ()
    refused: str | None = None
    fault: str | None = None


def start(vehicle: Vehicle) -> Run:
    """A run before its first event: decided, nothing commanded yet.

    A run that starts in mode S uses what mode A would decide.

    raises  RuleFailed
    """
    state = State.initial(vehicle, vehicle.mode)
    if vehicle.mode is Mode.SINGLE:
        automatic, _ = rules.decide(vehicle, replace(state, mode=Mode.AUTOMATIC), {})
        state = replace(state, manual=keep(automatic))
    decision, memory = rules.decide(vehicle, state, {})
    return Run(state, memory, decision)


def step(vehicle: Vehicle, run: Run, event: Event) -> Run:
    """Process one event: advance the state, decide if an input of the rules changed, command the difference.

    If a rule fails, the last decision stays in force and `fault` gives the reason. A mode whose rules fail is not
    entered.
    """
    refused: str | None = None
    fault = run.fault
    state, memory, decision = run.state, run.memory, run.decision
    try:
        state = advance(vehicle, run.state, event, _to_keep(vehicle, run, event))
    except Refused as reason:
        refused = str(reason)
        state = replace(run.state, t=event.t)
    inputs = rules.reads(vehicle, state.mode)
    if any(_differ(getattr(state, name), getattr(run.state, name)) for name in inputs):
        try:
            decision, memory = rules.decide(vehicle, state, run.memory)
            fault = None
        except rules.RuleFailed as failed:
            if state.mode is run.state.mode:
                fault = str(failed)
            else:
                refused = f"mode {state.mode}: {failed}"
                state = replace(run.state, t=event.t)
    commands = difference(decision, run.commanded)
    return Run(state, memory, decision, after(run.commanded, commands), tuple(commands), refused, fault)


def _to_keep(vehicle: Vehicle, run: Run, event: Event) -> Decision:
    """The decision whose settings outlast an event: as without the measured link, which is temporary."""
    if isinstance(event, (ModeSelected, CameraSwitched, SourceReported)) and run.decision.uncapped > run.decision.total:
        with suppress(rules.RuleFailed):
            return rules.decide_without_link(vehicle, run.state, run.memory)
    return run.decision


def _differ(now: object, before: object) -> bool:
    return now is not before and now != before  # most fields are the same object
