"""Errors that end a run with one clear message instead of a traceback."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copyreg import __newobj__  # type: ignore[attr-defined]
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any

from runner.redact import printable

COMMAND_LINE = "command line"  # in place of a file


@dataclass(frozen=True, slots=True)
class Problem:
    """One user mistake: location, value found, rule broken.

    found  None if the path already shows it
    """

    file: str
    path: str
    found: str | None
    rule: str

    def __str__(self) -> str:
        return printable(": ".join(part for part in (self.file, self.path, self.found, self.rule) if part))


class UserError(Exception):
    """The user's input is wrong: exit status 2."""

    def __init__(self, file: str, path: str, found: str | None, rule: str) -> None:
        super().__init__(str(Problem(file, path, found, rule)))

    def __reduce__(self) -> tuple[Any, ...]:
        """Also raised in worker processes, which send it here: its text suffices."""
        return __newobj__, (type(self), *self.args), self.__dict__


class ArgumentError(UserError):
    """An argument of the command line is wrong.

    found  its value as written, or another object such as a path; None if it was not given
    """

    def __init__(self, name: str, found: object, rule: str) -> None:
        shown = found if found is None or isinstance(found, str) else repr(str(found))
        super().__init__(COMMAND_LINE, name, shown, rule)


class ConfigError(UserError):
    """The configuration is wrong: all problems at once."""

    def __init__(self, problems: Sequence[Problem], outcome: str = "nothing was started") -> None:
        self.problems = list(dict.fromkeys(problems))
        count = len(self.problems)
        summary = f"{count} problem{'' if count == 1 else 's'}, {outcome}"
        Exception.__init__(self, "\n".join([*map(str, self.problems), summary]))


class RunError(Exception):
    """A run failed on this machine: exit status 1. The text includes the remedy."""

    def __init__(self, text: str) -> None:
        super().__init__(printable(text))


def reason(error: OSError) -> str:
    """Why a call of the operating system failed."""
    return (error.strerror or str(error)).lower()


@contextmanager
def os_errors_as(reported: Callable[[str], BaseException]) -> Iterator[None]:
    """Raise an error of the operating system as another one, made from its reason."""
    try:
        yield
    except OSError as error:
        raise reported(reason(error)) from None


def suggest(word: str, known: Iterable[str], most: int = 13) -> str:
    """Suffix for a message about an unknown word: the closest known word, otherwise a list of known words.

    most  words to list
    """
    known = list(known)
    near = get_close_matches(word, known, 1)
    shown = [*known[:most], "..."] if len(known) > most else known
    if near:
        return f", did you mean {near[0]}?"
    return f"; expected {'one of ' if len(shown) > 1 else ''}{', '.join(shown)}" if shown else ""


class MissingBindings(ImportError):
    """GStreamer's Python bindings, or parts of them, cannot be loaded.

    missing  by part, why it fails to load and which package provides it
    """

    def __init__(self, missing: Mapping[str, str]) -> None:
        super().__init__("; ".join(f"{part}: {why}" for part, why in missing.items()))
        self.missing = missing
