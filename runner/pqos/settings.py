"""Reads settings from a section of the configuration: numbers, and files of limited size."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from runner.core.model import ModelError
from runner.system.files import file_problem

MOST_BYTES = 200_000_000  # a month at 1 Hz


def find_path(settings: Mapping[str, Any], key: str, bases: Sequence[Path]) -> Path:
    """The path that a setting names: absolute, or relative to the first of the directories that has it.

    raises  ModelError
    """
    name = settings.get(key)
    if not isinstance(name, str) or not name:
        raise ModelError(key, name, "must name a file")
    paths = [base / name for base in bases] or [Path(name)]
    path = next((path for path in paths if path.exists()), None)
    if path is None:
        raise ModelError(key, name, f"no such file in {', '.join(dict.fromkeys(str(path.parent) for path in paths))}")
    return path


def find_file(settings: Mapping[str, Any], key: str, bases: Sequence[Path]) -> Path:
    """The file of limited size that a setting names, see `find_path`.

    raises  ModelError
    """
    path = find_path(settings, key, bases)
    if why := file_problem(path):
        raise ModelError(key, settings[key], why)
    if path.stat().st_size > MOST_BYTES:
        raise ModelError(key, settings[key], f"must be at most {MOST_BYTES // 1_000_000} MB long")
    return path


def number(settings: Mapping[str, Any], key: str, *, positive: bool = False) -> float:
    """A setting that is a finite number, 0 or more (`positive`: above 0). Raises ModelError."""
    value: Any = settings.get(key)
    finite = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    if not finite or value < 0 or (positive and value == 0):
        raise ModelError(key, value, f"must be a number {'above 0' if positive else 'of 0 or more'}")
    return float(value)


@contextmanager
def within(section: str) -> Iterator[None]:
    """Report the keys of errors raised inside as keys of a section of the settings."""
    try:
        yield
    except ModelError as error:
        raise ModelError(f"{section}.{error.key}", error.found, error.rule) from None
