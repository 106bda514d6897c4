"""The control link as topics of ROS 2: `tod-runner ros` between a real vehicle and nodes of real rclpy."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import threading
from contextlib import contextmanager
from pathlib import Path

import pytest
from ros_domain import MARKS, PYTHON, domain  # noqa: F401

from keyed import VEHICLE, WATCHER, issue
from rig import SMALL_ROBOT, Operator, children_named, free_port, process, until, watching
from runner.configuration.config import configuration
from runner.core.model import Endpoint
from runner.mqtt.broker import private_broker
from runner.plans import compile_plans

pytestmark = MARKS
NODE = "/tod_runner"
HEARD = [f"{NODE}/{name}" for name in ("state", "telemetry", "reply", "url/front", "url/rear")]


class Client:
    """A node of ROS 2 in its own process; see ros_client.py."""

    def __init__(self, name, *topics):
        script = Path(__file__).with_name("ros_client.py")
        self.process = subprocess.Popen(
            [str(PYTHON), "-P", str(script), name, *topics], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self.heard = []  # topic, text
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self):
        for line in self.process.stdout:
            self.heard.append(tuple(json.loads(line)))

    def publish(self, topic, **value):
        self.process.stdin.write(json.dumps({"topic": topic, **value}) + "\n")
        self.process.stdin.flush()

    def texts(self, topic):
        return [text for name, text in tuple(self.heard) if name == f"{NODE}/{topic}"]

    def newest(self, topic):
        return json.loads(until(lambda: self.texts(topic))[-1])

    def ask(self, **event):
        before = len(self.texts("reply"))
        self.publish(f"{NODE}/request", text=json.dumps(event))
        return json.loads(until(lambda: self.texts("reply")[before:])[0])


@contextmanager
def client(name, *topics):
    node = Client(name, *topics)
    try:
        yield node
    finally:
        node.process.stdin.close()
        node.process.wait(20)


@pytest.fixture
def lines():
    return []


@contextmanager
def bridged(lines, *words, keys=None):
    """A vehicle, its broker, and a bridge, whose output goes to `lines`. Yields words of both, broker, both processes.

    keys  of everybody; those of the bridge are a watcher's
    """
    broker = Endpoint("127.0.0.1", free_port())
    ports = [f"control.port={broker.port}", f"media.port={free_port()}"]
    own = ["source=test", "fps_max=15", "modes=open_loop", "pqos=live", "page.serve=false"]
    both = [*SMALL_ROBOT, *own, *ports, f"ros.python={PYTHON}"]
    of = [[f"keys={keys / name}"] if keys else [] for name in (VEHICLE, WATCHER)]
    with (
        private_broker(broker, keys / "broker" if keys else None),
        process("vehicle", *both, *of[0]) as vehicle,
        process("ros", *both, *of[1], *words) as bridge,
    ):
        threading.Thread(target=lambda: lines.extend(bridge.stdout), daemon=True).start()
        until(lambda: told(lines, "requests have the id"))
        yield both, broker, (vehicle, bridge)


def told(lines, part):
    return [line for line in tuple(lines) if part in line]


def test_requests_are_answered_and_a_late_subscriber_knows_all(lines):
    with bridged(lines) as (words, _, (vehicle, _)), client("interface", *HEARD) as operator:
        assert operator.newest("state")["mode"] == "automatic"
        until(lambda: len(operator.texts("telemetry")) > 5)
        reply = operator.ask(id="one", event="mode_selected", mode="collective")
        assert (reply["id"], reply["result"]) == ("one", "applied")
        until(lambda: operator.newest("state")["mode"] == "collective")
        reply = operator.ask(id="two", event="total_set", kbps=-1)
        assert (reply["id"], reply["result"]) == ("two", "refused")
        assert "kbps" in reply["reason"]
        assert operator.ask(event="total_set", kbps=1)["reason"] == "id: must be given, as text"
        operator.publish(f"{NODE}/request", text="{")
        until(lambda: "not JSON" in operator.newest("reply")["reason"])

        media = configuration(words).vehicle()
        assert operator.texts("url/front") == [f"rtsp://127.0.0.1:{media.media.port}/front"]
        plan = next(plan for plan in compile_plans(media) if plan.camera.name == "rear")
        assert f"location={operator.texts('url/rear')[0]}" in plan.receiver.replace('"', "")
        with watching(plan) as viewer:
            until(lambda: len(viewer.sizes) > 5)

        vehicle.terminate()
        until(lambda: operator.texts("state")[-1] == '{"online": false}')
        reply = until(lambda: offline(operator))
        assert reply["result"] == "refused"
    assert told(lines, "Traceback") == []


def offline(operator):
    reply = operator.ask(id="late", event="mode_selected", mode="single")
    return reply if reply["reason"] == "the vehicle is offline" else None


def test_a_request_that_the_vehicle_does_not_answer_times_out(lines):
    with bridged(lines) as (_, _, (vehicle, _)), client("interface", *HEARD) as operator:
        operator.newest("telemetry")
        assert operator.ask(id="one", event="mode_selected", mode="collective")["result"] == "applied"
        vehicle.send_signal(signal.SIGSTOP)
        reply = operator.ask(id="two", event="mode_selected", mode="single")
        vehicle.send_signal(signal.SIGCONT)
        assert (reply["id"], reply["result"]) == ("two", "timed out")
        assert reply["reason"] == "the vehicle has not answered within 3 s"


def test_a_node_that_dies_is_started_again_with_what_late_subscribers_need(lines):
    with bridged(lines) as (_, _, (_, bridge)), client("interface", *HEARD) as operator:
        until(lambda: operator.texts("url/front") and operator.texts("telemetry"))
        (node,) = children_named(bridge.pid, "node.py")
        os.kill(node, signal.SIGKILL)
        until(lambda: told(lines, "the ROS node works again"))
        assert len(told(lines, "the ROS node ended: killed by SIGKILL; starting it again")) == 1
        with client("late", *HEARD) as late:
            assert late.newest("state")["mode"] == "automatic"
            until(lambda: late.texts("url/front") and late.texts("url/rear"))
            reply = late.ask(id="one", event="mode_selected", mode="collective")
            assert reply["result"] == "applied"


def test_requests_have_the_role_of_their_keys(lines, tmp_path):
    with bridged(lines, keys=issue(tmp_path / "keys")) as _, client("interface", *HEARD) as operator:
        until(lambda: operator.texts("telemetry"))
        reply = operator.ask(id="one", event="mode_selected", mode="collective")
        assert (reply["result"], reply["reason"]) == (
            "refused",
            "a watcher may not request mode_selected; only controller may",
        )
        assert operator.ask(id="two", event="operator_connected")["result"] == "applied"
        assert operator.texts("url/front")[0].startswith("rtsps://")
    assert told(lines, f"requests have the id {WATCHER}")


def predicted(reader):
    return reader.newest("telemetry")["predicted_kbps"]


def test_positions_and_predictions_of_one_named_node(lines):
    words = ["ros.position=/gps/fix", "ros.prediction={topic: /pqos/kbps, node: /pqos}"]
    with bridged(lines, *words) as (_, broker, _), client("pqos") as pqos, client("interface", *HEARD) as reader:
        reader.newest("telemetry")
        pqos.publish("/gps/fix", fix=[1.0, 2.0, -1])  # without a fix
        pqos.publish("/gps/fix", fix=[48.25, 11.5, 0])
        until(lambda: reader.newest("telemetry").get("position") == {"lat": 48.25, "lon": 11.5})
        # Its node is discovered a moment after its topic.
        until(lambda: [pqos.publish("/pqos/kbps", number=2345.0), predicted(reader) == 2345][-1], every_s=0.1)
        with client("impostor") as other:
            why = "is published by /impostor, must be by /pqos alone: predictions are left out"
            until(lambda: [other.publish("/pqos/kbps", number=9.0), told(lines, why)][-1], every_s=0.1)
            asker = Operator(broker)
            assert asker.ask("x", event="mode_selected", mode="automatic")["result"] == "applied"
            asker.link.close()
            assert predicted(reader) == 2345
    assert len(told(lines, "is published by")) == 1
