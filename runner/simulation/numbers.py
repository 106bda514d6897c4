"""The numbers of the rules of a modes file: how they are named, and values to try in place of those in force."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from enum import StrEnum
from fractions import Fraction
from typing import Any, NamedTuple

from runner.configuration.overrides import parse_overrides, sweep
from runner.configuration.rule_lists import call_rule, find_rule, parameters_of, rule_of
from runner.core.model import Mode, ModelError, exact, plain
from runner.errors import COMMAND_LINE, ConfigError, Problem, suggest

Modes = Mapping[str, Mapping[str, Mapping[str, Any]]]  # as in a modes file: by mode and name, parameters
BETWEEN = re.compile(r"\s+(?=[A-Za-z])")  # two words: a list of values may contain blanks
UNIT = re.compile(r"(?:^|_)(?:s|ms|kbps|m|px)$")  # at the end of a name; a number without one is a share, at most 1


class Number(NamedTuple):
    """A number of a rule of a mode.

    entry  name of the rule in the modes file
    given  the rule's parameters in the modes file
    value  in force; None: the rule has no number here unless one is given
    """

    mode: str
    entry: str
    rule: str
    key: str
    given: Mapping[str, Any]
    value: Any

    @property
    def name(self) -> str:
        return f"{self.mode}.{self.entry}.{self.key}"

    @property
    def is_written(self) -> bool:
        """Whether the modes file states it; otherwise it is the rule's default."""
        return self.key in self.given

    def check(self, value: Any) -> None:
        """raises ModelError if the rule does not take the value"""
        call_rule(self.rule, {**self.given, self.key: value})


class Trial(NamedTuple):
    """Another value of a number."""

    number: Number
    value: Any

    @property
    def override(self) -> str:
        """The word of the command line that sets it."""
        return f"modes.{self.number.name}={self.value}"


def numbers(modes: Modes, driven: Iterable[str]) -> list[Number]:
    """All numbers of the rules of the modes that are driven."""
    found = []
    for mode in driven:
        for name, entry in modes[mode].items():
            rule, given = rule_of(name, entry), parameters_of(entry)
            for key, parameter in find_rule(rule).parameters.items():
                if not isinstance(parameter.default, StrEnum):
                    found.append(Number(mode, name, rule, key, given, given.get(key, _default(parameter))))
    return found


def _default(parameter: inspect.Parameter) -> Any:
    default = parameter.default
    return plain(default) if isinstance(default, Fraction) else None


def trials(vary: str | None, modes: Modes, driven: Sequence[str]) -> tuple[list[Trial], list[str]]:
    """The values to try, one at a time, and what is not tried, in words.

    vary    words as in `automatic.follow_link.start=[0.25, 1] automatic.hold_while_capped`: a number with its values in
            Hydra's grammar (also 0.25,1 or range(1,4)); or a number, or all those of a rule or a mode, halved and
            doubled. None: each number that the modes file states, halved and doubled
    driven  modes that the drives are in
    raises  ConfigError with all problems
    """
    known = numbers(modes, driven)
    if vary is None:
        return _scaled(number for number in known if number.is_written)
    found: dict[str, Trial] = {}
    skipped, problems = [], []
    for word in BETWEEN.split(vary.strip()):
        try:
            tried, not_tried = _of_word(word, known, modes, driven)
        except ConfigError as error:
            problems += error.problems
            continue
        found |= {trial.override: trial for trial in tried if trial.value != trial.number.value}
        skipped += not_tried
    if problems:
        raise ConfigError(problems)
    return list(found.values()), skipped


def _scaled(some: Iterable[Number]) -> tuple[list[Trial], list[str]]:
    """Half and twice the value in force, where the rule takes it."""
    found, skipped = [], []
    for number in some:
        if number.value:
            halved, doubled = (plain(exact(number.value) * factor) for factor in (Fraction(1, 2), Fraction(2)))
            found += [Trial(number, value) for value in (halved, doubled) if _is_allowed(number, value)]
        else:
            value = "none" if number.value is None else number.value
            skipped.append(f"{number.name} is {value}, which cannot be halved and doubled: vary= can give it values")
    return found, skipped


def _is_allowed(number: Number, value: int | float) -> bool:
    try:
        number.check(value)
    except ModelError:
        return False
    return value <= 1 or bool(UNIT.search(number.key))


def _of_word(word: str, known: Sequence[Number], modes: Modes, driven: Sequence[str]) -> tuple[list[Trial], list[str]]:
    name, equals, _ = word.partition("=")
    named = name.removeprefix("modes.").split(".")
    some = [one for one in known if (one.mode, one.entry, one.key)[: len(named)] == tuple(named)]
    if not some:
        raise ConfigError([_problem(name, None, _why_unknown(named, known, modes, driven))])
    if not equals:
        return _scaled(some)
    if named[-1] != some[0].key:
        raise ConfigError([_problem(name, None, f"names several numbers{suggest('', [one.name for one in some])}")])
    values = list(_values(word))
    problems = [problem for number in some for value in values for problem in _wrong(number, value)]
    if problems:
        raise ConfigError(problems)
    return [Trial(number, value) for number in some for value in values], []


def _values(word: str) -> Iterator[Any]:
    """raises ConfigError"""
    for override in parse_overrides([each for (each,) in sweep([word])]):
        yield from override.value if isinstance(override.value, list) else [override.value]


def _wrong(number: Number, value: Any) -> Iterator[Problem]:
    try:
        number.check(value)
    except ModelError as error:
        yield _problem(number.name, str(error.found), error.rule)


def _problem(name: str, found: str | None, rule: str) -> Problem:
    return Problem(COMMAND_LINE, f"vary: {name}", found, rule)


def _why_unknown(named: Sequence[str], known: Sequence[Number], modes: Modes, driven: Sequence[str]) -> str:
    """Why words name no number of a rule in force."""
    mode, *rest = named
    if mode in driven:
        return _why_no_number(rest, mode, known, modes[mode])
    if mode in list(Mode):
        return f"no drive is in mode {mode}: choose it with mode={mode}"
    return f"must begin with the mode, MODE.RULE.NUMBER{suggest('.'.join(named), [one.name for one in known])}"


def _why_no_number(
    named: Sequence[str], mode: str, known: Sequence[Number], entries: Mapping[str, Mapping[str, Any]]
) -> str:
    entry, key = (*named, "", "")[:2]
    if entry not in entries:
        return f"mode {mode} has no such rule{suggest(entry, entries)}"
    if key in find_rule(rule_of(entry, entries[entry])).parameters:
        return "is a word, not a number" if len(named) == 2 else f"must end with {key}"
    own = [one.key for one in known if (one.mode, one.entry) == (mode, entry)]
    return f"{entry} has no such number{suggest(key, own)}" if own else f"{entry} has no numbers"
