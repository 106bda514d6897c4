"""Delay of the control link on loopback: half the time from a request to its reply, through a real broker.

python bench/link.py
"""

from __future__ import annotations

import json
import queue
import socket
import time

from table import Row, show, spread

from runner.mqtt.broker import private_broker
from runner.mqtt.link import ControlLink
from runner.mqtt.messages import OFFLINE, OPERATOR_GONE, MqttMessage, topic
from runner.settings import Endpoint

ROUNDS = 1000


def rows() -> list[Row]:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        broker = Endpoint("127.0.0.1", probe.getsockname()[1])
    replies: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    with private_broker(broker):
        state, request, reply = (topic("bench", *parts) for parts in (("state",), ("request", "op"), ("reply", "op")))

        def on_request(message: MqttMessage) -> None:
            vehicle.publish(reply, {"id": json.loads(message.payload)["id"], "result": "applied", "reason": ""})

        vehicle = ControlLink(broker, (state, OFFLINE), {request: on_request}, lambda connected: None, print)
        operator = ControlLink(
            broker, (request, OPERATOR_GONE), {reply: lambda m: replies.put(m.payload)}, lambda connected: None, print
        )
        for link in (vehicle, operator):
            link.connect()
            link.wait_connected(5)
        waits = []
        for number in range(ROUNDS):
            began = time.perf_counter()
            operator.publish(request, {"id": str(number), "event": "total_set", "kbps": 4000})
            replies.get(timeout=5)
            waits.append(1000 * (time.perf_counter() - began) / 2)
            time.sleep(0.002)
        operator.close((request, OPERATOR_GONE))
        vehicle.close((state, OFFLINE))
    return [spread("control link, one way", waits, "ms")]


if __name__ == "__main__":
    show(rows())
