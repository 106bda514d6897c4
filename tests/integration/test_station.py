"""The operator's end of the control link against a real broker and a scripted vehicle."""

from __future__ import annotations

import json

import pytest

from rig import RecordingListener, free_port, passes, until
from runner.configuration.config import configuration
from runner.core.model import Endpoint
from runner.gst.receiver import Reception
from runner.mqtt.broker import private_broker
from runner.mqtt.link import ControlLink
from runner.mqtt.messages import OFFLINE, topic
from runner.operator.station import SILENT_S, Station

pytestmark = pytest.mark.gst

CAMERA = {"on": True, "sending": True, "demand_kbps": 4000, "kbps": 500, "scaling": 0.5, "width": 640, "height": 360}
STATE = {
    "online": True,
    "t": 1.0,
    "cause": "start",
    "mode": "automatic",
    "total_kbps": 1500,
    "cameras": {
        name: {
            **CAMERA,
            "roi": {"x": 0, "y": 0, "width": 1280, "height": 720},
            "reason": "why",
            "weight": 1,
            "applied": {},
        }
        for name in ("front", "rear", "mast")
    },
}

TELEMETRY = {"t": 2, "predicted_kbps": 2000, "position": None, "refused": 0, "cameras": {}}


class Vehicle:
    """A vehicle's end of the link, scripted by the test."""

    def __init__(self, broker):
        self.requests = []
        self.operator = ""  # sender of the last request
        listen = {topic("delivery_robot", "request", "+"): self._on_request}
        self.link = ControlLink(broker, (topic("delivery_robot", "state"), OFFLINE), listen, lambda here: None, print)
        self.link.connect()
        assert self.link.wait_connected(15)

    def _on_request(self, message):
        self.operator = message.sender
        self.requests.append(json.loads(message.payload))

    def publish(self, kind, message):
        parts = (kind, self.operator) if kind == "reply" else (kind,)
        self.link.publish(topic("delivery_robot", *parts), message)

    def live_until(self, done):
        """Publish telemetry repeatedly, as a vehicle does."""
        until(lambda: [self.publish("telemetry", TELEMETRY), done()][-1], every_s=0.1)

    def request(self, event):
        return until(lambda: next((request for request in self.requests if request["event"] == event), None))


@pytest.fixture
def both():
    broker = Endpoint("127.0.0.1", free_port())
    with private_broker(broker):
        station = Station(configuration(["vehicle=delivery_robot", f"control.port={broker.port}"]).vehicle(), {})
        listener = RecordingListener()
        station.listeners.append(listener)
        vehicle = Vehicle(broker)
        station.connect()
        vehicle.publish("state", STATE)
        vehicle.live_until(lambda: station.state)
        yield station, vehicle, listener
        station.close()
        vehicle.link.close((topic("delivery_robot", "state"), OFFLINE))


def results(replies):
    return [(reply.result, reply.reason) for reply in replies]


def samples():
    return dict.fromkeys(("front", "rear", "mast"), Reception())


def test_a_new_station_announces_itself_and_is_answered(both):
    station, vehicle, listener = both
    assert "id" in vehicle.request("operator_connected")
    replies = []
    station.ask({"event": "total_set", "kbps": 1000}, replies.append)
    request = vehicle.request("total_set")
    vehicle.publish("reply", {"id": "another", "t": 1, "result": "applied", "reason": ""})
    vehicle.publish("reply", {"id": request["id"], "t": 1, "result": "refused", "reason": "no"})
    until(lambda: replies)
    assert results(replies) == [("refused", "no")]
    assert listener.notes == ["the vehicle is online, mode automatic"]


def test_retained_telemetry_is_no_sign_of_life(both):
    station, vehicle, _ = both
    vehicle.publish("state", STATE | {"total_kbps": 2999})  # behind all telemetry: from now on that is retained
    until(lambda: station.state.total_kbps == 2999)
    late = Station(station._vehicle, {})
    listener = RecordingListener()
    late.listeners.append(listener)
    late.connect()
    try:
        until(lambda: late._published)  # retained, and so was the telemetry
        assert not passes(lambda: late.state, seconds=0.5)
        vehicle.live_until(lambda: late.state)
        assert listener.notes == ["the vehicle is online, mode automatic"]
    finally:
        late.close()


def test_a_request_that_nobody_answers_has_timed_out(both):
    station, _, _ = both
    replies = []
    station.ask({"event": "total_set", "kbps": 1000}, replies.append)
    until(lambda: station.take(samples()) is None and replies, seconds=5 * station.answer_s)
    assert results(replies) == [("timed out", "no answer from the vehicle within 3 s")]


def test_a_silent_vehicle_is_offline_until_its_next_message(both):
    station, vehicle, listener = both
    until(lambda: station.take(samples()) is None and not station.state, seconds=10 * SILENT_S)
    replies = []
    station.ask({"event": "total_set", "kbps": 1000}, replies.append)
    assert results(replies) == [("refused", "the vehicle is offline")]
    vehicle.requests.clear()
    vehicle.publish("telemetry", TELEMETRY)
    until(lambda: station.state)
    vehicle.request("operator_connected")
    assert listener.notes[1:] == ["the vehicle has been silent for 0.7 s", "the vehicle is online, mode automatic"]
    station.take(samples())
    sample = listener.received[-1][1]
    assert (sample.predicted_kbps, sample.allocated_kbps) == (2000, 1500)


def test_a_vehicle_whose_clock_is_ahead_is_warned_of_in_place_of_its_ages(both):
    station, _, listener = both
    station.take({name: Reception(frames=9, latency_ms=-500.4) for name in samples()})
    warning = "delivery_robot, mode automatic, total 1500 kbit/s; its clock is ahead by at least 500 ms: "
    assert station.headline() == f"{warning}latencies are unknown"
    assert {row.received.latency_ms for row in station.rows()} == {None}
    assert listener.received[-1][1].clock_ahead_ms == 500.4
    assert listener.notes[1].startswith("the vehicle's clock is ahead by at least 500 ms: picture ages are unknown; ")


def test_a_decision_is_one_note_however_many_cameras_it_changes(both):
    station, vehicle, listener = both
    cameras = {
        name: {**camera, "scaling": 0.25, "reason": f"{kbps} of 4000 kbit/s, range [0, 400) -> 0.25"}
        for kbps, (name, camera) in enumerate(STATE["cameras"].items(), 300)
    }
    state = {**STATE, "t": 2.0, "cause": "bitrate_predicted kbps 900", "total_kbps": 900, "cameras": cameras}
    vehicle.publish("state", state)
    vehicle.publish("state", {**state, "t": 3.0, "cause": "bitrate_predicted kbps 880", "total_kbps": 880})
    until(lambda: station.state.total_kbps == 880)
    text = "Prediction 900 kbit/s: front, rear, mast 0.5 -> 0.25 (3 of 3 cameras, total 900 kbit/s)"
    assert listener.notes[1:] == [text]


def test_a_vehicle_that_leaves_is_gone_at_once(both):
    station, vehicle, listener = both
    vehicle.publish("state", OFFLINE)
    until(lambda: not station.state)
    assert listener.notes[1:] == ["the vehicle is offline"]
    assert listener.received[-1] == ("state", None)
