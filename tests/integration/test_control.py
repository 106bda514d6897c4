"""The control link with stalled operators, vanishing brokers, floods, invalid messages and failing rules."""

from __future__ import annotations

import json
import re
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from contextlib import ExitStack, suppress
from itertools import count

import pytest

from rig import CHECKOUT, ROBOT, SMALL_ROBOT, Operator, RecordingListener, free_port, process, run, until
from runner.configuration.config import configuration
from runner.mqtt.broker import find_mosquitto, private_broker
from runner.mqtt.link import ControlLink
from runner.mqtt.messages import MAX_ROUND_TRIP_S, OFFLINE, topic
from runner.mqtt.ways import ControlLinks
from runner.operator.station import Station
from runner.settings import Endpoint, Uplink
from runner.vehicle.operators import SILENT_S


@pytest.fixture
def ports(broker):
    return (f"control.port={broker.port}", f"media.port={free_port()}")


@pytest.fixture
def vehicle(ports, tmp_path):
    with process("vehicle", *ROBOT, *ports, f"log={tmp_path / 'drive'}", stdout=subprocess.DEVNULL) as child:
        yield child


@pytest.fixture
def stack():
    with ExitStack() as stack:
        yield stack


class Present:
    """An operator that sends heartbeats until it leaves."""

    def __init__(self, broker, stack, name=""):
        self.operator = Operator(broker, name=name)
        self._left = threading.Event()
        thread = threading.Thread(target=self._breathe)
        thread.start()
        stack.callback(thread.join)
        stack.callback(self._left.set)

    def _breathe(self):
        while not self._left.wait(SILENT_S / 4):
            self.operator.send("sign of life", event="operator_connected")

    def leave(self):
        self._left.set()


def logged(tmp_path):
    file = tmp_path / "drive" / "drive.jsonl"
    whole = file.read_text().rpartition("\n")[0] if file.exists() else ""
    return [json.loads(line) for line in whole.splitlines()]


def notes(tmp_path):
    lines = logged(tmp_path)
    return [line["text"] for line in lines if line.get("log") == "note"]


def sending(state):
    return state["online"] and all(camera["sending"] for camera in state["cameras"].values())


def paused(state):
    return state["online"] and not any(camera["sending"] for camera in state["cameras"].values())


# --- presence ---------------------------------------------------------------------------------------------------------


def test_other_operators_do_not_stop_the_video_of_one_who_is_present(broker, vehicle, tmp_path, stack):
    first = Present(broker, stack, "first")
    until(lambda: "operator first is present" in notes(tmp_path))
    for number in count():
        begun = len(logged(tmp_path))
        others_leave(broker, stack, number, tmp_path)
        time.sleep(3 * SILENT_S)  # sending would have stopped by now
        assert first.operator.ask(f"{number}", event="mode_selected", mode="collective")["result"] == "applied"
        lines = logged(tmp_path)[begun:]
        if not any(line.get("text") == "operator first has been silent for 1 s" for line in lines):
            break  # otherwise this process was held up
    left = [line["operator"] for line in lines if line.get("event") == "operator_disconnected"]
    assert sorted(left) == [f"second{number}", f"third{number}"], notes(tmp_path)
    first.leave()
    first.operator.state(paused)


def others_leave(broker, stack, number, tmp_path):
    """One operator falls silent, another one says goodbye."""
    names = f"second{number}", f"third{number}"
    second, third = (Present(broker, stack, name) for name in names)
    until(lambda: {f"operator {name} is present" for name in names} <= set(notes(tmp_path)))
    second.leave()
    third.leave()
    third.operator.send("bye", event="operator_disconnected")
    gone = {f"operator {names[0]} has been silent for 1 s", f"operator {names[1]} signed off"}
    until(lambda: gone <= set(notes(tmp_path)))


@pytest.mark.parametrize("stall_s", [pytest.param(2.2, marks=pytest.mark.soak), 4.0])
def test_a_stalled_operator_is_back_when_it_wakes(broker, vehicle, ports, stall_s, tmp_path):
    """The broker may or may not have closed its connection meanwhile."""
    waking_of_a_stalled_operator(broker, ports, stall_s, tmp_path)


