"""The operator's end of the control link against a real broker and a scripted vehicle."""

from __future__ import annotations

import json

import pytest

from rig import free_port, until
from runner.broker import private_broker
from runner.config import load
from runner.control import OFFLINE, Link
from runner.gst.receiver import Received
from runner.model import Endpoint
from runner.station import ANSWER_S, SILENT_S, Station

pytestmark = pytest.mark.gst

CAMERA = {"on": True, "sending": True, "demand_kbps": 4000, "kbps": 500, "scaling": 0.5, "width": 640, "height": 360}
STATE = {
    "online": True,
    "t": 1.0,
    "cause": "start",
    "mode": "automatic",
    "total_kbps": 1500,
    "cameras": {
        name: {**CAMERA, "roi": {"x": 0, "y": 0, "width": 1280, "height": 720}, "reason": "why", "applied": {}}
        for name in ("front", "rear", "mast")
    },
}


class Vehicle:
    """A vehicle's end of the link that says what the test wants."""

    def __init__(self, broker):
        self.requests = []
        listen = {"request": lambda payload: self.requests.append(json.loads(payload))}
        self.link = Link("delivery_robot", broker, ("state", OFFLINE), listen, lambda here: None)
        self.link.connect()

    def request(self, event):
        return until(lambda: next((asked for asked in self.requests if asked["event"] == event), None))


@pytest.fixture
def both():
    broker = Endpoint("127.0.0.1", free_port())
    with private_broker(broker):
        station = Station(load(["vehicle=delivery_robot", f"control.port={broker.port}"]))
        told = []
        station.listeners.append(lambda kind, message: told.append((kind, message)))
        vehicle = Vehicle(broker)
        station.connect()
        vehicle.link.publish("state", STATE)
        until(lambda: station.state["online"])
        yield station, vehicle, told
        station.close()
        vehicle.link.close("state", OFFLINE)


def samples():
    return dict.fromkeys(("front", "rear", "mast"), Received())


def notes(told):
    return [message["text"] for kind, message in told if kind == "note"]


def test_who_comes_says_hello_and_is_answered(both):
    station, vehicle, told = both
    assert "id" in vehicle.request("operator_connected")
    replies = []
    station.ask({"event": "total_set", "kbps": 1000}, lambda *said: replies.append(said))
    asked = vehicle.request("total_set")
    vehicle.link.publish("reply", {"id": "another", "t": 1, "result": "applied", "reason": ""})
    vehicle.link.publish("reply", {"id": asked["id"], "t": 1, "result": "refused", "reason": "no"})
    until(lambda: replies)
    assert replies == [("reply", {"result": "refused", "reason": "no"})]
    assert notes(told) == ["the vehicle is there, mode automatic"]


def test_a_request_that_nobody_answers_has_timed_out(both):
    station, _, _ = both
    replies = []
    station.ask({"event": "total_set", "kbps": 1000}, lambda kind, said: replies.append(said))
    until(lambda: station.take(samples()) is None and replies, seconds=5 * ANSWER_S)
    assert replies == [{"result": "timed out", "reason": "no answer from the vehicle within 2 s"}]


def test_a_silent_vehicle_is_not_there_and_returns_by_a_word(both):
    station, vehicle, told = both
    until(lambda: station.take(samples()) is None and not station.state["online"], seconds=10 * SILENT_S)
    replies = []
    station.ask({"event": "total_set", "kbps": 1000}, lambda kind, said: replies.append(said))
    assert replies == [{"result": "refused", "reason": "the vehicle is not there"}]
    vehicle.requests.clear()
    vehicle.link.publish("telemetry", {"t": 2, "predicted_kbps": 2000, "position": None, "refused": 0, "cameras": {}})
    until(lambda: station.state["online"])
    vehicle.request("operator_connected")
    assert notes(told)[1:] == ["the vehicle has said nothing for 0.7 s", "the vehicle is there, mode automatic"]
    station.take(samples())
    sample = told[-1][1]
    assert (sample["predicted_kbps"], sample["allocated_kbps"]) == (2000, 1500)


def test_changes_are_told_with_their_cause_and_reason(both):
    _, vehicle, told = both
    rear = {**STATE["cameras"]["rear"], "scaling": 0.25, "reason": "300 of 4000 kbit/s, range [0, 400) -> 0.25"}
    cameras = {**STATE["cameras"], "rear": rear}
    vehicle.link.publish("state", {**STATE, "cause": "bitrate_predicted kbps 900", "cameras": cameras})
    until(lambda: len(notes(told)) == 2)
    assert notes(told)[1] == "bitrate_predicted kbps 900 -> rear: 300 of 4000 kbit/s, range [0, 400) -> 0.25"


def test_a_vehicle_that_leaves_is_gone_at_once(both):
    station, vehicle, told = both
    vehicle.link.publish("state", OFFLINE)
    until(lambda: not station.state["online"])
    assert notes(told)[1:] == ["the vehicle is gone"]
    assert told[-1] == ("state", OFFLINE)
