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

from runner.bag.files import METADATA, SUFFIXES, BagFiles, is_named_like_a_bag
from runner.bag.messages import Decoder, decoder
from runner.bag.pictures import BadPicture, Picture, read_compressed, read_image, stamp_ns
from runner.bag.storage import Channel, UnreadableError
from runner.core.model import DEPTH_M, ModelError
from runner.errors import reason, suggest
from runner.system.clocks import SECOND_NS
from runner.system.files import directory_problem, file_problem

if TYPE_CHECKING:
    from typing import Self

PICTURES: dict[str, Callable[[Any, float], Picture]] = {  # by type of message, also of ROS 1
    "sensor_msgs/msg/Image": read_image,
    "foxglove.RawImage": read_image,
    "foxglove_msgs/msg/RawImage": read_image,
    "sensor_msgs/msg/CompressedImage": read_compressed,
    "foxglove.CompressedImage": read_compressed,
    "foxglove_msgs/msg/CompressedImage": read_compressed,
    "foxglove.CompressedVideo": read_compressed,
    "foxglove_msgs/msg/CompressedVideo": read_compressed,
    "ffmpeg_image_transport_msgs/msg/FFMPEGPacket": read_compressed,
}
POSITIONS = ("sensor_msgs/msg/NavSatFix", "foxglove.LocationFix", "foxglove_msgs/msg/LocationFix")
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
    return is_named_like_a_bag(path) if path.is_file() else (path / METADATA).is_file()


