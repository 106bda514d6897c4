"""The runs of a sweep, prepared before the first one starts."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from runner.errors import ConfigError
from runner.verbs import Arguments

Prepared = TypeVar("Prepared")


def prepared(arguments: Arguments, prepare: Callable[[Arguments], Prepared]) -> list[tuple[tuple[str, ...], Prepared]]:
    """The words of each run, and what `prepare` makes of its arguments.

    raises  ConfigError with the problems of all runs
    """
    made, problems = [], []
    for words, own in arguments.runs():
        try:
            made.append((words, prepare(own)))
        except ConfigError as error:
            problems += error.problems
    if problems:
        raise ConfigError(problems)
    return made
