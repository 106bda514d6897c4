"""What a rule is, and the register of those that are known.

A rule is a pure function `rule(vehicle, state, draft, memory, *, parameters) -> (draft, memory)`, registered by the
decorator `rule`, which declares what it needs from earlier rules, what it gives, and which state fields it reads.
Memory is frozen, and the rule's own: what rules share is a part of the draft. Only rules that need history use it.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from runner.core.decision import Draft
from runner.core.model import Vehicle
from runner.core.state import State

Memory = Mapping[str, Any]
Step = tuple[Draft, Memory]
MemoryKey = tuple[str, str]  # names of a rule and of its entry in the modes file
Memories = Mapping[MemoryKey, Memory]

GIVEN = ("total", "demand", "bitrate", "scaling")  # parts that a mode's rules must give together


@dataclass(frozen=True, slots=True)
class Rule:
    """A rule and what it declares about itself.

    needs  parts of the draft that earlier rules must have given
    gives  parts of the draft that exist after it
    reads  fields of the state whose change triggers a new decision
    uses   parts of the draft that it takes into account if earlier rules have given them
    """

    name: str
    function: Callable[..., Step]
    needs: frozenset[str]
    gives: frozenset[str]
    reads: frozenset[str]
    uses: frozenset[str] = frozenset()

    @property
    def parameters(self) -> Mapping[str, inspect.Parameter]:
        every = inspect.signature(self.function).parameters
        return {name: p for name, p in every.items() if p.kind is inspect.Parameter.KEYWORD_ONLY}


@dataclass(frozen=True, slots=True)
class RuleCall:
    """A rule with its parameters from a modes file.

    entry  name that the modes file gives it; empty: that of the rule
    """

    rule: Rule
    parameters: Mapping[str, Any] = field(default_factory=dict)
    entry: str = ""

    @property
    def name(self) -> str:
        return self.entry or self.rule.name

    @property
    def key(self) -> MemoryKey:
        """Modes share the memory of a rule where its name is the same."""
        return self.rule.name, self.name

    @property
    def reads(self) -> frozenset[str]:
        return self.rule.reads

    @property
    def gives(self) -> frozenset[str]:
        return self.rule.gives

    def __call__(self, vehicle: Vehicle, state: State, draft: Draft, memory: Memory) -> Step:
        return self.rule.function(vehicle, state, draft, memory, **self.parameters)


RULES: dict[str, Rule] = {}


EVERYTHING = frozenset(part.name for part in fields(State))


def rule(
    *,
    needs: Iterable[str] = (),
    gives: Iterable[str] = (),
    reads: Iterable[str] = EVERYTHING,
    uses: Iterable[str] = (),
) -> Callable[[Callable[..., Step]], Callable[..., Step]]:
    """Register a function as a rule under its own name.

    needs   parts of the draft that earlier rules must have given
    gives   parts of the draft that exist after it
    reads   fields of the state that the rule depends on; default: all, so that any change triggers a new decision
    uses    parts of the draft that it takes into account if earlier rules have given them
    raises  ValueError if `reads` names something other than a field of the state: the rule would miss its changes
    """
    read = frozenset(reads)
    if unknown := sorted(read - EVERYTHING):
        raise ValueError(
            f"reads: {', '.join(unknown)}: unknown; expected fields of State: {', '.join(sorted(EVERYTHING))}"
        )

    def register(function: Callable[..., Step]) -> Callable[..., Step]:
        name = function.__name__
        RULES[name] = Rule(name, function, frozenset(needs), frozenset(gives), read, frozenset(uses))
        return function

    return register


class Last:
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