class Bag:
    """An open bag.

    path    a ROS 1 bag, the directory of a ROS 2 bag, or one of its files: MCAP or SQLite
    topics  message type by topic, for topics that have messages
    raises  ModelError with the key `bag` on opening, or `topic` while reading: file, topic and the broken rule
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        _check_path(path)
        with _readable("bag", str(path)):
            self._files = BagFiles(path)
        self.topics: dict[str, str] = {}
        for channel in self._files.counts:  # of several types, the one that can be shown
            if channel.kind in (*PICTURES, *POSITIONS) or channel.topic not in self.topics:
                self.topics[channel.topic] = channel.kind
        self._decoders: dict[Channel, Decoder] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._files.close()

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

    def pictures(self, topic: str, depth_m: float = DEPTH_M) -> Iterator[Picture | BadPicture]:
        """The pictures of a topic, in the order of recording; those that cannot be shown do not hide the others.

        depth_m  distance that is white in a picture of distances
        """
        read = PICTURES[self.topics[topic]]
        started = False  # whether a picture of video has come with which decoding can start
        for number, (ns, message) in enumerate(self._messages(topic), 1):
            try:
                if isinstance(message, ValueError):
                    raise message
                picture = read(message, depth_m)
            except ValueError as error:
                yield BadPicture(number, str(error))
                continue
            except AttributeError as error:  # a type of the same name with other fields
                yield BadPicture(number, f"a message of type {self.topics[topic]} without the field {error.name}")
                continue
            started = started or picture.key
            if not started:
                yield BadPicture(number, f"a picture of {picture.format} before the first key picture")
                continue
            yield picture if picture.ns else picture.at(ns)

    def positions(self, topic: str) -> Iterator[Fix]:
        """The positions of a topic, in recording order, except those without a fix."""
        for logged, message in self._messages(topic):
            if isinstance(message, ValueError):
                raise ModelError("topic", self.names(topic), str(message))
            fix = Fix(stamp_ns(message) or logged, message.latitude, message.longitude)
            # Below 0 are STATUS_NO_FIX and STATUS_UNKNOWN of sensor_msgs/NavSatStatus; Foxglove's type has no status.
            fixed = not hasattr(message, "status") or message.status.status >= 0
            if fixed and math.isfinite(fix.lat) and math.isfinite(fix.lon):
                yield fix

    def form(self, topic: str) -> PictureForm:
        """Size and rate of the first pictures of a topic.

        raises  ModelError, also if there are fewer than two
        """
        shown = (picture for picture in self.pictures(topic) if isinstance(picture, Picture))
        first = next(shown, None)
        times = [first.ns, *(picture.ns for picture in islice(shown, SURVEYED - 1))] if first else []
        steps = [later - earlier for earlier, later in pairwise(times) if later > earlier]
        if first is None or not steps:
            raise ModelError("topic", self.names(topic), "must have two pictures with different times")
        return PictureForm(first.format, first.width, first.height, _rate(SECOND_NS / median(steps)))

    def names(self, topic: str) -> str:
        """File and topic, for error messages."""
        return f"{self.path}: {topic}"

    def _messages(self, topic: str) -> Iterator[tuple[int, Any]]:
        """Messages of a topic, with the times at which they were recorded, ns since 1970; a ValueError: it is damaged.

        raises  ModelError also if there are fewer than the file, or the bag's metadata, says
        """
        kind, read = self.topics[topic], 0
        expected = sum(count for c, count in self._files.counts.items() if (c.topic, c.kind) == (topic, kind))
        with _readable("topic", self.names(topic)):
            if expected < (stated := self._files.stated.get((topic, kind), 0)):
                raise UnreadableError(f"{METADATA} states {stated} messages of this topic, and its files {expected}")
            for ns, channel, data in self._files.messages(topic):
                if channel.kind == kind:
                    read += 1
                    yield ns, self._decoded(channel, data)
            if read != expected:
                raise ValueError(f"it states {expected} messages of this topic, and has {read}")

    def _decoded(self, channel: Channel, data: bytes) -> Any:
        if channel not in self._decoders:
            self._decoders[channel] = decoder(channel)
        try:
            return self._decoders[channel](data)
        except ValueError as error:
            return error


def check_topic(path: Path, topic: str | None) -> None:
    """Check, by its first pictures, that a topic of a bag has pictures of a supported kind.

    raises  ModelError with the key `bag` or `topic`, if none of them can be shown
    """
    with Bag(path) as bag:
        known = bag.of(PICTURES)
        if topic is None and known:
            raise ModelError("topic", str(path), f"must be given, a topic with pictures: {', '.join(known)}")
        found = bag.find(PICTURES, topic, "pictures")
        bad: BadPicture | None = None
        for picture in islice(bag.pictures(found), SURVEYED):
            if isinstance(picture, Picture):
                return
            bad = bad or picture
        assert bad  # a topic of a bag has messages
        raise ModelError("topic", bag.names(found), f"picture {bad.number}: {bad.why}")


def _check_path(path: Path) -> None:
    if (why := file_problem(path)) and directory_problem(path):
        raise ModelError("bag", str(path), why)
    if path.is_dir() and not (path / METADATA).is_file():
        files = sorted(file.name for file in path.iterdir() if is_named_like_a_bag(file))
        name = f"; a recorder that was killed writes none: name its file, {', '.join(files)}" if files else ""
        raise ModelError("bag", str(path), f"has no {METADATA}, which makes a directory a ROS 2 bag{name}")
    if path.is_file() and not is_named_like_a_bag(path):
        kinds = f"a file *{', *'.join(SUFFIXES)}, or the directory of a ROS 2 bag"
        raise ModelError("bag", str(path), f"must be a bag: {kinds}")


@contextmanager
def _readable(key: str, found: str) -> Iterator[None]:
    """Convert errors of files: the libraries' parsers raise many kinds of exceptions at damaged ones."""
    try:
        yield
    except (ImportError, ModelError):
        raise
    except UnreadableError as error:
        raise ModelError(key, found, f"cannot be read: {error}") from None
    except OSError as error:
        raise ModelError(key, found, f"cannot be read: {reason(error)}") from None
    except Exception as error:
        why = " ".join(str(error).split()).rstrip(".") or type(error).__name__
        raise ModelError(key, found, f"cannot be read, damaged or cut off: {why}") from None


def _rate(measured: float) -> Fraction:
    """A measured rate, rounded if it is close to a whole number."""
    whole = round(measured)
    if whole and abs(measured - whole) <= ROUND * whole:
        return Fraction(whole)
    return Fraction(round(measured, 2)).limit_denominator(100)
