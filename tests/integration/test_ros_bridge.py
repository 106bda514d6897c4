"""The control link as ROS topics: `tod-runner ros` between a real vehicle and nodes of real rclpy and rospy."""

from __future__ import annotations

import os
import signal
import threading
from contextlib import contextmanager

import pytest
from ros_domain import MARKS, NODE, SCRIPT

from keyed import VEHICLE, WATCHER, issue
from rig import SMALL_ROBOT, Operator, children_named, free_port, process, until, watching
from runner.configuration.config import configuration
from runner.mqtt.broker import private_broker
from runner.plans import compile_plans
from runner.settings import Endpoint

pytestmark = MARKS
HEARD = [f"{NODE}/{name}" for name in ("state", "driving", "telemetry", "reply", "url/front", "url/rear")]


@pytest.fixture
def lines():
    return []


@contextmanager
def bridged(ros, lines, *words, keys=None):
    """A vehicle, its broker, and a bridge, whose output goes to `lines`. Yields words of both, broker, both processes.

    keys  of everybody; those of the bridge are a watcher's
    """
    broker = Endpoint("127.0.0.1", free_port())
    ports = [f"control.port={broker.port}", f"media.port={free_port()}"]
    own = ["source=test", "fps_max=15", "modes=open_loop", "pqos=live", "page.serve=false"]
    both = [*SMALL_ROBOT, *own, *ports, *ros.words]
    of = [[f"keys={keys / name}"] if keys else [] for name in (VEHICLE, WATCHER)]
    with (
        private_broker(broker, keys / "broker" if keys else None),
        process("vehicle", *both, *of[0]) as vehicle,
        process("ros", *both, *of[1], *words) as bridge,
    ):
        for side in (vehicle, bridge):
            threading.Thread(target=lambda side=side: lines.extend(side.stdout), daemon=True).start()
        until(lambda: matching(lines, "requests have the id"))
        yield both, broker, (vehicle, bridge)


def matching(lines, part):
    return [line for line in tuple(lines) if part in line]


def test_requests_are_answered_and_a_late_subscriber_knows_all(ros, lines):
    with bridged(ros, lines) as (words, _, (vehicle, _)), ros.client("interface", *HEARD) as operator:
        assert operator.newest("state")["mode"] == "automatic"
        assert operator.newest("driving")["state"] == "free"
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

        setup = configuration(words).setup()
        assert operator.texts("url/front") == [f"rtsp://127.0.0.1:{setup.media.port}/front"]
        plan = next(plan for plan in compile_plans(setup) if plan.camera.name == "rear")
        assert f"location={operator.texts('url/rear')[0]}" in plan.receiver.replace('"', "")
        with watching(plan) as viewer:
            until(lambda: len(viewer.sizes) > 5)

        vehicle.terminate()
        until(lambda: operator.texts("state")[-1] == '{"online": false}')
        until(lambda: operator.texts("driving")[-1] == '{"online": false}')
        reply = until(lambda: offline(operator))
        assert reply["result"] == "refused"
    assert matching(lines, "Traceback") == []


def test_operator_inputs_are_topics_and_services(ros, lines):
    """Inputs of an interface that does not use this project's JSON."""
    remap = f"ros.remap={{{NODE}/camera/front/kbps: /operator/bitrate, {NODE}/mode/single: /operator/manual}}"
    with bridged(ros, lines, remap) as (_, _, (vehicle, _)), ros.client("interface", *HEARD) as operator:
        until(lambda: operator.texts("telemetry"))
        assert operator.call("mode/collective") == [True, "applied"]
        reply = operator.set("total_kbps", number=2500.0)
        assert (reply["id"], reply["result"]) == ("~/total_kbps 2", "applied")
        assert operator.call("/operator/manual") == [True, "applied"]
        assert operator.set("/operator/bitrate", number=700.0)["result"] == "applied"
        assert operator.set("camera/front/scaling", number=0.5)["result"] == "applied"
        assert operator.set("camera/front/roi", region=[16, 20, 160, 90])["result"] == "applied"
        decided = until(lambda: with_roi(operator, {"x": 16, "y": 20, "width": 160, "height": 90}))
        assert (decided["kbps"], decided["scaling"]) == (700, 0.5)
        assert operator.set("camera/front/roi", region=[0, 0, 0, 0])["result"] == "applied"
        until(lambda: with_roi(operator, {"x": 0, "y": 0, "width": 320, "height": 180}))
        switched = operator.call("camera/rear/switch", False)
        assert switched == [True, "applied: no viewer for rear: applied when one connects"]
        until(lambda: not operator.newest("state")["cameras"]["rear"]["on"])

        for number, reason in ((float("nan"), "nan: must be a number"), (-1.0, "kbps: -1")):
            reply = operator.set("/operator/bitrate", number=number)
            assert reply["result"] == "refused"
            assert reason in reply["reason"]
        until(lambda: [operator.publish(f"{NODE}/operator_connected", empty=True), matching(lines, "is present")][-1])
        until(lambda: matching(lines, "has been silent for 1 s"))  # nobody else speaks for it

        vehicle.terminate()
        until(lambda: operator.texts("state")[-1] == '{"online": false}')
        until(lambda: operator.call("/operator/manual") == [False, "refused: the vehicle is offline"])
    assert matching(lines, "Traceback") == []


