"""usage: python ros_node.py publish FILE WIDTH HEIGHT FPS TOPIC ...
       python ros_node.py subscribe TOPIC ...

Run by a Python that has rclpy; see ros.py. `publish` plays a file of BGR pictures, again and again, on all topics at
once, reliable, from when each has a subscriber. `subscribe` takes pictures. Both end with their input, and then print
JSON: by topic a list with the stamp of each picture, s; `subscribe` also its width, height and latency, s.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from array import array
from functools import partial
from pathlib import Path
from typing import Any

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import Image

DEPTH = 5


class Publisher:
    def __init__(self, node: Node, file: str, width: str, height: str, fps: str, *topics: str) -> None:
        self._node, self._width, self._height = node, int(width), int(height)
        size, data = 3 * self._width * self._height, Path(file).read_bytes()
        self._pictures = [array("B", data[at : at + size]) for at in range(0, len(data), size)]
        self._publishers = {topic: node.create_publisher(Image, topic, DEPTH) for topic in topics}
        self._next = 0
        self.seen: dict[str, list[float]] = {topic: [] for topic in topics}
        node.create_timer(1 / float(fps), self._publish)

    def _publish(self) -> None:
        if not self._next and not all(one.get_subscription_count() for one in self._publishers.values()):
            return
        for number, (topic, publisher) in enumerate(self._publishers.items()):
            message = Image(encoding="bgr8", width=self._width, height=self._height, step=3 * self._width)
            message.header.stamp = self._node.get_clock().now().to_msg()
            message.data = self._pictures[(self._next + 7 * number) % len(self._pictures)]
            publisher.publish(message)
            self.seen[topic].append(stamp_of(message))
        self._next += 1


class Subscriber:
    def __init__(self, node: Node, *topics: str) -> None:
        self.seen: dict[str, list[Any]] = {topic: [] for topic in topics}
        for topic in topics:
            node.create_subscription(Image, topic, partial(self._take, topic), DEPTH)

    def _take(self, topic: str, message: Image) -> None:
        stamp = stamp_of(message)
        self.seen[topic].append([stamp, message.width, message.height, time.time() - stamp])


def stamp_of(message: Image) -> float:
    return float(message.header.stamp.sec + message.header.stamp.nanosec / 1e9)


def main(what: str, *words: str) -> None:
    rclpy.init()
    node = rclpy.create_node(f"bench_{what}")
    one = Publisher(node, *words) if what == "publish" else Subscriber(node, *words)
    executor, ended = SingleThreadedExecutor(), threading.Event()
    executor.add_node(node)

    def wait() -> None:
        sys.stdin.read()
        ended.set()

    threading.Thread(target=wait, daemon=True).start()
    while not ended.is_set():
        executor.spin_once(timeout_sec=0.2)
    print(json.dumps(one.seen))


main(*sys.argv[1:])