@pytest.mark.soak  # up to a second of it is for reconnecting
@pytest.mark.parametrize("stall_s", [2.2, 3.0, 3.4, 4.0])
def test_a_stalled_operator_is_back_immediately(broker, vehicle, ports, stall_s, tmp_path):
    assert waking_of_a_stalled_operator(broker, ports, stall_s, tmp_path) < 1.5


def waking_of_a_stalled_operator(broker, ports, stall_s, tmp_path):
    """Time from its wake-up until the vehicle sends again, s."""
    onlooker = Operator(broker)
    with process("operator", *ROBOT, *ports, stdout=subprocess.DEVNULL) as operator:
        onlooker.state(lambda state: sending(state) and all(c["applied"] for c in state["cameras"].values()))
        until(lambda: any("is present" in note for note in notes(tmp_path)))
        operator.send_signal(signal.SIGSTOP)
        onlooker.state(paused)
        time.sleep(stall_s - 2.1)  # offline after 1 s, paused after another one
        operator.send_signal(signal.SIGCONT)
        woken = time.monotonic()
        onlooker.state(sending)
        return time.monotonic() - woken


# --- requests ---------------------------------------------------------------------------------------------------------


def test_a_late_request_is_not_executed(broker, vehicle):
    operator = Operator(broker)
    operator.ask("1", event="mode_selected", mode="collective")
    operator.ask("2", event="total_set", kbps=1000)
    late = operator.ask("3", event="total_set", kbps=9000, as_of=operator.as_of() - 2.5)
    assert late["result"] == "expired"
    limit = float(re.search(r" s old, limit (\d+\.\d+) s$", late["reason"])[1])
    assert 1 <= limit <= 1 + MAX_ROUND_TRIP_S
    vehicle.send_signal(signal.SIGSTOP)
    operator.send("stalled", event="total_set", kbps=9000)
    time.sleep(2.5)
    vehicle.send_signal(signal.SIGCONT)  # the broker may have dropped it meanwhile, and the request with it
    until(lambda: operator.send("after", event="total_set", kbps=1000) or operator.replies.get("after"), every_s=0.5)
    assert operator.replies.get("stalled", late)["result"] == "expired"
    assert operator.ask("4", event="total_set", kbps=1200)["result"] == "applied"
    assert operator.state(lambda state: state.get("total_kbps", 1000) not in (3000, 1000))["total_kbps"] == 1200


def test_a_request_must_state_as_of_and_is_never_retained(broker, vehicle):
    operator = Operator(broker)
    as_of = operator.as_of()
    rule = "as_of: must be given: the vehicle's t in the newest telemetry, plus the time since, s"
    for identity, keys, reason in (
        ("1", {}, rule),
        ("2", {"as_of": "now"}, rule),
        ("3", {"as_of": True}, rule),
        ("4", {"as_of": None}, rule),
    ):
        operator.publish(json.dumps({"id": identity, "event": "total_set", "kbps": 1, **keys}).encode())
        assert until(lambda i=identity: operator.replies.get(i))["reason"] == reason
    ahead = operator.ask("5", event="total_set", kbps=1, as_of=as_of + 100)
    assert ahead["result"] == "expired" and "is ahead of the vehicle's time" in ahead["reason"]
    retained = json.dumps({"id": "6", "as_of": as_of, "event": "mode_selected", "mode": "single"}).encode()
    with process("vehicle", *ROBOT, "name=late", f"control.port={broker.port}", f"media.port={free_port()}"):
        late = Operator(broker, vehicle="late")
        late.as_of()
    late.publish(retained, retain=True)
    with process("vehicle", *ROBOT, "name=late", f"control.port={broker.port}", f"media.port={free_port()}"):
        reply = until(lambda: late.replies.get("6"))
        assert (reply["result"], reply["reason"]) == ("refused", "must not be retained: a request is for now")
    late.publish(b"", retain=True)


FLOOD = """
import json, sys, time
from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion

client = Client(CallbackAPIVersion.VERSION2)
client.connect("127.0.0.1", int(sys.argv[1]))
client.loop_start()
message = json.dumps({"id": "x", "as_of": 0, "event": "total_set", "kbps": 3000})
began, sent = time.monotonic(), 0
while (passed := time.monotonic() - began) < 4:
    for _ in range(100):
        client.publish("tod/delivery_robot/request/flood", message)
        sent += 1
    time.sleep(max(0, sent / 10_000 - passed))
print(sent)
"""