def test_an_input_of_another_type_is_reported_once(ros, lines):
    with bridged(ros, lines), ros.client("interface", *HEARD) as operator:
        operator.publish(f"{NODE}/total_kbps", text="no number")
        found, expected = (ros.type("std_msgs", name) for name in ("String", "Float64"))
        until(lambda: matching(lines, f"~/total_kbps: has messages of type {found}, must be {expected}"))
        until(lambda: operator.texts("telemetry"))
        assert operator.call("mode/collective") == [True, "applied"]
    assert len(matching(lines, "has messages of type")) == 1


def with_roi(operator, roi):
    decided = operator.newest("state")["cameras"]["front"]
    return decided if decided["roi"] == roi else None


def offline(operator):
    reply = operator.ask(id="late", event="mode_selected", mode="single")
    return reply if reply["reason"] == "the vehicle is offline" else None


def test_a_vehicle_that_hangs_is_offline_and_its_requests_time_out(ros, lines):
    with bridged(ros, lines) as (_, _, (vehicle, _)), ros.client("interface", *HEARD) as operator:
        operator.newest("telemetry")
        assert operator.ask(id="one", event="mode_selected", mode="collective")["result"] == "applied"
        vehicle.send_signal(signal.SIGSTOP)
        reply = operator.ask(id="two", event="mode_selected", mode="single")
        until(lambda: operator.texts("state")[-1] == '{"online": false}')
        vehicle.send_signal(signal.SIGCONT)
        until(lambda: operator.newest("state").get("mode"))
        assert (reply["id"], reply["result"]) == ("two", "timed out")
        assert reply["reason"] == "the vehicle did not answer within 3 s"


def test_a_killed_node_is_restarted_with_its_latched_texts(ros, lines):
    with bridged(ros, lines) as (_, _, (_, bridge)), ros.client("interface", *HEARD) as operator:
        until(lambda: operator.texts("url/front") and operator.texts("telemetry"))
        (node,) = children_named(bridge.pid, SCRIPT)
        os.kill(node, signal.SIGKILL)
        until(lambda: matching(lines, "the ROS node works again"))
        assert len(matching(lines, "the ROS node ended: killed by SIGKILL; starting it again")) == 1
        with ros.client("late", *HEARD) as late:
            assert late.newest("state")["mode"] == "automatic"
            until(lambda: late.texts("url/front") and late.texts("url/rear"))
            reply = late.ask(id="one", event="mode_selected", mode="collective")
            assert reply["result"] == "applied"


def test_a_new_master_knows_all_topics_and_services(ros1, lines):
    with bridged(ros1, lines) as (_, _, (_, bridge)):
        (node,) = children_named(bridge.pid, SCRIPT)
        ros1.master.kill()
        until(lambda: matching(lines, f"the ROS master at {ros1.master.uri} does not answer"))
        ros1.master.start()
        until(lambda: matching(lines, f"the ROS master at {ros1.master.uri} answers"))
        with ros1.client("late", *HEARD) as late:
            assert late.newest("state")["mode"] == "automatic"
            until(lambda: late.texts("url/front") and late.texts("url/rear") and late.texts("telemetry"))
            assert late.call("mode/collective") == [True, "applied"]
            assert late.set("total_kbps", number=2500.0)["result"] == "applied"
        assert children_named(bridge.pid, SCRIPT) == [node]
    assert len(matching(lines, "the ROS ")) == 2


def test_requests_have_the_role_of_their_keys(ros, lines, tmp_path):
    with bridged(ros, lines, keys=issue(tmp_path / "keys")) as _, ros.client("interface", *HEARD) as operator:
        until(lambda: operator.texts("telemetry"))
        reply = operator.ask(id="one", event="mode_selected", mode="collective")
        assert (reply["result"], reply["reason"]) == (
            "refused",
            "a watcher may not request mode_selected; only controller or supervisor may",
        )
        assert operator.ask(id="two", event="operator_connected")["result"] == "applied"
        assert operator.texts("url/front")[0].startswith("rtsps://")
    assert matching(lines, f"requests have the id {WATCHER}")


def position(reader):
    return reader.newest("telemetry").get("position")


def predicted(reader):
    return reader.newest("telemetry")["predicted_kbps"]


def test_positions_and_predictions_of_one_named_node(ros, lines):
    words = ["ros.position=/gps/fix", "ros.prediction={topic: /pqos/kbps, node: /pqos}"]
    with (
        bridged(ros, lines, *words) as (_, broker, _),
        ros.client("pqos") as pqos,
        ros.client("interface", *HEARD) as reader,
    ):
        reader.newest("telemetry")
        reply = reader.ask(id="one", event="operator_connected")
        assert (reply["result"], reply["reason"][:34]) == ("refused", "this node reports positions or pre")
        pqos.publish("/gps/fix", fix=[1.0, 2.0, -1])  # without a fix
        here = {"lat": 48.25, "lon": 11.5}
        # Best effort: what is published before the node has discovered the publisher is lost.
        until(lambda: [pqos.publish("/gps/fix", fix=[48.25, 11.5, 0]), position(reader) == here][-1], every_s=0.1)
        # Its node is discovered a moment after its topic.
        until(lambda: [pqos.publish("/pqos/kbps", number=2345.0), predicted(reader) == 2345][-1], every_s=0.1)
        with ros.client("impostor") as other:
            why = "is published by /impostor, must be by /pqos alone: predictions are ignored"
            until(lambda: [other.publish("/pqos/kbps", number=9.0), matching(lines, why)][-1], every_s=0.1)
            asker = Operator(broker)
            assert asker.ask("x", event="mode_selected", mode="automatic")["result"] == "applied"
            asker.link.close()
            assert predicted(reader) == 2345
    assert len(matching(lines, "is published by")) == 1
