"""The control link of a vehicle as ROS topics and services: state out, requests in, answers out."""

from __future__ import annotations

import itertools
import json
import math
import threading
import time
import uuid
from collections.abc import Callable, Mapping
from typing import Any

from msgspec import UNSET

from runner.graph import rtsp_url
from runner.mqtt.copies import Newest
from runner.mqtt.link import ControlLink, login_of
from runner.mqtt.messages import (
    OPERATOR_GONE,
    SIGNED_OFF,
    SILENT_S,
    MqttMessage,
    answer_s,
    read_message,
    read_reply,
    read_state,
    read_telemetry,
    topic,
)
from runner.records import to_json
from runner.records.vehicle import UplinkLost, VehicleState
from runner.ros.inputs import PRESENCE, OperatorInput, check_names, input_services, input_topics, ros_name
from runner.ros.process import Message, NodeProcess
from runner.security.keyring import Keyring
from runner.settings import Setup
from runner.system.reports import LimitedReports

REQUEST, REPLY, STATE, TELEMETRY, URL = "~/request", "~/reply", "~/state", "~/telemetry", "~/url"
DRIVING = "~/driving"
EVERY_S = 0.1  # between two positions, and between two predictions
OFFLINE = '{"online": false}'


class Bridge:
    """One end of a vehicle's control link, and a ROS node, from `start` until `close`.

    keyring    name and role of the requests' sender; None: for a broker without authentication, with a random id
    on_report  called with one line on what is wrong, from any thread

    It does not by itself report that an operator is present. The sender of requests does, with the event
    operator_connected or messages on PRESENCE. If it also reports positions or predictions, it refuses these, since
    the vehicle takes any message from it as a sign that the operator is still present.
    """

    def __init__(self, setup: Setup, keyring: Keyring | None, on_report: Callable[[str], None]) -> None:
        vehicle, ros = setup.vehicle, setup.ros
        check_names(vehicle)
        self._prediction, self._on_report = ros.prediction, on_report
        self._report_refusal, self._report_publisher = LimitedReports(on_report), LimitedReports(on_report)
        control, login = setup.control, login_of(setup.control, keyring, on_report)
        self.identity = login.identity if login and login.identity else uuid.uuid4().hex[:12]
        self._vehicle_time = (0.0, -math.inf)  # in the newest telemetry, and when it arrived by time.monotonic
        self._answer_s = answer_s(setup.expires_s)
        self._has_keys = keyring is not None
        self._pending: dict[str, float] = {}  # by id of a request, until when it may be answered
        self._calls: dict[str, str] = {}  # by id of a request, the service call that waits for its answer
        self._numbers = itertools.count(1)  # of requests without an id of their own
        self._topics, self._services = input_topics(vehicle), input_services(vehicle)
        self._reports = bool(ros.position or ros.prediction)
        self._due: dict[str, float] = {}  # by event, when the next may be sent
        self._lock = threading.Lock()  # of the next four
        self._state = OFFLINE  # the newest from the vehicle
        self._driving = OFFLINE  # who drives, by that state
        self._is_shown = True  # whether they were published last; OFFLINE is, once the vehicle has been silent
        self._shown_driving = ""  # as published last
        self._state_time = -math.inf  # when it arrived by time.monotonic
        self._newest = Newest()
        self._requests = topic(vehicle.name, "request", self.identity)
        listen = {
            topic(vehicle.name, "state"): self._on_state,
            topic(vehicle.name, "telemetry"): self._on_telemetry,
            topic(vehicle.name, "reply", self.identity): self._on_reply,
        }
        # With keys an operator's side may have the same name; after a crash its silence shows that it is gone.
        will = None if self._has_keys else (self._requests, OPERATOR_GONE)
        self._link = ControlLink(control, will, listen, self._on_connected, on_report, login, prefix=control.prefix)
        inputs = {REQUEST: "text", **{name: operator_input.kind for name, operator_input in self._topics.items()}}
        if not self._reports:
            inputs[PRESENCE] = "sign"
        if ros.position:
            inputs[ros.position] = "fix"
        if ros.prediction:
            inputs[ros.prediction.topic] = "newest_number"
        self._urls = {
            f"{URL}/{ros_name(name)}": rtsp_url(setup.media, name)
            for name, camera in vehicle.cameras.items()
            if camera.graph.transport == "rtsp"
        }
        self._node = NodeProcess(
            ros,
            self._on_message,
            self._on_node_report,
            inputs=inputs,
            outputs={REPLY: False, TELEMETRY: False, STATE: True, DRIVING: True, **dict.fromkeys(self._urls, True)},
            services={name: operator_input.kind for name, operator_input in self._services.items()},
            insecure=setup.insecure,
        )

    def start(self) -> None:
        """raises RunError if the node does not start"""
        self._node.start()
        for name, url in self._urls.items():
            self._node.publish(name, url)
        self._show(OFFLINE, OFFLINE)
        self._link.connect()

    def close(self) -> None:
        # With keys an operator's side may have the same name, and goes on.
        self._link.close(*([] if self._has_keys else [(self._requests, SIGNED_OFF)]))
        self._node.close()

    def time_out(self) -> None:
        """Answer requests that the vehicle has not answered, and publish that it is offline once it has been silent.

        To be called a few times a second.
        """
        self._link.check()
        now = time.monotonic()
        with self._lock:
            if self._is_shown and self._is_silent() and self._state != OFFLINE:
                self._show(OFFLINE, OFFLINE)
                self._is_shown = False
        for identity in [identity for identity, until in tuple(self._pending.items()) if now > until]:
            if self._pending.pop(identity, None) is not None:
                self._answer(identity, "timed out", f"the vehicle did not answer within {self._answer_s:g} s")

    # --- from the vehicle, in the link's thread -----------------------------------------------------------------------

    def _on_connected(self, connected: bool) -> None:
        if not connected:
            self._newest.forget()  # what the broker has kept is said again

    def _on_state(self, message: MqttMessage) -> None:
        said = read_state(message.payload)
        if isinstance(said, UplinkLost) and not self._is_silent():
            return  # it has others
        if isinstance(said, VehicleState) and not self._newest.takes("state", said.t, time.monotonic()):
            return
        state = driving = OFFLINE
        if isinstance(said, VehicleState):
            state, driving = (
                message.payload.decode(),
                json.dumps(to_json(said.driving)) if said.driving is not UNSET else OFFLINE,
            )
        with self._lock:
            self._show(state, driving)
            self._state, self._driving, self._is_shown, self._state_time = state, driving, True, time.monotonic()

    def _show(self, state: str, driving: str) -> None:
        self._node.publish(STATE, state)
        if driving != self._shown_driving:
            self._node.publish(DRIVING, driving)
            self._shown_driving = driving

    def _on_telemetry(self, message: MqttMessage) -> None:
        telemetry = read_telemetry(message.payload)
        arrived = time.monotonic()
        if not message.retained and self._newest.takes("telemetry", telemetry.t, arrived):
            with self._lock:
                self._vehicle_time = (telemetry.t, arrived)
                if not self._is_shown:
                    self._show(self._state, self._driving)
                    self._is_shown = True
            self._node.publish(TELEMETRY, message.payload.decode())

    def _on_reply(self, message: MqttMessage) -> None:
        reply = read_reply(message.payload)
        if self._pending.pop(reply.id, None) is not None:
            self._answer(reply.id, reply.result, reply.reason, reply.t)
        elif reply.result != "applied":
            topic = reply.id.partition(" ")[0]
            self._report_refusal(f"{topic}: {reply.result}: {reply.reason}", topic)

    # --- from ROS, in the node's thread -------------------------------------------------------------------------------

    def _on_message(self, message: Message, _memory: int) -> None:
        match message["kind"]:
            case "text":
                self._on_request(message["text"])
            case "fix" if message["fixed"] and math.isfinite(message["lat"]) and math.isfinite(message["lon"]):
                self._report("position_reported", lat=message["lat"], lon=message["lon"])
            case "newest_number" if self._may_predict(message["nodes"]) and math.isfinite(message["number"]):
                self._report("bitrate_predicted", kbps=message["number"])
            case "sign":
                self._report("operator_connected")
            case "call":
                identity = f"{message['topic']} {next(self._numbers)}"
                self._calls[identity] = message["call"]
                self._on_input(identity, self._services[message["topic"]], message)
            case "number" | "region":
                identity = f"{message['topic']} {next(self._numbers)}"
                self._on_input(identity, self._topics[message["topic"]], message)

    def _on_input(self, identity: str, operator_input: OperatorInput, message: Message) -> None:
        try:
            event = operator_input.event(message)
        except ValueError as error:
            self._answer(identity, "refused", str(error))
        else:
            self._request(identity, event)

    def _may_predict(self, nodes: list[str]) -> bool:
        """Whether only the named node publishes predictions; False while names are unknown."""
        prediction = self._prediction
        assert prediction
        if others := [name for name in nodes if name != prediction.node]:
            published = f"is published by {', '.join(others)}, must be by {prediction.node} alone"
            self._report_publisher(f"{prediction.topic} {published}: predictions are ignored", prediction.topic)
        return nodes == [prediction.node]

    def _on_request(self, text: str) -> None:
        try:
            event = read_message(text.encode())
        except ValueError as error:
            self._answer("", "refused", str(error))
            return
        identity = event.pop("id", None)
        if not isinstance(identity, str) or not identity:
            self._answer("", "refused", "id: must be given, as text")
        elif self._reports and event.get("event") == "operator_connected":
            rule = "reports positions or predictions, which count as signs of life: start another for the operator"
            self._answer(identity, "refused", f"this node {rule}")
        else:
            self._request(identity, event)

    def _request(self, identity: str, event: Mapping[str, Any]) -> None:
        if self._is_online():
            self._pending[identity] = time.monotonic() + self._answer_s
            self._send(identity, event)
        else:
            self._answer(identity, "refused", "the vehicle is offline")

    def _report(self, event: str, **values: Any) -> None:
        """Send an event whose answer nobody waits for."""
        now = time.monotonic()
        if self._is_online() and now >= self._due.get(event, now):
            self._due[event] = now + EVERY_S
            self._send(f"{event} {uuid.uuid4().hex[:8]}", {"event": event, **values})

    # ------------------------------------------------------------------------------------------------------------------

    def _is_silent(self) -> bool:
        return time.monotonic() - max(self._state_time, self._vehicle_time[1]) > SILENT_S

    def _is_online(self) -> bool:
        return time.monotonic() - self._vehicle_time[1] <= SILENT_S

    def _send(self, identity: str, event: Mapping[str, Any]) -> None:
        t, arrived = self._vehicle_time
        as_of = round(t + time.monotonic() - arrived, 6)
        self._link.publish(self._requests, {**event, "id": identity, "as_of": as_of})

    def _answer(self, identity: str, result: str, reason: str, t: float | None = None) -> None:
        """Answer a request; t: the vehicle's time, now if it is not given."""
        if call := self._calls.pop(identity, None):
            self._node.answer(call, result == "applied", f"{result}: {reason}" if reason else result)
            return
        t = self._vehicle_time[0] if t is None else t
        self._node.publish(REPLY, json.dumps({"id": identity, "t": t, "result": result, "reason": reason}))

    def _on_node_report(self, name: str, what: str) -> None:
        self._on_report(f"{name}: {what}" if name else what)
