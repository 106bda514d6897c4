"""usage: python ros_client.py NODE TOPIC ...

Run by a Python that has rclpy or rospy: a node that subscribes to topics of type std_msgs/String. Each line on standard
input is JSON with topic and one of these:

    text, number, fix ([latitude, longitude, status]), region ([x, y, width, height]),
    seen (the same, and width and height on the screen), empty
            to be published once somebody has subscribed to the topic
    call    the argument of std_srvs/SetBool, or null for std_srvs/Trigger: a call of that service, once it is offered

Topics that end in /image and /camera_info are of sensor_msgs. Each message is printed to standard output as JSON:
topic, text, or a mapping of the relevant fields; each answer: service, [success, message]. Ends with its input.
"""

from __future__ import annotations

import json
import sys
import threading
from functools import partial

import numpy as np
from ros_either import Node, stamp_s
from sensor_msgs.msg import CameraInfo, Image, NavSatFix, RegionOfInterest
from std_msgs.msg import Empty, Float64, String
from std_srvs.srv import SetBool, Trigger


def region_of(values: list[int]) -> RegionOfInterest:
    return RegionOfInterest(**dict(zip(("x_offset", "y_offset", "width", "height"), values, strict=True)))


def message_of(order: dict) -> object:
    if "empty" in order:
        return Empty()
    if "region" in order:
        return region_of(order["region"])
    if "text" in order:
        return String(data=order["text"])
    if "seen" in order:
        *region, width, height = order["seen"]
        return CameraInfo(roi=region_of(region), width=width, height=height)
    if "number" in order:
        return Float64(data=order["number"])
    fix = NavSatFix(latitude=order["fix"][0], longitude=order["fix"][1])
    fix.status.status = order["fix"][2]
    return fix


def what(message: object) -> object:
    if isinstance(message, String):
        return message.data
    header = message.header
    known = {"stamp": stamp_s(message), "frame_id": header.frame_id, "width": message.width, "height": message.height}
    if isinstance(message, Image):
        rows = np.frombuffer(message.data, np.uint8).reshape(message.height, message.step)
        bright = np.argwhere(rows[:, : 3 * message.width : 3] > 128)
        spot = bright.mean(0)[::-1].tolist() if len(bright) else None  # its centre, x and y
        return {**known, "encoding": message.encoding, "spot": spot}
    k, d = (getattr(message, name if hasattr(message, name) else name.upper()) for name in "kd")
    return {**known, "model": message.distortion_model, "k": list(k), "d": list(d)}


def tell(*line: object) -> None:
    sys.stdout.write(json.dumps(line) + "\n")
    sys.stdout.flush()


def main(name: str, *topics: str) -> None:
    node = Node(name)
    ended = threading.Event()
    orders, publishers = [], {}

    for topic in topics:
        kind = {"image": Image, "camera_info": CameraInfo}.get(topic.rpartition("/")[2], String)

        def take(message: object, topic: str = topic) -> None:
            tell(topic, what(message))

        node.subscribe(kind, topic, take, kept="url" in topic or "state" in topic)

    def answered(service: str, answer: object) -> None:
        tell(service, [answer.success, answer.message])

    def call(order: dict) -> bool:
        kind, service = Trigger if order["call"] is None else SetBool, order["topic"]
        values = {} if order["call"] is None else {"data": order["call"]}
        return node.call(kind, service, values, partial(answered, service))

    def publish(order: dict) -> bool:
        message, topic = message_of(order), order["topic"]
        if topic not in publishers:
            publishers[topic] = node.publisher(type(message), topic)
        if node.subscribers(publishers[topic]):
            publishers[topic].publish(message)
            return True
        return False

    def obey() -> None:
        for order in tuple(orders):
            if call(order) if "call" in order else publish(order):
                orders.remove(order)

    def read() -> None:
        for line in sys.stdin:
            orders.append(json.loads(line))
        ended.set()

    node.every(0.02, obey)
    threading.Thread(target=read, daemon=True).start()
    node.run(ended)


main(*sys.argv[1:])
