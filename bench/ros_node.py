"""usage: python ros_node.py publish FILE WIDTH HEIGHT FPS TOPIC ...
       python ros_node.py subscribe TOPIC ...

Run by a Python that has rclpy or rospy; see ros.py. `publish` loops a file of BGR pictures on all topics
simultaneously, once each has a subscriber; in ROS 2 reliable. `subscribe` receives pictures. Both end when standard
input ends, and then print JSON: by topic a list with the stamp of each picture, s; `subscribe` also its width, height
and latency, s.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from functools import partial
from pathlib import Path
from typing import Any

from ros_either import Node, as_data, set_stamp, stamp_s
from sensor_msgs.msg import Image

DEPTH = 5


class Publisher:
    def __init__(self, node: Any, file: str, width: str, height: str, fps: str, *topics: str) -> None:
        self._node, self._width, self._height = node, int(width), int(height)
        size, data = 3 * self._width * self._height, Path(file).read_bytes()
        self._pictures = [as_data(data[at : at + size]) for at in range(0, len(data), size)]
        self._publishers = {topic: node.publisher(Image, topic, depth=DEPTH) for topic in topics}
        self._next = 0
        self.seen: dict[str, list[float]] = {topic: [] for topic in topics}
        node.every(1 / float(fps), self._publish)

    def _publish(self) -> None:
        if not self._next and not all(map(self._node.subscribers, self._publishers.values())):
            return
        for number, (topic, publisher) in enumerate(self._publishers.items()):
            message = Image(encoding="bgr8", width=self._width, height=self._height, step=3 * self._width)
            set_stamp(message, time.time_ns())
            message.data = self._pictures[(self._next + 7 * number) % len(self._pictures)]
            publisher.publish(message)
            self.seen[topic].append(stamp_s(message))
        self._next += 1


class Subscriber:
    def __init__(self, node: Any, *topics: str) -> None:
        self.seen: dict[str, list[Any]] = {topic: [] for topic in topics}
        for topic in topics:
            node.subscribe(Image, topic, partial(self._on_picture, topic))

    def _on_picture(self, topic: str, message: Image) -> None:
        stamp = stamp_s(message)
        self.seen[topic].append([stamp, message.width, message.height, time.time() - stamp])


def main(what: str, *words: str) -> None:
    node, ended = Node(f"bench_{what}"), threading.Event()
    role = Publisher(node, *words) if what == "publish" else Subscriber(node, *words)

    def wait() -> None:
        sys.stdin.read()
        ended.set()

    def report() -> None:
        sys.stdout.write(json.dumps(role.seen) + "\n")
        sys.stdout.flush()

    threading.Thread(target=wait, daemon=True).start()
    node.run(ended, report)


main(*sys.argv[1:])
