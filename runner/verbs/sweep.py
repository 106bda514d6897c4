"""Prepares all runs of a sweep before the first one starts."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from runner.errors import ConfigError
from runner.verbs import Arguments

Prepared = TypeVar("Prepared")


def prepare_all(
    arguments: Arguments, prepare: Callable[[Arguments], Prepared]
) -> list[tuple[tuple[str, ...], Prepared]]:
    """The overrides of each run, and what `prepare` returns for its arguments.

    raises  ConfigError with the problems of all runs
    """
    results, problems = [], []
    for words, own in arguments.runs():
        try:
            results.append((words, prepare(own)))
        except ConfigError as error:
            problems += error.problems
    if problems:
        raise ConfigError(problems)
    return results
