"""Registries of other machines, kept in files: those that come with the package, and a user's own."""

from __future__ import annotations

import lzma
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path

import msgspec

from runner.core.model import Element
from runner.elements.check import media
from runner.elements.description import SINK, SRC, Factory, Property, Registry
from runner.errors import ArgumentError, reason
from runner.system.files import write_whole

PACKAGED = Path(__file__).with_name("registries")
ENDING = ".json.xz"
PASSING = "coreelements"  # plugin whose elements hand on what they are given


@dataclass(frozen=True, slots=True)
class Described:
    """An element of a dump: its factory, and its properties by name."""

    factory: Factory
    properties: Mapping[str, Property]


@dataclass(frozen=True, slots=True)
class Dump:
    """All that checks need of one machine's registry.

    gstreamer  version of GStreamer
    date       of the dump, YYYY-MM-DD
    system     name of the operating system
    machine    of the processor: x86_64
    plugins    version by name
    """

    gstreamer: str
    date: str
    system: str
    machine: str
    plugins: Mapping[str, str]
    elements: Mapping[str, Described]


class DumpedRegistry(Registry):
    """The registry of another machine, from a dump.

    Values of caps and structures, and links, are checked less closely than by GStreamer itself: see `reads` and
    `link_problem`.

    name   in messages
    reads  whether a text is a value of a type that only GStreamer itself reads, such as GstCaps
    """

    def __init__(self, name: str, dump: Dump, reads: Callable[[str, str], bool]) -> None:
        self.name, self._dump, self._reads = name, dump, reads
        system = f"GStreamer {dump.gstreamer} of {dump.system}, {dump.machine}"
        self.origin = f"{name}: {system}, read on {dump.date}"

    def names(self) -> Iterable[str]:
        return self._dump.elements

    def has_plugin(self, name: str) -> bool:
        return name in self._dump.plugins

    def find(self, element: str) -> Factory | None:
        return self._dump.elements[element].factory if element in self._dump.elements else None

    def properties(self, element: str) -> Mapping[str, Property]:
        return self._dump.elements[element].properties

    def alike(self, klass: str) -> Iterable[str]:
        found = {name: each.factory for name, each in self._dump.elements.items()}
        names = [name for name, each in found.items() if each.klass == klass and each.rank]
        return sorted(names, key=lambda name: (-found[name].rank, name))

    def reads(self, type_name: str, text: str) -> bool:
        return self._reads(type_name, text)

    def link_problem(self, elements: Sequence[Element]) -> str | None:
        """Names the neighbours that have no media type in common, by their templates; formats are not compared."""
        flows = frozenset[str]()
        for before, after in pairwise(elements):
            flows = self._given(before) or (flows if self._passes(before) else frozenset())
            takes = self._stated(after) or media(self, after.factory, SINK)
            if flows and takes and not flows & takes:
                return f"could not link {before.name} to {after.name}"
        return None

    def _given(self, element: Element) -> frozenset[str]:
        """Media types that leave an element; none if they are those that enter it, or unknown."""
        return self._stated(element) or media(self, element.factory, SRC)

    @staticmethod
    def _stated(element: Element) -> frozenset[str]:
        """Media types of a filter's caps."""
        caps = str(element.properties.get("caps", "")) if element.factory == "capsfilter" else ""
        return frozenset(name for name in re.findall(r"(?:^|;)\s*([\w-]+/[\w-]+)", caps))

    def _passes(self, element: Element) -> bool:
        found = self.find(element.factory)
        return found is not None and found.plugin == PASSING


def targets() -> list[str]:
    """Names of the registries that come with the package."""
    return sorted(path.name.removesuffix(ENDING) for path in PACKAGED.glob(f"*{ENDING}"))


@cache
def read_dump(target: str) -> Dump:
    """The registry of that name, or in that file.

    raises  ArgumentError
    """
    path = PACKAGED / f"{target}{ENDING}" if target in targets() else Path(target)
    known = f"must be one of {', '.join(targets())}, or a file that `tod-runner doctor registry=FILE` wrote"
    try:
        return msgspec.json.decode(lzma.decompress(path.read_bytes()), type=Dump)
    except FileNotFoundError:
        raise ArgumentError("target", target, known) from None
    except OSError as error:
        raise ArgumentError("target", target, f"cannot be read: {reason(error)}") from None
    except (lzma.LZMAError, msgspec.DecodeError) as error:
        raise ArgumentError("target", target, f"{known}: {error}") from None


def write_dump(path: Path, dump: Dump) -> None:
    """raises  RunError if the file cannot be written"""
    write_whole(path, lzma.compress(msgspec.json.encode(dump, order="sorted"), preset=9))
