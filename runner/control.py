"""Control link between operator and vehicle over MQTT: requests, replies, applied state, telemetry.

Topics of a vehicle are tod/<vehicle>/request, reply, state and telemetry. A request is an event of
schemas/event.schema.json with an `id` and without `t`, never retained; the vehicle stamps it on receipt and answers
with the same id: applied (read back from the elements), refused or timed out. State (decided and applied) and telemetry
are retained, so that who comes late knows them. Last wills say that a side is gone: the vehicle's state says
{"online": false}, the operator's request says operator_disconnected.
"""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Callable, Mapping
from typing import Any

from paho.mqtt.client import Client, MQTTMessageInfo
from paho.mqtt.enums import CallbackAPIVersion

from runner.errors import RunError
from runner.model import Endpoint
from runner.schema import read_json

CONNECT_S = 5.0
KEEPALIVE_S = 2  # the broker publishes a will after one and a half of these
OFFLINE = {"online": False}
OPERATOR_GONE = {"id": "will", "event": "operator_disconnected"}
RETAINED = ("state", "telemetry")
MAX_MESSAGE_BYTES = 65_536  # the longest event is a hundredth of it

Document = Mapping[str, Any]


class Link:
    """One side's connection to the broker; reconnects by itself. Callbacks come from the link's own thread.

    will       topic (below tod/<vehicle>/) and message, published when this side is lost
    listen     by topic, who takes its messages (bytes of JSON, not yet looked at)
    connected  told True and False as the connection comes and goes
    """

    def __init__(
        self,
        vehicle: str,
        broker: Endpoint,
        will: tuple[str, Document],
        listen: Mapping[str, Callable[[bytes], None]],
        connected: Callable[[bool], None],
    ) -> None:
        self._prefix = f"tod/{vehicle}/"
        self._listen = {self._prefix + topic: function for topic, function in listen.items()}
        self._connected = connected
        self._listening = threading.Event()
        client = Client(CallbackAPIVersion.VERSION2)
        topic, message = will
        client.will_set(self._prefix + topic, json.dumps(message), qos=1, retain=topic in RETAINED)
        client.on_socket_open = _no_delay
        client.on_connect = self._on_connect
        client.on_subscribe = lambda *_: self._listening.set()
        client.on_disconnect = lambda *_: connected(False)
        client.on_message = lambda _client, _data, message: self._listen[message.topic](bytes(message.payload))
        client.reconnect_delay_set(min_delay=1, max_delay=2)
        self._client, self._broker = client, broker

    def connect(self) -> None:
        """Connect, and from then on stay connected; returns when messages for this side will reach it.

        raises  RunError where nobody listens at the broker's address
        """
        broker = self._broker
        try:
            self._client.connect(broker.host, broker.port, KEEPALIVE_S)
        except OSError as error:
            rule = "start a broker there (mosquitto), or choose control.host and control.port"
            raise RunError(f"no MQTT broker at {broker.host}:{broker.port}: {error}; {rule}") from None
        self._client.loop_start()
        if not self._listening.wait(CONNECT_S):
            raise RunError(f"the MQTT broker at {broker.host}:{broker.port} does not let this side in")

    def publish(self, topic: str, message: Document) -> None:
        """Send a message; state and telemetry are kept by the broker for who comes later.

        Without a connection nothing is sent and nothing queued: who reconnects wants what is, not what was.
        """
        if self._client.is_connected():
            self._send(topic, message)

    def close(self, topic: str, message: Document) -> None:
        """Say goodbye as the will would have, and disconnect."""
        if self._client.is_connected():
            self._send(topic, message).wait_for_publish(1)
        self._client.disconnect()
        self._client.loop_stop()

    def _send(self, topic: str, message: Document) -> MQTTMessageInfo:
        qos = 0 if topic == "telemetry" else 1
        return self._client.publish(self._prefix + topic, json.dumps(message), qos=qos, retain=topic in RETAINED)

    def _on_connect(self, client: Client, _data: object, _flags: object, code: Any, _properties: object) -> None:
        if code.is_failure:
            return
        client.subscribe([(topic, 1) for topic in self._listen])
        self._connected(True)


def _no_delay(_client: object, _data: object, sock: Any) -> None:
    """Without this, small messages wait 20 ms for company (Nagle's algorithm)."""
    if isinstance(sock, socket.socket):
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


def read_message(payload: bytes) -> dict[str, Any]:
    """A mapping, as JSON from somebody who may send anything.

    raises  ValueError that says what is wrong
    """
    if len(payload) > MAX_MESSAGE_BYTES:
        raise ValueError(f"{len(payload)} bytes: must be at most {MAX_MESSAGE_BYTES}")
    try:
        document = read_json(payload)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"not JSON: {error}") from None
    if not isinstance(document, dict):
        raise ValueError("must be a mapping with id and event")
    return document


def read_request(payload: bytes) -> tuple[dict[str, Any], str, str]:
    """A request as it came: the event without its id, the id ("" if there is none), and what is wrong ("" if nothing).

    The event itself is checked when its time is known.
    """
    try:
        document = read_message(payload)
    except ValueError as problem:
        return {}, "", str(problem)
    identity = document.pop("id", None)
    if not isinstance(identity, str) or not identity:
        return document, "", "id: must be given, as text"
    if "t" in document:
        return document, identity, "t: must not be given, the vehicle stamps events on receipt"
    return document, identity, ""
