"""ROS 1 and ROS 2 bags, and MCAP, read without ROS: topics, pictures, positions. No GStreamer."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from itertools import islice, pairwise
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any, NamedTuple

from runner.bag.pictures import SECOND_NS, Picture, read_compressed, read_image, stamp_ns
from runner.core.model import ModelError, suggest

if TYPE_CHECKING:
    from typing import Self

    from rosbags.highlevel import AnyReader

METADATA = "metadata.yaml"  # makes a directory a ROS 2 bag
SUFFIXES = (".bag", ".mcap", ".db3")
PICTURES: dict[str, Callable[[Any], Picture]] = {  # by type of message, also of ROS 1
    "sensor_msgs/msg/Image": read_image,
    "sensor_msgs/msg/CompressedImage": read_compressed,
}
POSITIONS = ("sensor_msgs/msg/NavSatFix",)
NO_FIX = -1  # STATUS_NO_FIX of sensor_msgs/NavSatStatus
SURVEYED = 100  # pictures from whose times a rate is estimated
ROUND = 0.01  # a measured rate this close to a whole number, as a share, is rounded to it


class Fix(NamedTuple):
    """A position.

    ns        its time, ns since 1970
    lat, lon  degrees, WGS-84
    """

    ns: int
    lat: float
    lon: float


@dataclass(frozen=True, slots=True)
class PictureForm:
    """Format, size and rate of the pictures of a topic.

    format         as in `Picture`
    width, height  px
    fps            Hz, from the times of the first pictures
    """

    format: str
    width: int
    height: int
    fps: Fraction


def is_bag(path: Path) -> bool:
    """Whether a path names a bag: its files' suffixes, or the directory of a ROS 2 bag."""
    return path.suffix in SUFFIXES if path.is_file() else (path / METADATA).is_file()


class Bag:
    """An open bag.

    path    a ROS 1 bag, the directory of a ROS 2 bag, or one of its files: MCAP or SQLite
    topics  message type by topic, for topics that have messages
    raises  ModelError with the key `bag` on opening, or `topic` while reading: file, topic and the broken rule
    """

    def __init__(self, path: Path) -> None:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore

        self.path = path
        _check_path(path)
        with _readable("bag", str(path)):
            # Bags of older ROS 2 versions do not contain the definitions of their messages.
            self._reader: AnyReader = AnyReader([path], default_typestore=get_typestore(Stores.LATEST))
            self._reader.open()
            self.topics = {c.topic: c.msgtype for c in self._reader.connections if c.msgcount}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._reader.close()

    def of(self, kinds: Collection[str]) -> list[str]:
        """Topics with messages of these types."""
        return sorted(topic for topic, kind in self.topics.items() if kind in kinds)

    def find(self, kinds: Collection[str], topic: str | None, what: str) -> str:
        """The topic with messages of these types: the given one, otherwise the only one.

        what    its content, for error messages
        raises  ModelError
        """
        known = self.of(kinds)
        if not known:
            raise ModelError("topic", str(self.path), f"has no {what}")
        if topic is None and len(known) > 1:
            raise ModelError("topic", str(self.path), f"must be given: one of {', '.join(known)}")
        if topic is not None and topic not in known:
            raise ModelError("topic", self.names(topic), f"no such topic with {what}{suggest(topic, known)}")
        return topic or known[0]

    def pictures(self, topic: str) -> Iterator[Picture]:
        """The pictures of a topic, in recording order."""
        read = PICTURES[self.topics[topic]]
        for ns, message in self._messages(topic):
            try:
                picture = read(message)
            except ValueError as error:
                raise ModelError("topic", self.names(topic), str(error)) from None
            yield picture if picture.ns else picture.at(ns)

    def positions(self, topic: str) -> Iterator[Fix]:
        """The positions of a topic, in recording order, except those without a fix."""
        for logged, message in self._messages(topic):
            fix = Fix(stamp_ns(message) or logged, message.latitude, message.longitude)
            if message.status.status != NO_FIX and math.isfinite(fix.lat) and math.isfinite(fix.lon):
                yield fix

    def form(self, topic: str) -> PictureForm:
        """Size and rate of the first pictures of a topic.

        raises  ModelError, also if there are fewer than two
        """
        first = list(islice(self.pictures(topic), SURVEYED))
        steps = [later.ns - earlier.ns for earlier, later in pairwise(first) if later.ns > earlier.ns]
        if not steps:
            raise ModelError("topic", self.names(topic), "must have two pictures with different times")
        return PictureForm(first[0].format, first[0].width, first[0].height, _rate(SECOND_NS / median(steps)))

    def names(self, topic: str) -> str:
        """File and topic, for error messages."""
        return f"{self.path}: {topic}"

    def _messages(self, topic: str) -> Iterator[tuple[int, Any]]:
        """Messages of a topic, with the times at which they were recorded, ns since 1970."""
        with _readable("topic", self.names(topic)):
            connections = [connection for connection in self._reader.connections if connection.topic == topic]
            for connection, ns, data in self._reader.messages(connections):
                yield ns, self._reader.deserialize(data, connection.msgtype)


def check_topic(path: Path, topic: str | None) -> None:
    """Check, by its first picture, that a topic of a bag has pictures of a supported kind.

    raises  ModelError with the key `bag` or `topic`
    """
    with Bag(path) as bag:
        known = bag.of(PICTURES)
        if topic is None and known:
            raise ModelError("topic", str(path), f"must be given, a topic with pictures: {', '.join(known)}")
        next(bag.pictures(bag.find(PICTURES, topic, "pictures")))


def _check_path(path: Path) -> None:
    if not path.exists():
        raise ModelError("bag", str(path), "no such file")
    if path.is_dir() and not (path / METADATA).is_file():
        raise ModelError("bag", str(path), f"has no {METADATA}, which makes a directory a ROS 2 bag")
    if path.is_file() and path.suffix not in SUFFIXES:
        kinds = f"a file *{', *'.join(SUFFIXES)}, or the directory of a ROS 2 bag"
        raise ModelError("bag", str(path), f"must be a bag: {kinds}")


@contextmanager
def _readable(key: str, found: str) -> Iterator[None]:
    """Convert errors of damaged files: the library's parsers raise many kinds of exceptions."""
    try:
        yield
    except (ImportError, ModelError):
        raise
    except Exception as error:
        raise ModelError(key, found, f"cannot be read, damaged or cut off: {_reason(error)}") from None


def _reason(error: Exception) -> str:
    return " ".join(str(error).split()).rstrip(".") or type(error).__name__


def _rate(measured: float) -> Fraction:
    """A measured rate, rounded if it is close to a whole number."""
    whole = round(measured)
    if whole and abs(measured - whole) <= ROUND * whole:
        return Fraction(whole)
    return Fraction(round(measured, 2)).limit_denominator(100)
