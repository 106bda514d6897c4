"""One event further: the pure step that live runs, dry runs, replay and simulation share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

from runner import rules
from runner.commands import Command, Knobs, after, difference
from runner.decision import Decision
from runner.events import Event
from runner.model import Mode, Vehicle
from runner.rules import Memory
from runner.state import Refused, State, advance, keep

NOTHING: Mapping[str, Knobs] = MappingProxyType({})


@dataclass(frozen=True, slots=True)
class Run:
    """Where a run stands after an event.

    commanded  by camera and knob, what has been commanded so far
    commands   what this event made of it: the difference
    refused    why the event was not accepted, or ""
    """

    state: State
    memory: Memory
    decision: Decision
    commanded: Mapping[str, Knobs] = field(default_factory=lambda: NOTHING)
    commands: tuple[Command, ...] = ()
    refused: str = ""


def start(vehicle: Vehicle) -> Run:
    """A run before its first event: decided, nothing commanded yet.

    A run that starts in mode S takes what A would decide.
    """
    state = State.initial(vehicle, vehicle.mode)
    if vehicle.mode is Mode.SINGLE:
        automatic, _ = rules.decide(vehicle, replace(state, mode=Mode.AUTOMATIC), {})
        state = replace(state, manual=keep(automatic))
    decision, memory = rules.decide(vehicle, state, {})
    return Run(state, memory, decision)


def step(vehicle: Vehicle, run: Run, event: Event) -> Run:
    """Take one event: advance the state, decide if an input of the rules changed, command the difference."""
    refused = ""
    state, memory, decision = run.state, run.memory, run.decision
    try:
        state = advance(vehicle, run.state, event, run.decision)
    except Refused as reason:
        refused = str(reason)
        state = replace(run.state, t=event.t)
    inputs = rules.reads(vehicle, state.mode)
    if any(getattr(state, name) != getattr(run.state, name) for name in inputs):
        decision, memory = rules.decide(vehicle, state, run.memory)
    commands = difference(decision, run.commanded)
    return Run(state, memory, decision, after(run.commanded, commands), tuple(commands), refused)
