"""What every kind of bag file offers: its channels with their counts, and messages in the order of recording."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from heapq import heappop, heappush
from typing import NamedTuple, Protocol

# First bytes of the files.
MCAP, SQLITE, ROS1 = b"\x89MCAP0\r\n", b"SQLite format 3\0", b"#ROSBAG V"


class Channel(NamedTuple):
    """Messages of one type on one topic.

    kind        type of message, in the form of ROS 2 also of ROS 1: sensor_msgs/msg/Image; foxglove.CompressedVideo
    encoding    of the messages: cdr, ros1, protobuf, json
    definition  format and text of the definition of the type; ("", ""): the file has none
    """

    topic: str
    kind: str
    encoding: str
    definition: tuple[str, str]


class Message(NamedTuple):
    """ns: time of recording, ns since 1970."""

    ns: int
    channel: Channel
    data: bytes


class Storage(Protocol):
    """One open file of a bag.

    counts  number of messages, by channel
    start   time of the first message, ns since 1970; 0: there is none
    """

    @property
    def counts(self) -> Mapping[Channel, int]: ...

    @property
    def start(self) -> int: ...

    def messages(self, topic: str) -> Iterator[Message]:
        """Messages of a topic, in the order of their times of recording."""

    def close(self) -> None: ...


class UnreadableError(Exception):
    """A file that is whole, but cannot be read; the text says why."""


class Part(NamedTuple):
    """Messages in order of time.

    start  no message is earlier
    read   opens it; may be called again
    """

    start: int
    read: Callable[[], Iterator[Message]]


def merged(parts: Iterable[Part]) -> Iterator[Message]:
    """The messages of all parts in order of time. A part stays open only from its first message on.

    Its start may be that of other messages; then it is opened again at its own first one.
    """
    ranked = enumerate(sorted(parts, key=lambda part: part.start))
    waiting = [(part.start, rank, part.read) for rank, part in ranked]  # a heap
    heads: list[tuple[int, int, Message, Iterator[Message]]] = []
    while waiting or heads:
        if waiting and (not heads or waiting[0][0] <= heads[0][0]):
            start, rank, read = heappop(waiting)
            rest = read()
            following = next(rest, None)
            if following and waiting and following.ns > max(start, waiting[0][0]):
                heappush(waiting, (following.ns, rank, read))
                continue
        else:
            _, rank, message, rest = heappop(heads)
            yield message
            following = next(rest, None)
        if following:
            heappush(heads, (following.ns, rank, following, rest))


def total(counted: Iterable[tuple[Channel, int]]) -> dict[Channel, int]:
    """Messages by channel; several connections, or files, may have the same one."""
    counts: dict[Channel, int] = {}
    for channel, count in counted:
        counts[channel] = counts.get(channel, 0) + count
    return counts


def normal(kind: str) -> str:
    """A type of message as ROS 2 names it."""
    package, slash, name = kind.partition("/")
    return f"{package}/msg/{name}" if slash and "/" not in name else kind
