"""The operator's end of the control link against a real broker and a scripted vehicle."""

from __future__ import annotations

import json
import os
import re
import sys
import time
from contextlib import suppress

import pytest

from rig import RecordingListener, free_port, passes, until
from runner.configuration.config import configuration
from runner.core.events import Attention
from runner.gst.receiver import Reception
from runner.mqtt.broker import private_broker
from runner.mqtt.link import ControlLink
from runner.mqtt.messages import OFFLINE, topic
from runner.operator.latency import stages
from runner.operator.meter import MeasuredRates
from runner.operator.station import SILENT_S, CameraRow, Listener, Presence, Station
from runner.records.reception import Arrival, Arrivals
from runner.records.vehicle import CameraTelemetry
from runner.settings import Endpoint
from runner.verbs.table import LiveTable

pytestmark = pytest.mark.gst

CAMERA = {"on": True, "sending": True, "demand_kbps": 4000, "kbps": 500, "scaling": 0.5, "width": 640, "height": 360}
STATE = {
    "online": True,
    "t": 1.0,
    "cause": "start",
    "mode": "automatic",
    "total_kbps": 1500,
    "asked_kbps": 1500,
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
        self.operator = ""  # sender of the last message
        self._began = time.monotonic()
        self.clock_ahead_s, self.states_clock = 0.0, True
        self.answers, self.reports = [], []  # about its clock; of reception
        listen = {
            topic("delivery_robot", "request", "+"): self._on_request,
            topic("delivery_robot", "reception", "+"): self._on_reception,
        }
        self.link = ControlLink(broker, (topic("delivery_robot", "state"), OFFLINE), listen, lambda here: None, print)
        self.link.connect()
        assert self.link.wait_connected(15)

    def _on_request(self, message):
        self.operator = message.sender
        self.requests.append(json.loads(message.payload))

    def _on_reception(self, message):
        report, now = json.loads(message.payload), time.time() + self.clock_ahead_s
        self.operator = message.sender
        self.reports.append(report)
        if self.states_clock and "sent" in report:
            self.answers.append(
                {"sent": report["sent"], "received": now, "answered": now, "set_s": 0.0, "error_s": None}
            )
            self.publish("clock", self.answers[-1])

    def publish(self, kind, message):
        if kind in ("state", "telemetry") and message != OFFLINE:  # each is newer than all before
            message = {**message, "t": time.monotonic() - self._began}
        parts = (kind, self.operator) if kind in ("reply", "clock") else (kind,)
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
        setup = configuration(["vehicle=delivery_robot", f"control.port={broker.port}"]).setup()
        station = Station(setup, {})
        listener = RecordingListener()
        station.listeners.append(listener)
        vehicle = Vehicle(broker)
        vehicle.setup = setup
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


# 40 ms from capture to decode, if the vehicle's clock is 3.7 s ahead of this machine's


def fresh():
    """A picture of each camera, read just now."""
    received = Reception(frames=9, latency_ms=-3660.0, latency_at=time.monotonic())
    return dict.fromkeys(("front", "rear", "mast"), received)


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


def await_what_is_retained(vehicle, listener):
    """A new operator gets that first: then it notes a message that no vehicle sends."""
    until(lambda: vehicle.publish("steering", {"at": "now"}) or listener.notes, every_s=0.1)
    assert listener.notes[0].startswith("a message on tod/delivery_robot/steering was dropped: ")


def test_retained_telemetry_is_no_heartbeat(both):
    station, vehicle, _ = both
    vehicle.publish("state", STATE | {"total_kbps": 2999})  # behind all telemetry: from now on that is retained
    until(lambda: station.state.total_kbps == 2999)
    late = Station(vehicle.setup, {})
    listener = RecordingListener()
    late.listeners.append(listener)
    late.connect()
    try:
        await_what_is_retained(vehicle, listener)
        assert not passes(lambda: late.state, seconds=0.5)
        vehicle.live_until(lambda: late.state)
        assert listener.notes[1:] == ["the vehicle is online, mode automatic"]
    finally:
        late.close()


def test_an_unanswered_request_times_out(both):
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


def report_until(station, vehicle, done):
    """Report reception repeatedly, as an operator's side does."""

    def is_done():
        vehicle.publish("telemetry", TELEMETRY)  # or it would be offline
        station.report_reception({"": Arrivals({}, {})})
        station.take(fresh())
        return done()

    until(is_done, every_s=0.04)


def test_latencies_are_right_though_the_vehicles_clock_is_ahead(both):
    station, vehicle, listener = both
    station.take(fresh())
    assert {row.received.latency_ms for row in station.rows()} == {None}
    assert station.headline() == "delivery_robot, mode automatic, total 1500 kbit/s, latencies still unknown"
    assert station.latency.captured("front", 1000.0) is None
    vehicle.clock_ahead_s = 3.7
    report_until(station, vehicle, lambda: station.latency.clock)
    clock = station.latency.clock
    assert abs(clock.ahead_s - 3.7) <= clock.bound_s
    report_until(station, vehicle, lambda: station.samples["front"].latency_ms is not None)
    clock, sample = station.latency.clock, listener.received[-1][1]
    for camera in sample.cameras.values():
        assert abs(camera.latency_ms - 40) <= sample.clock_bound_ms + 1
    assert abs(station.latency.captured("front", 1003.7) - 1000) <= clock.bound_s
    expected = f", latencies ± {1000 * station.latency.clock.bound_s:.1f} ms"
    assert station.headline() == f"delivery_robot, mode automatic, total 1500 kbit/s{expected}"


def test_frames_are_reported_with_what_arrived_of_all_cameras(both):
    """Between the first packet and the last, where known, and since the frame before; a report may cut a frame."""
    station, vehicle, _ = both
    report_until(station, vehicle, lambda: vehicle.reports)
    now = time.monotonic() - 0.1
    arrived = [
        (now + ms / 1000, size) for ms, size in ((10, 900), (12, 1000), (15, 600), (16, 500), (19, 300), (21, 1))
    ]
    front = Arrival(now + 0.015, 1000.0, 1500, True, now + 0.010)
    rear = Arrival(now + 0.021, 1000.0, 801, False, now + 0.012)
    mast = Arrival(now + 0.021, 1000.0, 999, True)
    station.report_reception({"": Arrivals({"front": [front]}, {}, arrived=arrived[:4])})
    station.report_reception({"": Arrivals({"rear": [rear], "mast": [mast]}, {}, arrived=arrived[4:])})
    units = until(lambda: (seen := [u for report in vehicle.reports for u in report["units"]]) and seen[2:] and seen)
    assert [(unit[0], *unit[4:]) for unit in units] == [
        ("front", True, pytest.approx(0.005), 2, 1600, 3, 2500),
        ("rear", False, pytest.approx(0.009), 4, 1401, 3, 801),
        ("mast", True, 0, 0, 0, 0, 0),
    ]


def test_a_steering_angle_is_passed_on_with_its_time_by_this_machines_clock(both):
    """None before that clock is compared with the vehicle's, and none of the future."""
    received = []

    class Steered(Listener):
        def on_steering(self, at, rad, gear):
            received.append((at, rad, gear))

    station, vehicle, _ = both
    station.listeners.append(Steered())
    vehicle.clock_ahead_s = 3.7
    vehicle.publish("steering", {"at": time.time() + 3.7, "rad": 0.1})
    report_until(station, vehicle, lambda: station.latency.clock)
    at = time.time()
    vehicle.publish("steering", {"at": at + 3.7 + 60, "rad": 0.2})
    vehicle.publish("steering", {"at": at + 3.7, "rad": 0.3, "gear": "R"})
    until(lambda: received)
    assert received == [(pytest.approx(at, abs=station.latency.clock.bound_s + 1e-3), 0.3, "R")]


def test_the_heartbeat_states_the_drivers_attention(both):
    station, vehicle, _ = both
    assert "attention" not in vehicle.request("operator_connected")
    for number, attention in enumerate((Attention.HIDDEN, Attention.WATCHING, None), 2):
        station.attention = attention
        station.take(samples())
        until(lambda n=number: len(vehicle.requests) == n)
        assert (vehicle.requests[-1]["event"], vehicle.requests[-1].get("attention")) == (
            "operator_connected",
            attention,
        )


def test_a_station_that_is_absent_says_nothing_but_goodbye_and_hears_everything(both):
    station, vehicle, _ = both
    vehicle.request("operator_connected")
    station.appear(Presence.ABSENT)
    assert vehicle.request("operator_disconnected")["id"].startswith("signed off ")
    vehicle.requests.clear()
    vehicle.reports.clear()
    since = len(vehicle.answers)
    began = time.monotonic()
    report_until(station, vehicle, lambda: time.monotonic() - began > 1)
    assert (vehicle.requests, vehicle.reports, len(vehicle.answers)) == ([], [], since)
    assert station.state.mode == "automatic"
    station.appear(Presence.WATCHING)
    assert vehicle.request("operator_connected")["watching"] is True
    vehicle.requests.clear()
    station.appear(Presence.DRIVING)
    assert "watching" not in vehicle.request("operator_connected")


def test_the_slowest_camera_that_should_send_is_reported(both):
    station, vehicle, _ = both
    vehicle.clock_ahead_s = 3.7
    newest = {}

    def reported(silent=(), ms=40):
        """The latency that is reported when all cameras but the silent ones have just sent a picture."""
        now, captured = time.monotonic(), time.time() + 3.7 - ms / 1000
        newest.update({name: Arrival(now, captured, 1000) for name in STATE["cameras"] if name not in silent})
        station.report_reception({"": Arrivals({name: [arrival] for name, arrival in newest.items()}, newest)})
        station.take(fresh())
        vehicle.publish("telemetry", TELEMETRY)
        return vehicle.reports[-1].get("latency_ms", 0) if vehicle.reports else 0

    until(lambda: 40 <= reported() < 60, every_s=0.05)
    until(lambda: reported(ms=130) >= 130, every_s=0.05)  # immediately, not with the next sample
    until(lambda: 40 <= reported() < 60, every_s=0.05)
    until(lambda: reported(silent=["rear"]) > 500, every_s=0.05)  # the longer it sends nothing
    until(lambda: 40 <= reported() < 60, every_s=0.05)
    cameras = {name: {**camera, "fault": "it repeats"} for name, camera in STATE["cameras"].items()}
    vehicle.publish("state", {**STATE, "cameras": cameras})
    until(lambda: reported() == 0, every_s=0.05)  # pictures arrive whose age is unknown


def test_the_latency_of_a_source_without_capture_times_is_unknown(both):
    station, vehicle, listener = both

    def reach(done):
        def step():
            vehicle.publish("telemetry", TELEMETRY)
            now = time.monotonic()
            newest = {name: Arrival(now, time.time() + 3.7 - 0.04, 1000) for name in STATE["cameras"]}
            station.report_reception({"": Arrivals({}, newest)})
            station.take(fresh())
            return done()

        until(step, every_s=0.05)

    vehicle.clock_ahead_s = 3.7
    reach(lambda: station.latency.clock and station.samples["rear"].latency_ms is not None)
    reach(lambda: "latency_ms" in vehicle.reports[-1])
    assert station.latency.captured("rear", 1003.7) is not None
    rear = {**STATE["cameras"]["rear"], "untimed": True}
    vehicle.publish("state", {**STATE, "cameras": {**STATE["cameras"], "rear": rear}})
    reach(lambda: station.latency.untimed("rear") and "latency_ms" not in vehicle.reports[-1])
    shown = listener.received[-1][1].cameras
    assert shown["rear"].latency_ms is None
    assert shown["front"].latency_ms is not None
    assert station.latency.captured("rear", 1003.7) is None
    assert station.latency.captured("front", 1003.7) is not None


def test_duplicate_or_unrequested_clock_answers_are_ignored(both):
    station, vehicle, _ = both
    report_until(station, vehicle, lambda: station.latency.clock)
    before, answer = station.latency.clock, vehicle.answers[-1]
    vehicle.publish("clock", {**answer, "received": answer["received"] + 9, "answered": answer["answered"] + 9})
    vehicle.publish("clock", {"sent": 12.5, "received": 99.0, "answered": 99.0, "set_s": 0.0, "error_s": None})
    dropped = station.link.dropped
    vehicle.publish("clock", {**answer, "sent": "yesterday"})
    until(lambda: station.link.dropped > dropped)  # the last of three, in order
    station.take(fresh())
    assert abs(station.latency.clock.ahead_s - before.ahead_s) < 1


def test_a_vehicle_that_stops_stating_its_clock_is_reported_once(both, monkeypatch):
    monkeypatch.setattr("runner.system.clocks.KEPT_S", 0.3)
    station, vehicle, listener = both
    report_until(station, vehicle, lambda: station.latency.clock)
    vehicle.states_clock = False
    until(lambda: [vehicle.publish("telemetry", TELEMETRY), station.take(fresh()), not station.latency.clock][-1])
    station.take(fresh())
    assert listener.received[-1][1].clock_bound_ms is None
    assert {row.received.latency_ms for row in station.rows()} == {None}
    assert listener.notes[1:] == ["the vehicle has not stated its clock for 10 s: latencies are unknown"]


def test_a_decision_is_one_note_however_many_cameras_it_changes(both):
    station, vehicle, listener = both
    cameras = {
        name: {**camera, "scaling": 0.25, "reason": f"{kbps} of 4000 kbit/s, range [0, 400) -> 0.25"}
        for kbps, (name, camera) in enumerate(STATE["cameras"].items(), 300)
    }
    totals = {"total_kbps": 900, "asked_kbps": 900}
    state = {**STATE, "cause": "bitrate_predicted kbps 900", **totals, "cameras": cameras}
    vehicle.publish("state", state)
    vehicle.publish("state", {**state, "cause": "bitrate_predicted kbps 880", "total_kbps": 880})
    until(lambda: station.state.total_kbps == 880)
    text = "Prediction 900 kbit/s: front, rear, mast smaller, at quarter size (3 of 3 cameras, total 900 kbit/s)"
    assert listener.notes[1:] == [text]


def test_a_camera_that_one_side_lacks_leaves_the_others_to_be_driven(both):
    _, vehicle, _ = both
    late = Station(vehicle.setup, {"cameras.front.fps": 15, "cameras.mast.fps": 15})
    listener = RecordingListener()
    late.listeners.append(listener)
    cameras = {name: STATE["cameras"][name] for name in ("front", "rear")} | {"door": STATE["cameras"]["mast"]}
    vehicle.publish("configuration", {"run": "a", "settings": {"cameras.front.fps": 15, "cameras.door.fps": 15}})
    vehicle.publish("state", STATE | {"cameras": cameras})
    late.connect()
    try:
        vehicle.live_until(lambda: late.state)
        late.take(samples())
        decided = {row.name: row.state and row.state.kbps for row in late.rows()}
        assert decided == {"front": 500, "rear": 500, "mast": None}
        assert "mast" not in late.sending()
        named = "the vehicle's configuration differs: cameras.mast: only here; cameras.door: only on the vehicle"
        assert sorted(listener.notes) == ["the vehicle is online, mode automatic", named]
        replies = []
        late.ask({"event": "total_set", "kbps": 1000}, replies.append)
        request = vehicle.request("total_set")
        vehicle.operator = late.identity
        vehicle.publish("reply", {"id": request["id"], "t": 1, "result": "applied", "reason": ""})
        until(lambda: replies)
        assert results(replies) == [("applied", "")]
    finally:
        late.close()


def test_the_stored_configuration_of_a_vehicle_that_has_ended_is_not_compared(both):
    station, vehicle, _ = both
    vehicle.publish("configuration", {"run": "a", "settings": {"fps_max": 15}})
    vehicle.publish("state", OFFLINE)
    until(lambda: station.state is None)
    late = Station(vehicle.setup, {"fps_max": 10})
    listener = RecordingListener()
    late.listeners.append(listener)
    late.connect()
    try:
        await_what_is_retained(vehicle, listener)
        assert len(listener.notes) == 1
        vehicle.publish("state", STATE)
        until(lambda: len(listener.notes) > 1)
        assert listener.notes[1:] == ["the vehicle's configuration differs: fps_max: 10 here, 15 on the vehicle"]
    finally:
        late.close()


def test_a_vehicle_that_signs_off_is_offline_immediately(both):
    station, vehicle, listener = both
    vehicle.publish("state", OFFLINE)
    until(lambda: not station.state)
    assert listener.notes[1:] == ["the vehicle is offline"]
    assert listener.received[-1] == ("state", None)


def shown_table(rows, width, monkeypatch):
    """The lines of the table on a terminal of so many columns."""
    terminal, end = os.openpty()
    monkeypatch.setenv("COLUMNS", str(width))
    with os.fdopen(end, "w") as stdout:
        monkeypatch.setattr(sys, "stdout", stdout)
        with LiveTable() as table:
            table.show(rows, "the vehicle is online")
    written = b"".join(pieces_of(terminal))
    os.close(terminal)
    return re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", written.decode()).splitlines()


def pieces_of(terminal):
    """What was written to a terminal whose other end is closed: the kernel hands it over in pieces, then fails."""
    with suppress(OSError):
        while piece := os.read(terminal, 65_536):
            yield piece


@pytest.mark.parametrize("width", [80, 150])
def test_the_table_shows_the_names_of_cameras_on_a_narrow_terminal(width, monkeypatch):
    names = ("front_center", "top_left")
    received = Reception(frames=9, width=1920, height=1040, latency_ms=123.4, latency_at=time.monotonic())
    rows = [CameraRow(name, MeasuredRates(15.0, 1234.0), received, None) for name in names]
    lines = shown_table(rows, width, monkeypatch)
    assert [line.split()[0] for line in lines[4:6]] == list(names)
    assert ("demand" in lines[2], "1920x1040" in lines[4]) == (width > 80, True)


@pytest.mark.parametrize("width", [80, 160])
def test_the_table_says_which_pictures_are_refused_and_where_there_is_room_why(width, monkeypatch):
    rows = [CameraRow("front", MeasuredRates(0.0, 0.0), Reception(), None, "one viewer per camera: media.max_viewers")]
    line = next(line for line in shown_table(rows, width, monkeypatch) if "front" in line)
    assert "refused" in line
    assert ("media.max_viewers" in line) == (width > 80)


def test_no_part_of_a_latency_is_negative():
    """The parts are those of other pictures than the sum."""
    received = Reception(waited_ms=30.0, decode_ms=20.0, latency_ms=40.0)
    parts = stages(received, CameraTelemetry(1, 1, {}, capture_ms=5.0, encode_ms=6.0))
    assert (parts.link, parts.buffer) == (None, 30.0)
