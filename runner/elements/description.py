"""What a registry tells of elements; checks of plans know nothing else of GStreamer."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from runner.core.model import Element

SINK, SRC = "sink", "src"


class EnumValue(NamedTuple):
    """One value of an enumeration, or one flag: "zerolatency", 4, "Zero latency" of x264enc's tune."""

    nick: str
    number: int
    name: str


@dataclass(frozen=True, slots=True)
class Property:
    """A property of an element.

    type         GObject's name of its type: gint, GstCaps, GstX264EncTune
    least, most  its range; None: it is no number
    enum, flags  the values of an enumeration, or of flags
    writable     whether it can be set
    playing      whether it is declared to be mutable while PLAYING
    """

    type: str
    least: int | float | None = None
    most: int | float | None = None
    enum: tuple[EnumValue, ...] = ()
    flags: tuple[EnumValue, ...] = ()
    writable: bool = True
    playing: bool = False


@dataclass(frozen=True, slots=True)
class Pad:
    """A pad, or a template of pads: "src", "send_rtp_src_%u".

    direction  SINK or SRC
    media      names of the media types that it carries; None: any
    """

    name: str
    direction: str
    media: tuple[str, ...] | None = None


@dataclass(frozen=True, slots=True)
class Factory:
    """What makes an element: its class ("Codec/Encoder/Video"), rank, plugin and pads."""

    klass: str
    rank: int
    plugin: str
    pads: tuple[Pad, ...]


class Registry(ABC):
    """The elements of one machine.

    name    in messages; "": it is this machine's
    origin  for people, where it comes from; "": it is this machine's
    """

    name: str = ""
    origin: str = ""

    @abstractmethod
    def names(self) -> Iterable[str]:
        """Names of all elements."""

    @abstractmethod
    def has_plugin(self, name: str) -> bool:
        """Whether a plugin is installed, with or without elements."""

    @abstractmethod
    def find(self, element: str) -> Factory | None:
        """The factory of an element; None: there is no such element."""

    @abstractmethod
    def properties(self, element: str) -> Mapping[str, Property]:
        """The properties of an element that exists, by name."""

    @abstractmethod
    def alike(self, klass: str) -> Iterable[str]:
        """Elements of a class that GStreamer may choose itself, those of the highest rank first."""

    @abstractmethod
    def reads(self, type_name: str, text: str) -> bool:
        """Whether a text is a value of a type other than a number, a truth value, a text, an enumeration or flags."""

    @abstractmethod
    def link_problem(self, elements: Sequence[Element]) -> str | None:
        """Why neighbours cannot be linked, as GStreamer words it; None if they can, as far as known."""
