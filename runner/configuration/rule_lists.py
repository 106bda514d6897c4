"""Builds the rules of a mode from a modes file: finds them, and checks their parameters and order, once.

Rules of other packages are found by the entry point group `tod_runner.rules`.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from dataclasses import replace
from enum import StrEnum
from typing import Any

from runner.core.model import Mode, ModelError, exact
from runner.core.rules import GIVEN, Rule, RuleCall, registry
from runner.errors import suggest

RULE = "rule"  # key of an entry: the rule that it runs, where it has a name of its own
OWN_RULES = "; one of your own needs the entry point tod_runner.rules, see docs/rules.md"


def find_rule(name: str) -> Rule:
    """The rule of that name, from this package or from an entry point.

    raises  ModelError with a suggestion
    """
    if name not in registry.RULES:
        from importlib.metadata import entry_points

        for entry in entry_points(group="tod_runner.rules", name=name):
            try:
                entry.load()
            except Exception as error:  # a user's package may raise anything on import
                rule = f"{entry.value} cannot be imported: {type(error).__name__}: {error}"
                raise ModelError("", repr(name), rule) from None
    if name not in registry.RULES:
        raise ModelError("", repr(name), f"unknown rule{suggest(name, registry.RULES)}{OWN_RULES}")
    return registry.RULES[name]


def call_entry(name: str, entry: Mapping[str, Any]) -> RuleCall:
    """An entry of a mode: it runs the rule that it is named after, or the one that it states as `rule`.

    raises  ModelError
    """
    rule = rule_of(name, entry)
    try:
        find_rule(rule)
    except ModelError as error:
        key, found = (RULE, error.found) if RULE in entry else ("", None)
        raise ModelError(key, found, error.rule) from None
    return replace(call_rule(rule, parameters_of(entry)), entry=name)


def rule_of(name: str, entry: Mapping[str, Any]) -> str:
    """Name of the rule that an entry of a mode runs."""
    return str(entry.get(RULE, name))


def parameters_of(entry: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in entry.items() if key != RULE}


def call_rule(name: str, parameters: Mapping[str, Any]) -> RuleCall:
    """A rule with its parameters checked against the rule's own signature.

    Parameters are numbers >= 0, made exact, in the unit at the end of their name; those like `halve_every_s` and
    `rear_fps` are > 0. One whose default is a word is one of the words of its type.
    raises  ModelError
    """
    found = find_rule(name)
    known = found.parameters
    for key, value in parameters.items():
        if key not in known:
            hint = suggest(key, known) if known else f"; {name} takes none"
            raise ModelError(key, repr(value), f"unknown parameter{hint}")
        words = known[key].default
        if isinstance(words, StrEnum):
            if value not in list(type(words)):
                raise ModelError(key, repr(value), f"must be one of {', '.join(type(words))}")
            continue
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < float("inf"):
            raise ModelError(key, repr(value), "must be a number of 0 or more")
        if value == 0 and ("_every_" in key or key.endswith("_fps")):
            raise ModelError(key, value, "must be above 0")
    for key, parameter in known.items():
        if key not in parameters and parameter.default is inspect.Parameter.empty:
            raise ModelError(key, "missing", "required by this rule")
    return RuleCall(found, {key: _value(known[key], value) for key, value in parameters.items()})


def _value(parameter: inspect.Parameter, value: Any) -> Any:
    words = parameter.default
    return type(words)(value) if isinstance(words, StrEnum) else exact(value)


def check_order(mode: Mode, calls: Sequence[RuleCall]) -> list[ModelError]:
    """Problems of the rules of a mode.

    A rule before what it needs, or after a rule that has used what it gives; a part of the decision that no rule gives.
    """
    given: set[str] = set()
    used: dict[str, str] = {}  # by part, the rule that used it first
    problems = []
    for call in calls:
        where, rule = f"{mode}.{call.name}", call.rule
        for part in sorted(rule.needs - given):
            problems.append(ModelError(where, None, f"needs {part}, which no earlier rule gives", f"{mode}"))
        for part in sorted(rule.gives & used.keys()):
            broken = f"gives {part}, must come before {used[part]}, which uses it"
            problems.append(ModelError(where, None, broken, f"{mode}.{used[part]}"))
        # A rule that gives a part again passes it on: those after it use the new one.
        used = {**dict.fromkeys((rule.needs & given | rule.uses) - rule.gives, call.name), **used}
        given |= rule.gives
    missing = [part for part in GIVEN if part not in given]
    if missing:
        problems.append(ModelError(f"{mode}", [call.name for call in calls], f"no rule gives {', '.join(missing)}"))
    return problems
