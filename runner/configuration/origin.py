"""Tracks the file or override that each value of a composed configuration comes from. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from runner import schema
from runner.configuration.interpolation import value_at
from runner.errors import Problem

PICKED = "picked"  # package in which a group's file is composed alone
GRAPH_PARTS = {"encoder": "vehicle", "sender": "vehicle", "receiver": "operator"}  # and the list that includes each


@dataclass(frozen=True, slots=True)
class Part:
    """One contributing file or override, with its content and its place in the whole configuration.

    word  the override, as given
    """

    file: str
    package: schema.Path
    content: Any
    path: Path | None = None
    word: str = ""

    @property
    def name(self) -> str:
        """Its file, or the command line with the override."""
        return f"{self.file}: {schema.shortened(self.word)}" if self.word else self.file


@dataclass(frozen=True, slots=True)
class Composed:
    """The whole configuration as plain data, and its parts, the one with the highest precedence first.

    moved    by path in the document, the original paths of entries that a list includes from another list
    choices  by group, the chosen file
    """

    document: dict[str, Any]
    parts: list[Part] = field(default_factory=list)
    moved: Mapping[schema.Path, schema.Path] = field(default_factory=dict)
    choices: Mapping[str, str] = field(default_factory=dict)

    def problem(self, path: schema.Path, found: str | None, rule: str, others: Iterable[schema.Path] = ()) -> Problem:
        """A problem, attributed to its file or override, with the path inside that.

        others  paths of further values that the rule is about, of which the first from each other file is named
        """
        part, inside = self._stated(path)
        named = {part.file: ""}
        for other in others:
            if (value := value_at(self.document, other)) is not None:
                its, where = self._stated(other)
                place = its.name if its.word else f"{its.file}: {schema.dotted(where)}: {schema.shown(value)}"
                named.setdefault(its.file, f"; see {place}")
        return Problem(part.file, schema.dotted(inside), found, rule + "".join(named.values()))

    def _stated(self, path: schema.Path) -> tuple[Part, schema.Path]:
        """The part that a value of the document comes from, and its path in there."""
        path = self.written(path)
        part = self._origin(path)
        return part, path[len(part.package) :]

    def stated_by(self, path: schema.Path) -> Part | None:
        """The part that states a value of the document, itself or by an interpolation; None: none does."""
        value, path = value_at(self.document, path), self.written(path)
        return next((part for part in self._visible(path) if _states(part, path, value)), None)

    def written(self, path: schema.Path) -> schema.Path:
        """The original path of a value of the document."""
        lengths = (length for length in range(len(path), 0, -1) if path[:length] in self.moved)
        length = next(lengths, 0)
        return (*self.moved[path[:length]], *path[length:]) if length else path

    def without_graph_parts(self) -> Composed:
        """Remove the parts of graphs that a list includes, or that a later list omits.

        A remaining one is a mistake: the file that sets it last expects it to be used.
        """
        used = {(path[:-2], origin[-2]) for path, origin in self.moved.items()}
        mounts = self.document.get("cameras")
        names = mounts if isinstance(mounts, dict) else ()
        for place in (("graph",), (PICKED,), *(("cameras", name, "graph") for name in names)):
            graph = value_at(self.document, place)
            given = [key for key in GRAPH_PARTS if key in graph] if isinstance(graph, dict) else []
            for key in given:
                if (place, key) in used or self._age((*place, GRAPH_PARTS[key])) < self._age((*place, key)):
                    del graph[key]
        return self

    def _age(self, path: schema.Path) -> int:
        """Number of parts that take precedence over the one that a value comes from."""
        return self.parts.index(self._origin(path))

    def _origin(self, path: schema.Path) -> Part:
        """The part that has the value; for a missing value, the part that defines most of its surroundings."""
        inside = [part for part in self._visible(path) if path[: len(part.package)] == part.package]
        for length in range(len(path), 0, -1):
            makers = [part for part in inside if len(part.package) == length]
            above = (part for part in inside if len(part.package) < length)
            holders = [part for part in above if _holds(part.content, path[len(part.package) : length])]
            if length < len(path):  # the key is missing: the part that defines its surroundings, the most local first
                writers = [part for part in holders if isinstance(_value_in(part, path[:length]), dict | list)]
                holders = sorted(writers or holders, key=lambda part: -len(part.package))
            candidates = [*holders, *makers] if length == len(path) else [*makers, *holders]
            if candidates:
                return candidates[0]
        vehicle = (part for part in self.parts if part.path and part.path.parent.name == "vehicle")
        return next(vehicle, self.parts[-1]) if path[:1] in (("name",), ("cameras",)) else self.parts[-1]

    def _visible(self, path: schema.Path) -> list[Part]:
        """The parts down to the one whose list contains the path: a list replaces those of all earlier files."""
        lists = [path[:depth] for depth, key in enumerate(path) if isinstance(key, int)]
        for index, part in enumerate(self.parts):
            if any(isinstance(_value_in(part, place), list) for place in lists):
                return self.parts[: index + 1]
        return self.parts


def _states(part: Part, path: schema.Path, value: Any) -> bool:
    """Whether a part has this value, or an interpolation instead, at a path of the whole document."""
    if path[: len(part.package)] != part.package:
        return False
    inner = path[len(part.package) :]
    above = (value_at(part.content, inner[:length]) for length in range(len(inner) + 1))
    if any(isinstance(each, str) and "${" in each for each in above):
        return True
    return _holds(part.content, inner) and value_at(part.content, inner) == value


def _value_in(part: Part, path: schema.Path) -> Any:
    """The value of a part at a path of the whole document; None if missing."""
    inside = path[: len(part.package)] == part.package
    return value_at(part.content, path[len(part.package) :]) if inside else None


def _holds(content: Any, path: schema.Path) -> bool:
    return value_at(content, path, _MISSING) is not _MISSING


def nested(key: str, value: Any) -> Any:
    """{"a": {"b": value}} for a.b."""
    for part in reversed(key.split(".")):
        value = {part: value}
    return value


_MISSING = object()
