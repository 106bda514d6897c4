"""usage: python ros_publisher.py WIDTH HEIGHT BITS

Run by a Python that has rclpy or rospy. Each line on standard input is a JSON object for one topic; a later one for the
same topic changes it. Without further keys it has numbered pictures, as `numbered.numbered`, with correct stamps.

    topic      its name
    fps        pictures a second; 0: no pictures and no publisher
    encoding   bgr8
    half       true: pictures of half the size
    late_s     by how much stamps are behind the clock; null: no stamps
    reliability, durability   of the publisher, in ROS 2
    file, width, height, step, big   publish the bytes of this file instead, as sensor_msgs/Image
    format     publish the bytes of the file as sensor_msgs/CompressedImage

Each picture with a number is reported on standard output as JSON: topic, number, stamp in ns. Ends with its input.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
from ros_either import Node, set_stamp
from sensor_msgs.msg import CompressedImage, Image

WIDTH, HEIGHT, BITS = map(int, sys.argv[1:])


class Camera:
    def __init__(self, node: Node, **settings: object) -> None:
        self.node, self.number = node, -1
        self.settings = {"encoding": "bgr8", "late_s": 0.0} | settings
        self.kind = CompressedImage if "format" in settings else Image
        qos = {key: settings[key] for key in ("reliability", "durability") if key in settings}
        self.publisher = node.publisher(self.kind, settings["topic"], depth=1, **qos)
        self.timer = node.every(1 / settings["fps"], self.publish)

    def publish(self) -> None:
        settings, message = self.settings, self.kind()
        stamp = 0 if settings["late_s"] is None else time.time_ns() - round(1e9 * settings["late_s"])
        set_stamp(message, stamp)
        if "file" in settings:
            self.fill(message)
        else:
            self.draw(message)
        with suppress(RuntimeError):  # a reliable subscriber that has not run for 0.1 s
            self.publisher.publish(message)
            if self.number >= 0:
                print(json.dumps([settings["topic"], self.number, stamp]), flush=True)

    def fill(self, message: Image | CompressedImage) -> None:
        settings = self.settings
        message.data = Path(settings["file"]).read_bytes()
        if "format" in settings:
            message.format = settings["format"]
            return
        message.encoding, message.is_bigendian = settings["encoding"], int(settings.get("big", False))
        message.width, message.height, message.step = settings["width"], settings["height"], settings["step"]

    def draw(self, message: Image) -> None:
        self.number = (self.number + 1) % 2**BITS
        bars = [255 if self.number >> bit & 1 else 0 for bit in range(BITS)]
        part = 2 if self.settings.get("half") else 1
        width, height = WIDTH // part, HEIGHT // part
        row = np.repeat(np.repeat(np.array(bars, np.uint8), width // BITS), 3)
        message.encoding, message.width, message.height = self.settings["encoding"], width, height
        message.step, message.data = 3 * width, np.tile(row, height).tobytes()

    def end(self) -> None:
        self.node.stop(self.timer)
        self.node.withdraw(self.publisher)


def main() -> None:
    node = Node("cameras")
    cameras: dict[str, Camera] = {}
    orders: list[dict] = []
    ended = threading.Event()

    def read() -> None:
        for line in sys.stdin:
            orders.append(json.loads(line))
        ended.set()

    def handle_orders() -> None:
        while orders:
            settings = orders.pop(0)
            before = cameras.pop(settings["topic"], None)
            if before:
                before.end()
            if settings["fps"]:
                cameras[settings["topic"]] = Camera(node, **settings)

    node.every(0.02, handle_orders)
    threading.Thread(target=read, daemon=True).start()
    node.run(ended)


main()