@pytest.mark.alone
def test_a_flood_of_one_operator_does_not_delay_others(broker, vehicle):
    good = Operator(broker)
    good.ask("0", event="mode_selected", mode="collective")
    with subprocess.Popen([sys.executable, "-c", FLOOD, str(broker.port)], stdout=subprocess.PIPE, text=True) as flood:
        waits, flooded = [], time.monotonic()
        while flood.poll() is None:
            began = time.monotonic()
            reply = good.ask(str(began), event="camera_switched", camera="rear", on=len(waits) % 2 == 0)
            waits.append(time.monotonic() - began)
            assert reply["result"] == "applied", reply
            time.sleep(0.05)
        sent = int(flood.communicate()[0])
    assert sent > 10_000  # of 40 000: a busy machine floods less
    print(f"{len(waits)} requests, {max(waits) * 1000:.0f} ms at most")
    most_s = max(0.5, (began - flooded) / 5)  # a busy machine is slow; behind the flood they would wait for its end
    assert sorted(waits)[len(waits) * 9 // 10] < most_s
    assert sorted(waits)[-2] < 2 * most_s  # when the flood begins, everything on the machine is delayed
    until(lambda: good.telemetry[-1]["refused"] > sent / 4)


# --- broker -----------------------------------------------------------------------------------------------------------


def test_both_sides_wait_for_a_broker(stack):
    broker = Endpoint("127.0.0.1", free_port())
    ports = (f"control.port={broker.port}", f"media.port={free_port()}")
    output = {}
    for verb in ("vehicle", "operator"):
        child = stack.enter_context(process(verb, *ROBOT, *ports))
        output[verb] = []
        reader = threading.Thread(target=lambda c=child, v=verb: output[v].extend(c.stdout), daemon=True)
        reader.start()
    remedy = f"start one on this machine: mosquitto -p {broker.port}"
    wanted = f"no control link: MQTT broker at {broker}: connection refused ({remedy}); retrying"
    until(lambda: any(wanted in line for line in output["vehicle"]))
    time.sleep(2)
    with private_broker(broker):
        operator = Operator(broker)
        operator.state(lambda state: sending(state) and all(c["applied"] for c in state["cameras"].values()))
        assert sum(wanted in line for line in output["vehicle"]) == 1
        assert any(f"connected to the MQTT broker at {broker}" in line for line in output["vehicle"])


@pytest.mark.alone
def test_the_control_link_recovers_after_the_broker_has_hung(tmp_path):
    """A broker that hangs accepts connections and answers nothing, like a link that is cut."""
    broker = Endpoint("127.0.0.1", free_port())
    file = tmp_path / "mosquitto.conf"
    file.write_text(f"listener {broker.port} {broker.host}\nallow_anonymous true\n")
    station = Station(configuration([*ROBOT, f"control.port={broker.port}"]).setup(), {})
    with subprocess.Popen([find_mosquitto(), "-c", file], stderr=subprocess.DEVNULL) as mosquitto:
        try:
            with process("vehicle", *ROBOT, f"control.port={broker.port}", f"media.port={free_port()}"):
                station.connect()
                until(lambda: station.state)
                mosquitto.send_signal(signal.SIGSTOP)
                until(lambda: station.take({}) is None and not station.state, every_s=0.2)
                time.sleep(4)
                mosquitto.send_signal(signal.SIGCONT)
                resumed = time.monotonic()
                until(lambda: station.take({}) is None and station.state, every_s=0.2)
                assert time.monotonic() - resumed < 5

                def is_applied():
                    replies = []  # the first may expire: its time may be that of telemetry from before the stop
                    station.ask({"event": "mode_selected", "mode": "collective"}, replies.append)
                    return until(lambda: station.take({}) is None and replies, every_s=0.2)[0].result == "applied"

                until(is_applied)
        finally:
            station.close()
            mosquitto.kill()


def test_a_second_vehicle_of_the_same_name_is_refused(broker, vehicle):
    operator = Operator(broker)
    operator.as_of()
    words = (*ROBOT, f"control.port={broker.port}", f"media.port={free_port()}", "duration_s=5")
    second = until(lambda: (done := run("vehicle", *words)).returncode and done)  # it drives if the first is held up
    assert second.returncode == 1
    rule = "choose another `name`, or stop the other vehicle"
    assert (
        second.stderr.splitlines()[-1] == f"a vehicle named delivery_robot is already connected to the broker; {rule}"
    )
    assert operator.ask("1", event="mode_selected", mode="collective")["result"] == "applied"
    assert operator.states.queue[-1]["online"]


# --- received messages ------------------------------------------------------------------------------------------------

GARBAGE = (
    b"",
    b"null",
    b"[]",
    b"{",
    b"\xff\xfe",
    b'{"online": true}',
    b'{"online": 1}',
    b'{"id": 1}',
    b"1" * 400,
    b"[" * 9999,
)


@pytest.fixture
def station(broker):
    station = Station(configuration([*ROBOT, f"control.port={broker.port}"]).setup(), {})
    listener = RecordingListener()
    station.listeners.append(listener)
    yield station, listener
    station.close()


def test_invalid_messages_from_the_vehicle_end_no_operator(broker, vehicle, station):
    station, listener = station
    station.connect()
    until(lambda: station.state)
    stranger = Operator(broker)
    for name in ("state", "telemetry", "configuration", f"reply/{station.identity}"):
        for payload in GARBAGE:
            stranger.publish(payload, f"tod/delivery_robot/{name}", retain=name == "state")
    stranger.publish(b'{"online": "x"}', "tod/delivery_robot/state", retain=True)
    until(lambda: station.link.dropped >= 4 * len(GARBAGE))
    why = "not JSON: Expecting value: line 1 column 1 (char 0)"
    assert f"a message on tod/delivery_robot/state was dropped: {why}" in listener.notes
    until(lambda: station.take({}) is None and station.state, every_s=0.2)
    replies = []
    station.ask({"event": "mode_selected", "mode": "collective"}, replies.append)
    assert until(lambda: replies)[0].result == "applied"


def test_an_unknown_vehicle_is_reported_with_the_known_ones(broker, vehicle):
    Operator(broker).as_of()
    station = Station(configuration([*ROBOT, "name=delivery_robott", f"control.port={broker.port}"]).setup(), {})
    listener = RecordingListener()
    station.listeners.append(listener)
    station.connect()
    try:
        until(lambda: station.take({}) is None and listener.notes, every_s=0.2)
        assert listener.notes == ["the broker has no vehicle named delivery_robott; online: delivery_robot"]
    finally:
        station.close()


def test_differences_between_both_sides_configurations_are_reported(broker, vehicle, ports):
    with process("operator", *ROBOT, *ports, "fps_max=10", "duration_s=4") as operator:
        output, _ = operator.communicate(timeout=60)
    assert "the vehicle's configuration differs: fps_max: 10 here, 15 on the vehicle" in " ".join(output.split())


# --- rules of the user's own ------------------------------------------------------------------------------------------

RULES = """
import time
import urllib.error
import urllib.request
from fractions import Fraction
from runner.core.rules import rule

@rule(needs=["total"], gives=["total"], reads=["prediction"])
def mine(vehicle, state, draft, memory):
    kbps = state.prediction.kbps if state.prediction else 0
    if kbps == 666:
        raise ZeroDivisionError("division by zero")
    if kbps == 667:
        return draft.replaced(total=Fraction(-1)), memory
    if kbps == 668:
        return draft.replaced(total=1.5), memory
    if kbps == 669:
        time.sleep(4)
    return draft, memory
"""


def test_a_rule_that_fails_or_hangs_does_not_end_the_vehicle(broker, ports, tmp_path):
    package, conf = tmp_path / "package", tmp_path / "conf"
    (package / "mine-1.dist-info").mkdir(parents=True)
    (package / "mine-1.dist-info" / "entry_points.txt").write_text("[tod_runner.rules]\nmine = my_rules:mine\n")
    (package / "mine-1.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: mine\nVersion: 1\n")
    (package / "my_rules.py").write_text(RULES)
    (conf / "modes").mkdir(parents=True)
    safe = (CHECKOUT / "conf" / "modes" / "paper.yaml").read_text()
    (conf / "modes" / "mine.yaml").write_text(safe.replace("start_kbps: 3000}", "start_kbps: 3000}\n  mine: {}", 1))
    words = (
        *SMALL_ROBOT,
        "source=test",
        "fps_max=15",
        "modes=mine",
        "pqos=live",
        f"conf={conf}",
        f"log={tmp_path / 'drive'}",
    )
    path = {"PYTHONPATH": f"{CHECKOUT}:{package}"}
    with process("vehicle", *words, *ports, env=path, stdout=subprocess.DEVNULL) as vehicle:
        operator = Operator(broker)
        operator.ask("0", event="bitrate_predicted", kbps=2000)
        for kbps, why in (
            (666, "rule mine failed: ZeroDivisionError: division by zero"),
            (
                667,
                "rule mine failed: total Fraction(-1, 1): must be kbit/s from 0 as an exact number (int or Fraction)",
            ),
            (668, "rule mine failed: total 1.5: must be kbit/s from 0 as an exact number (int or Fraction)"),
        ):
            assert operator.ask(str(kbps), event="bitrate_predicted", kbps=kbps)["result"] == "applied"
            state = operator.state(lambda state, why=why: state["online"] and state["fault"] == why)
            assert state["total_kbps"] == 2000
        operator.ask("1", event="bitrate_predicted", kbps=1000)
        assert operator.state(lambda state: state["fault"] is None and state["total_kbps"] == 1000)
        operator.send("669", event="bitrate_predicted", kbps=669)
        assert until(lambda: operator.replies.get("669"))["result"] == "applied"
        until(lambda: "the control loop runs again" in notes(tmp_path))
        vehicle.send_signal(signal.SIGTERM)
        assert vehicle.wait(15) == 0
    messages = notes(tmp_path)
    assert "rule mine failed: ZeroDivisionError: division by zero; the previous decision stays in force" in messages
    assert messages.index("the control loop hangs in bitrate_predicted") < messages.index("the control loop runs again")
    replayed = run("replay", f"input={tmp_path / 'drive'}", f"conf={conf}", env=path)
    faults = {json.loads(line).get("fault") for line in replayed.stdout.splitlines()}
    assert len(faults) == 4, replayed.stderr


def test_a_vehicle_whose_gstreamer_thread_hangs_is_not_healthy(broker, monkeypatch):
    """Neither for /health nor for the service manager, and it says so; the loop itself goes on."""
    pytest.importorskip("prometheus_client")
    from gi.repository import GLib

    from runner.vehicle import live

    freed, metrics, said, notified = threading.Event(), free_port(), [], []
    monkeypatch.setattr(live, "notify", notified.append)
    ports = (f"media.port={free_port()}", f"control.port={broker.port}", f"metrics.vehicle_port={metrics}")

    def health():
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{metrics}/health", timeout=5) as answer:
                return answer.status, answer.read().decode()
        except urllib.error.HTTPError as error:
            return error.code, error.read().decode()

    with live.live_vehicle([*ROBOT, *ports], say=said.append) as vehicle:
        vehicle.start()
        until(lambda: health() == (200, "ok\n"))
        until(lambda: "WATCHDOG=1" in notified)
        try:
            GLib.idle_add(lambda: freed.wait(60) and None)
            until(lambda: health() == (503, "GStreamer's thread hangs\n"))
            until(lambda: "GStreamer's thread hangs" in said)
            count = notified.count("WATCHDOG=1")
            until(lambda: time.monotonic() - vehicle.side.beat > live.STUCK_S + 1)
            assert notified.count("WATCHDOG=1") == count
        finally:
            freed.set()
        until(lambda: health() == (200, "ok\n"))
        until(lambda: "GStreamer's thread runs again" in said)
        assert not any("control loop" in line for line in said)


def test_no_message_is_queued_while_the_broker_is_away():
    """After a reconnection only new messages are sent."""
    endpoint = Endpoint("127.0.0.1", free_port())
    messages, seen = [], []
    own = {topic("x", "request", "+"): lambda message: None}
    link = ControlLink(endpoint, (topic("x", "state"), OFFLINE), own, lambda here: None, messages.append)
    link.connect()
    until(lambda: messages)
    link.publish(topic("x", "state"), {"online": "past"})
    with private_broker(endpoint):
        assert link.wait_connected(15)
        listen = {topic("x", "+"): lambda message: seen.append(json.loads(message.payload))}
        watcher = ControlLink(endpoint, (topic("y", "state"), OFFLINE), listen, lambda here: None, messages.append)
        watcher.connect()
        assert watcher.wait_connected(15)
        link.publish(topic("x", "state"), {"online": "present"})
        until(lambda: seen)
        link.close()
        watcher.close()
    assert seen[0] == {"online": "present"}


class Stalling:
    """Forwards connections to a broker, with a small buffer."""

    def __init__(self, broker, stack):
        self.endpoint, self.carries = Endpoint("127.0.0.1", free_port()), threading.Event()
        self.carries.set()
        self.only = ""  # the address whose connections it stalls; "": all
        self._broker = (broker.host, broker.port)
        self._listening = socket.socket()
        self._listening.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        self._listening.bind((self.endpoint.host, self.endpoint.port))
        self._listening.listen()
        thread = threading.Thread(target=self._serve, daemon=True)
        thread.start()
        stack.callback(self._listening.close)

    def _serve(self):
        with suppress(OSError):
            while True:
                near, (address, _) = self._listening.accept()
                threading.Thread(target=self._connect, args=(near, address), daemon=True).start()

    def _connect(self, near, address):
        with near, socket.create_connection(self._broker) as far:
            threading.Thread(target=self._pass, args=(far, near, address), daemon=True).start()
            self._pass(near, far, address)

    def _pass(self, one, other, address):
        with suppress(OSError):
            while data := one.recv(1024):
                if self.only in ("", address):
                    self.carries.wait()
                other.sendall(data)


def test_periodic_messages_are_not_queued_on_a_stalled_link(broker, stack):
    """Otherwise old messages would fill the link right after an outage, when pictures should return."""
    seen = []
    link_there = Stalling(broker, stack)
    own = {topic("x", "request", "+"): lambda message: None}
    link = ControlLink(link_there.endpoint, (topic("x", "state"), OFFLINE), own, lambda here: None, print)
    listen = {topic("x", "telemetry"): lambda message: seen.append(json.loads(message.payload)["number"])}
    watcher = ControlLink(broker, (topic("y", "state"), OFFLINE), listen, lambda here: None, print)
    for side in (watcher, link):
        side.connect()
        stack.callback(side.close)
        until(lambda side=side: side.wait_connected(0.1))

    def publish(number):
        link.publish(topic("x", "telemetry"), {"number": number, "rest": 4000 * "."})

    until(lambda: publish(0) or seen)
    link_there.carries.clear()
    number, end = 0, time.monotonic() + 0.8  # a longer stall would end the connection
    while time.monotonic() < end or number <= 40:
        publish(number := number + 1)
        time.sleep(0.005)
    link_there.carries.set()
    until(lambda: publish(1000) or 1000 in seen)
    assert len([number for number in seen if 0 < number < 1000]) < 20


def test_the_broker_keeps_the_newest_state_though_one_uplink_was_behind(broker, stack):
    """What waited for that uplink arrives after what came by the other one."""
    there, seen, made = Stalling(broker, stack), [], []
    there.only = "127.0.0.2"
    uplinks = {"a": Uplink(address=there.only), "b": Uplink(address="127.0.0.3")}
    will, own = (topic("x", "state"), OFFLINE), {topic("x", "request", "+"): lambda message: None}
    links = ControlLinks(there.endpoint, uplinks, will, own, made.append, print)
    listen = {topic("x", "+"): lambda message: seen.append(json.loads(message.payload)["number"])}
    watcher = ControlLink(broker, None, listen, lambda here: None, print)
    for side in (watcher, links):
        side.connect()
        stack.callback(side.close)
    until(lambda: watcher.is_connected and made == [True, True])
    there.carries.clear()
    number, end = 0, time.monotonic() + 0.8  # a longer stall would end the connection
    while time.monotonic() < end or number <= 40:
        links.publish(topic("x", "state"), {"number": (number := number + 1), "rest": 4000 * "."})
        time.sleep(0.005)
    there.carries.set()
    until(lambda: links.publish(topic("x", "telemetry"), {"number": 0}) and seen.count(number) == 2, every_s=0.1)
    assert [each for each in seen if each][-1] == number
    assert made == [True, True]
