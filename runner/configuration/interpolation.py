"""Targets of interpolations, ${a.b}, and the size of a configuration with interpolations expanded."""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import islice, repeat
from typing import Any

from runner.schema import Path

_REFERENCE = re.compile(r"\$\{(\.*)([^${}:]+)\}")  # leading dots, key; the innermost of nested ones
_STEP = re.compile(r"[^.\[\]]+")
CHARACTERS = 100  # of text that count as one value


def references(text: str, path: Path) -> Iterator[Path]:
    """The paths that the interpolations in a text refer to; path: location of the text, for relative ones."""
    for dots, key in _REFERENCE.findall(text):
        above = path[: -len(dots)] if dots else ()
        yield (*above, *(int(step) if step.isdigit() else step for step in _STEP.findall(key)))


def value_at(document: Any, path: Path, otherwise: Any = None) -> Any:
    """The value at a path of a document; `otherwise` if there is none."""
    for key in path:
        if isinstance(document, dict):
            known = key if key in document else str(key)  # overrides name an entry a.0
            if known not in document:
                return otherwise
            document = document[known]
        elif isinstance(document, list) and isinstance(key, int) and key < len(document):
            document = document[key]
        else:
            return otherwise
    return document


def spliced(written: Any, resolved: Any) -> tuple[Any, dict[Path, Path]]:
    """A resolved document in which an interpolation that refers to a list is replaced by the entries of the list.

    written   the document before its interpolations were resolved
    resolved  the same afterwards
    returns   the document, and by path in it, the original paths of entries of such lists
    """
    moved: dict[Path, Path] = {}

    def followed(path: Path, kind: type) -> Path:
        """The original path of the value of a type to which a path leads."""
        text = value_at(written, path)
        target = next(references(text, path), path) if isinstance(text, str) else path
        return followed(target, kind) if target != path and isinstance(value_at(resolved, target), kind) else path

    def entries(path: Path) -> Iterator[tuple[Path, Any]]:
        """Entries of a resolved list, each with its original path."""
        for index, entry in enumerate(value_at(resolved, path)):
            here = (*path, index)
            there = followed(here, list) if isinstance(entry, list) else here
            yield from entries(there) if there != here else ((here, entry),)

    def copy(value: Any, path: Path, source: Path) -> Any:
        source = followed(source, type(value))
        if isinstance(value, dict):
            return {key: copy(inner, (*path, key), (*source, key)) for key, inner in value.items()}
        if not isinstance(value, list):
            return value
        made = []
        for index, (origin, entry) in enumerate(entries(source)):
            here = (*path, index)
            stated = origin if origin[:-1] != source else (*path, origin[-1])
            if stated != here:
                moved[here] = stated
            made.append(copy(entry, here, origin))
        return made

    return copy(resolved, (), ()), moved


def expands_within(document: Any, most: int) -> bool:
    """Whether a document has at most `most` values with its interpolations expanded.

    Each value counts once per direct or indirect reference: a dozen short lines that double each other expand to
    millions.
    """
    try:
        return sum(1 for _ in islice(_expanded(document, document, (), frozenset()), most + 1)) <= most
    except RecursionError:
        return False


def _expanded(document: Any, value: Any, path: Path, above: frozenset[Path]) -> Iterator[None]:
    """One step for each value at and below a path, and for those that interpolations there refer to.

    above  paths whose interpolations are being followed: a circle is not, OmegaConf reports it
    """
    yield
    if isinstance(value, dict | list):
        for key, inner in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _expanded(document, inner, (*path, key), above)
    elif isinstance(value, str):
        yield from repeat(None, len(value) // CHARACTERS)
        for target in references(value, path):
            if target not in above:  # None: OmegaConf reports that there is no such key
                yield from _expanded(document, value_at(document, target), target, above | {target})
