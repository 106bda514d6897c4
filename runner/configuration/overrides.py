"""Overrides: command-line words as parsed by Hydra; each chooses a group's file or sets a value."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice, product
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Any

from runner import schema
from runner.configuration.files import GROUPS, options
from runner.configuration.yaml_file import label
from runner.errors import COMMAND_LINE, ConfigError, Problem, suggest

if TYPE_CHECKING:
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.core.override_parser.types import Override as HydraOverride

OPTIONAL = ("link", "experiment")  # groups that need no choice
LONGEST_WORD = 4096  # characters of an override, as for a path
DEEPEST = 32  # brackets of one kind in an override
MERGED = (
    "would be merged with the rules that the mode has; set a number by modes.MODE.RULE.NUMBER=VALUE, remove a rule by "
    "~modes.MODE.RULE, write others into a modes file"
)
MAX_RUNS = 1000  # of a sweep


@dataclass(frozen=True, slots=True)
class Override:
    """One override: a choice of a group's file, or a value."""

    text: str
    key: str
    value: Any
    choice: bool

    @property
    def deletes(self) -> bool:
        return self.text.startswith("~")

    @property
    def is_none(self) -> bool:
        """Whether it removes an optional choice."""
        return self.choice and self.key in OPTIONAL and self.value == "null"

    def hydra(self, chosen: Collection[str]) -> str:
        """Its form for Hydra, in which a plus is optional. The schema defines the valid keys.

        chosen  groups for which conf/config.yaml chooses a file
        """
        if self.is_none:
            return f"~{self.key}"
        plain = self.text.lstrip("+")
        if self.deletes or (self.choice and self.key in chosen):
            return plain
        return self.text if self.choice else f"++{plain}"


def parse_overrides(overrides: Sequence[str]) -> list[Override]:
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    parser, parsed, problems = OverridesParser.create(), [], []
    for text in overrides:
        try:
            override, group = _parsed(parser, text)
            if override.is_sweep_override():
                raise HydraException(
                    "a,b,c is a sweep, which print, replay and demo run with -m; write [a,b,c] for a list"
                )
            value = None if override.is_delete() else override.value()
            choice = group in GROUPS and not isinstance(value, dict)
            if choice and value is None and not override.is_delete():
                value = "null"
            parsed.append(Override(text, override.get_key_element().lstrip("+~"), value, choice))
        except HydraException as error:
            problems.append(_problem(text, error))
    if problems:
        raise ConfigError(problems)
    return parsed


def sweep(words: Sequence[str]) -> list[tuple[str, ...]]:
    """The overrides of each run that sweeps stand for: a=1,2 or a=choice(1,2), a=range(1,5), in Hydra's grammar.

    returns  one word per given word, in the order of Hydra's own sweeper: the last word varies fastest
    raises   ConfigError
    """
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    parser, swept, problems = OverridesParser.create(), [], []
    for text in words:
        try:
            override, _ = _parsed(parser, text)
            swept.append(list(islice(_values(override), MAX_RUNS + 1)))
        except (ValueError, ArithmeticError):  # from Python's own range and decimal
            rule = "a range needs numbers, and a step other than 0"
            problems.append(Problem(COMMAND_LINE, "", schema.shortened(text), rule))
        except HydraException as error:
            problems.append(_problem(text, error))
    if problems:
        raise ConfigError(problems)
    if (count := prod(map(len, swept))) > MAX_RUNS:
        raise ConfigError([Problem(COMMAND_LINE, "-m", None, f"{count} runs or more: must be at most {MAX_RUNS}")])
    return list(product(*swept))


def _values(override: HydraOverride) -> Iterator[str]:
    """An override for each value of a sweep; any other override unchanged."""
    from hydra.errors import HydraException

    if not override.is_sweep_override():
        yield str(override.input_line)
    elif override.value_type and override.value_type.name in ("INTERVAL_SWEEP", "GLOB_CHOICE_SWEEP"):
        raise HydraException("cannot be enumerated; a sweep is a,b,c or choice(a,b,c) or range(from,to,step)")
    else:
        yield from (f"{override.get_key_element()}={value}" for value in override.sweep_string_iterator())


def _parsed(parser: OverridesParser, text: str) -> tuple[HydraOverride, str]:
    """A word as Hydra reads it, and the group or key that it names.

    raises  HydraException
    """
    from hydra.errors import HydraException

    if len(text) > LONGEST_WORD or max(map(text.count, "[{(")) > DEEPEST:
        raise HydraException("is too long or nested too deeply, write it into a file")
    override = parser.parse_override(text)
    group = override.key_or_group.split("@")[0].lstrip("/")
    if group.partition(".")[0].partition("/")[0] in ("", "hydra"):
        raise HydraException("no such key")
    return override, group


def _problem(text: str, error: Exception) -> Problem:
    rule = str(error).partition("\n")[0]
    plain = any(part in rule for part in ("sweep", "no such", "too long"))
    hint = "" if plain else """; quote a value with special characters: 'key="value"'"""
    return Problem(COMMAND_LINE, "", schema.shortened(text), rule + hint)


def choice_problems(override: Override, directories: Sequence[Path]) -> Iterator[Problem]:
    """The problem of choosing a missing file."""
    if not override.choice or override.value is None or override.is_none:
        return
    group = override.key.split("@")[0].lstrip("/")
    known = options(group, directories)
    if str(override.value) not in known:
        folders = " or ".join(f"{label(directory / group)}/" for directory in reversed(directories))
        rule = f"no such file in {folders}{suggest(str(override.value), known)}"
        if len(directories) == 1 and "did you mean" not in rule:
            rule += "; files of your own need conf=DIR"
        yield Problem(COMMAND_LINE, override.key, str(override.value), rule)


def rule_problems(override: Override) -> Iterator[Problem]:
    """The problem of an override that names a rule by its place, or states the rules of a mode as a whole."""
    modes, mode, place, *rest = (*override.key.split("."), "", "")[: max(3, override.key.count(".") + 1)]
    if modes != "modes" or override.choice:
        return
    if place.isdecimal():
        meant = ".".join((modes, mode, *(rest or ("RULE", "NUMBER"))))
        yield Problem(COMMAND_LINE, override.key, None, f"rules are named, not numbered: {meant}")
    elif not place and isinstance(override.value, dict | list):
        yield Problem(COMMAND_LINE, override.key, schema.shown(override.value), MERGED)


def choosable(name: str) -> bool:
    """Whether Hydra accepts a word as the name of a file: not a,b, which is a sweep, nor 1e3, null or true."""
    try:
        (override,) = parse_overrides([f"vehicle={name}"])
    except ConfigError:
        return False
    return override.value == name and name != "null"
