"""Bags of ROS 1."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from runner.bag.storage import Channel, Message, total

if TYPE_CHECKING:
    from rosbags.interfaces import Connection


class Ros1File:
    """An open bag of ROS 1, see `Storage`.

    raises  the library's exceptions if it is damaged, cut off or not indexed
    """

    def __init__(self, path: Path) -> None:
        from rosbags.rosbag1 import Reader

        self._reader = Reader(path)
        self._reader.open()
        self.counts = total((_channel(each), each.msgcount) for each in self._reader.connections if each.msgcount)
        self.start = self._reader.start_time if self.counts else 0

    def close(self) -> None:
        self._reader.close()

    def messages(self, topic: str) -> Iterator[Message]:
        connections = [connection for connection in self._reader.connections if connection.topic == topic]
        for connection, ns, data in self._reader.messages(connections) if connections else ():
            yield Message(ns, _channel(connection), data)


def _channel(connection: Connection) -> Channel:
    return Channel(connection.topic, connection.msgtype, "ros1", ("ros1msg", connection.msgdef.data))
