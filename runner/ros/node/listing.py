"""usage: python listing.py SECONDS

Run by a Python that has rclpy. Listens for so long and prints the topics of ROS 2 with pictures as a list of JSON
objects: name, kind, encoding, width, height, hz; width and height are 0 where messages do not state them.
"""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path
from typing import Any

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"


class Seen:
    """What has been received of one topic."""

    def __init__(self, name: str, kind: str) -> None:
        self._name, self._kind = name, kind
        self._last: Any = None
        self._times: list[float] = []

    def take(self, message: Any) -> None:
        self._last = message
        self._times.append(time.monotonic())

    def described(self) -> dict[str, Any]:
        last, times = self._last, self._times
        hz = (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 else 0.0
        encoding = getattr(last, "encoding", "") or getattr(last, "format", "")
        size = {"width": getattr(last, "width", 0), "height": getattr(last, "height", 0)}
        return {"name": self._name, "kind": self._kind, "encoding": encoding, **size, "hz": hz}


def listen(seconds: float) -> list[dict[str, Any]]:
    import rclpy
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import CompressedImage, Image

    messages = {IMAGE: Image, COMPRESSED: CompressedImage}
    rclpy.init(args=[])
    node = rclpy.create_node("tod_runner_doctor")
    seen: dict[str, Seen] = {}
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        for name, kinds in node.get_topic_names_and_types():
            kind = next((kind for kind in messages if kind in kinds), None)
            if kind and name not in seen and node.count_publishers(name):
                seen[name] = Seen(name, kind)
                node.create_subscription(messages[kind], name, seen[name].take, qos_profile_sensor_data)
        rclpy.spin_once(node, timeout_sec=0.1)
    return [seen[name].described() for name in sorted(seen)]


if __name__ == "__main__":
    # The modules of this directory may have the names of others, see __main__.py.
    sys.path[:] = [path for path in sys.path if path != str(Path(__file__).parent)]
    print(json.dumps(listen(float(sys.argv[1]))), flush=True)
    os._exit(0)  # some middleware's threads would keep the process alive
