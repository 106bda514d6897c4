"""Both sides as processes over real RTSP and a real broker."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from itertools import pairwise

import pytest

from rig import CLIPS, ROBOT, SHARED, SMALL_ROBOT, Operator, free_port, process, run, small_robot, until
from runner.core.events import BitratePredicted, CameraSwitched
from runner.drive.log import FILES
from runner.drive.read import read_drive
from runner.errors import RunError
from runner.mqtt.broker import private_broker
from runner.operator.frames import live_frames
from runner.records.operator import Sample
from runner.settings import Endpoint

NAN = b'{"id": "n", "event": "total_set", "kbps": NaN}'
HUGE = b'{"id": "h", "event": "total_set", "kbps": 1e999}'
SRT_PLAYOUT_MS = 60


@pytest.fixture
def vehicle(broker, tmp_path):
    ports = (f"control.port={broker.port}", f"media.port={free_port()}")
    with process("vehicle", *ROBOT, *ports, f"log={tmp_path / 'drive'}") as child:
        yield child


def test_requests_are_answered_applied_or_refused(broker, vehicle, tmp_path):
    operator = Operator(broker)
    state = operator.state(lambda state: state["online"])
    assert state["mode"] == "automatic"
    assert set(state["cameras"]) == {"front", "rear", "mast"}

    assert operator.ask("1", event="mode_selected", mode="collective")["result"] == "applied"
    assert operator.ask("2", event="total_set", kbps=2000)["result"] == "applied"
    assert operator.state(lambda state: state["total_kbps"] == 2000)["cameras"]["mast"]["kbps"] == 416
    assert operator.ask("3", event="camera_switched", camera="rear", on=False)["result"] == "applied"
    assert not operator.state(lambda state: not state["cameras"]["rear"]["on"])["cameras"]["rear"]["sending"]

    refused = {
        "4": ({"event": "camera_switched", "camera": "raer", "on": True}, "unknown camera 'raer', did you mean rear?"),
        "5": (
            {"event": "roi_set", "camera": "rear", "x": 0, "y": 0, "width": 100, "height": 100},
            "roi_set is accepted in mode single only, the mode is collective",
        ),
        "6": ({"event": "total_set", "kbps": -1}, "kbps: -1: must be at least 0"),
        "7": ({"event": "total_st", "kbps": 1}, "event: 'total_st': unknown event, did you mean total_set?"),
        "8": ({"event": "total_set", "kbps": 1, "t": 0}, "t: must not be given, the vehicle stamps events on receipt"),
    }
    for identity, (event, reason) in refused.items():
        reply = operator.ask(identity, **event)
        assert (reply["result"], reply["reason"]) == ("refused", reason)

    for payload in (b"", b"{", b"[1]", b"x" * 100_000, b'{"event": "total_set", "kbps": 1}', b"\xff\xfe", NAN, HUGE):
        operator.publish(payload)
    assert operator.ask("9", event="total_set", kbps=1500)["result"] == "applied"  # still alive
    assert vehicle.poll() is None

    vehicle.send_signal(signal.SIGTERM)
    assert vehicle.wait(timeout=15) == 0
    assert operator.state(lambda state: not state["online"]) == {"online": False}
    lines = [json.loads(line) for line in (tmp_path / "drive" / "drive.jsonl").read_text().splitlines()]
    assert [line["kbps"] for line in lines if line.get("event") == "total_set"] == [2000, 1500]
    times = [line["t"] for line in lines if "event" in line]  # lines of other threads may arrive slightly later
    assert times == sorted(times)


def test_the_state_holds_what_is_applied_and_late_subscribers_receive_it(broker, vehicle):
    operator = Operator(broker)
    state = operator.state(lambda state: state["online"])
    assert {name: camera["applied"] for name, camera in state["cameras"].items()} == {
        "front": {},
        "rear": {},
        "mast": {},
    }
    reply = operator.ask("1", event="mode_selected", mode="collective")
    assert (reply["result"], reply["reason"]) == ("applied", "")
    reply = operator.ask("2", event="total_set", kbps=1200)
    assert reply["reason"] == "no viewer for front, rear, mast: applied when one connects"

    media = f"media.port={vehicle.args[-2].partition('=')[2]}"
    with live_frames([*ROBOT, media], cameras=["rear"]) as frames:
        frames.next(15)
        rear = operator.state(lambda state: state["cameras"]["rear"]["applied"])["cameras"]["rear"]
        assert rear["applied"]["bitrate"] == rear["kbps"]
        assert rear["applied"]["size"] == {"width": rear["width"], "height": rear["height"]}
        assert (
            operator.ask("3", event="total_set", kbps=900)["reason"]
            == "no viewer for front, mast: applied when one connects"
        )
        rear = operator.state(lambda state: state["total_kbps"] == 900)["cameras"]["rear"]
        late = Operator(broker).state(lambda state: state["online"])
        assert late["cameras"]["rear"]["applied"]["bitrate"] == rear["kbps"]
        assert until(lambda: operator.telemetry)[-1]["predicted_kbps"] == 3000


def test_an_operator_who_falls_silent_is_gone(broker, vehicle):
    operator = Operator(broker)
    operator.state(lambda state: state["online"])
    hello = operator.ask("1", event="operator_connected")
    assert hello["result"] == "applied"
    # No goodbye and no last will: silence alone. Sending stops by a rule of modes=safe.
    state = operator.state(lambda state: not any(camera["sending"] for camera in state["cameras"].values()))
    assert "operator" in state["cameras"]["front"]["reason"]
    assert 1.9 < state["t"] - hello["t"] < 20  # by the vehicle's clock: 1 s of silence, and another one by the rule
    # Repeated, as its heartbeat is: a request may be lost with a connection that was just re-established.
    until(lambda: operator.send("2", event="operator_connected") or operator.replies.get("2"), every_s=0.25)
    assert operator.replies["2"]["result"] == "applied"
    operator.state(lambda state: all(camera["sending"] for camera in state["cameras"].values()))


def test_a_drive_replays_to_exactly_the_decisions_that_were_made_live(tod, broker, vehicle, tmp_path):
    """Every decision, with its reason and the commands, at its event; without naming the configuration again."""
    operator = Operator(broker)
    operator.state(lambda state: state["online"])
    operator.ask("1", event="weights_set", weights={"rear": 3})
    operator.ask("2", event="camera_switched", camera="mast", on=False)
    operator.ask("3", event="total_set", kbps=3000)  # refused
    operator.ask("4", event="mode_selected", mode="single")
    operator.ask("5", event="roi_set", camera="front", x=0, y=0, width=160, height=120)
    operator.ask("6", event="mode_selected", mode="automatic")
    vehicle.send_signal(signal.SIGTERM)
    vehicle.wait(timeout=15)
    live = [json.loads(line) for line in (tmp_path / "drive" / "drive.jsonl").read_text().splitlines()]
    done = tod("replay", f"input={tmp_path / 'drive'}", f"log={tmp_path / 'again'}", f"output={tmp_path / 'decisions'}")
    assert done.status == 0, done.err
    replayed = [json.loads(line) for line in (tmp_path / "again" / "drive.jsonl").read_text().splitlines()]
    assert len(decided(live)) > 5
    assert decided(live) == decided(replayed)
    assert [line for line in live if "event" in line] == [line for line in replayed if "event" in line]
    assert not json.loads((tmp_path / "decisions").read_text().splitlines()[-1])["cameras"]["mast"]["on"]


def decided(lines):
    return [line for line in lines if line.get("log") == "decision"]


def test_a_killed_vehicle_is_reported_by_its_last_will_and_its_drive_can_be_read(tod, broker, vehicle, tmp_path):
    operator = Operator(broker)
    operator.state(lambda state: state["online"])
    until(lambda: len((tmp_path / "drive" / "drive.jsonl").read_text().splitlines()) > 12)
    vehicle.kill()
    assert operator.state(lambda state: not state["online"]) == {"online": False}
    vehicle.wait(timeout=15)
    drive = read_drive(tmp_path / "drive")
    assert drive.warnings[-1].endswith("was not closed; the process was killed or is still running")
    assert len(drive.sides["vehicle"].lines) > 10
    assert tod("replay", f"input={tmp_path / 'drive'}").status == 0


@pytest.mark.soak
def test_a_given_duration_begins_when_the_vehicle_is_online(broker, tmp_path):
    ports = (f"control.port={broker.port}", f"media.port={free_port()}")
    with process("operator", *ROBOT, *ports, "duration_s=4", f"log={tmp_path}") as operator:
        log = tmp_path / "operator.jsonl"
        until(lambda: log.exists() and len(log.read_text().splitlines()) > 2)
        time.sleep(1.5)
        with process("vehicle", *ROBOT, *ports):
            operator.communicate(timeout=60)
    samples = [*read_drive(tmp_path).sides["operator"].of(Sample)]
    assert samples[-1].cameras["front"].frames > 0
    assert samples[-1].t - samples[0].t > 5


@pytest.mark.alone
def test_the_operator_sees_what_was_decided_and_returns_after_a_crash(broker):
    ports = (f"control.port={broker.port}", f"media.port={free_port()}")
    with process("operator", *ROBOT, *ports, "duration_s=11") as operator:
        with process("vehicle", *ROBOT, *ports) as first:
            watching = Operator(broker)
            watching.state(lambda state: state["online"] and all(c["applied"] for c in state["cameras"].values()))
            time.sleep(2)
            first.kill()
        with process("vehicle", *ROBOT, *ports):
            output, _ = operator.communicate(timeout=60)
    summary = output[output.rindex("received") :]
    table = [line.split() for line in summary.splitlines()]
    rows = {words[0]: words for words in table if words and words[0] in ("front", "rear")}
    for words in rows.values():
        assert int(words[1]) > 60  # frames of both vehicles
        assert int(words[-1]) >= 1  # rebuilt pipelines
        good, _, windows = words[7:10]
        assert int(windows) >= 2
        assert int(good) >= int(windows) - 1
    assert set(rows) == {"front", "rear"}


@pytest.mark.alone
@pytest.mark.parametrize(
    "graph",
    [
        pytest.param("h264_rtsp", marks=pytest.mark.soak),  # other tests drive over it
        pytest.param("openh264_rtsp", marks=pytest.mark.soak),
        "h264_srt",
    ],
)
def test_the_demo_runs_over_every_transport(graph, tmp_path):
    assert max(seconds_short_of_frames(graph, tmp_path)) <= 1


@pytest.mark.soak  # `make test` leaves less of the machine
@pytest.mark.parametrize("graph", ["h264_rtsp", "openh264_rtsp", "h264_srt"])
def test_no_second_of_a_demo_is_short_of_frames(graph, tmp_path):
    assert max(seconds_short_of_frames(graph, tmp_path)) == 0


def seconds_short_of_frames(graph, tmp_path):
    """By camera, after a demo whose log is checked."""
    words = (
        *SMALL_ROBOT,
        "source=test",
        "fps_max=15",
        "page.serve=false",
        f"graph={graph}",
        f"graph.first_port={free_port(3)}",
        f"media.port={free_port()}",
        f"control.port={free_port()}",
    )
    done = run("demo", *words, "duration_s=6", f"log={tmp_path}")
    assert done.returncode == 0, done.stderr
    frames, short = {}, []
    for line in done.stdout[done.stdout.rindex("received") :].splitlines():
        words = line.split()
        if words and words[0] in ("front", "rear", "mast"):
            assert int(words[1]) > 50, line
            short.append(int(words[3]))
            frames[words[0]] = int(words[1])
    drive = read_drive(tmp_path)
    assert drive.warnings == []
    samples = [*drive.sides["operator"].of(Sample)]
    for name, count in frames.items():
        assert samples[-1].cameras[name].frames == count
        arrivals = [arrival for sample in samples for arrival in sample.cameras[name].arrivals]
        assert len(arrivals) == count
        assert [t for t, _ in arrivals] == sorted(t for t, _ in arrivals)
        for earlier, sample in pairwise(samples):
            latencies = [ms for _, ms in sample.cameras[name].arrivals]
            if earlier.clock_ahead_ms is not None:
                assert None not in latencies
            elif sample.clock_ahead_ms is None:
                assert not any(latencies)
            if graph == "h264_srt" and sample.clock_bound_ms is not None:
                assert all(ms > SRT_PLAYOUT_MS - 2 * sample.clock_bound_ms for ms in latencies)
    return short


@pytest.mark.usefixtures("unprinted")
def test_an_experiment_is_driven_over_a_limited_link_and_reported(tod, tmp_path):
    """Two drives one after the other, their logs of all three sides, one report of both."""
    mine = tmp_path / "conf" / "experiment" / "mine.yaml"
    mine.parent.mkdir(parents=True)
    mine.write_text(
        "# @package _global_\n"
        "defaults: [{override /vehicle: delivery_robot}, {override /source: test}, {override /link: relay}, _self_]\n"
        "link: {share: 0.7}\n"
        "control: {expires_s: 10}\n"  # a busy machine may delay the request
        "experiment: {about: x, duration_s: 5, runs: {equal: [modes=equal], paper: [modes=paper]},"
        " requests: [{at_s: 2, request: {event: camera_switched, camera: mast, 'on': false}},"
        " {at_s: 100, request: {event: camera_switched, camera: mast, 'on': true}}]}\n"
    )
    ports = ("page.serve=false", "fps_max=10", f"media.port={free_port()}", f"control.port={free_port()}")
    words = (f"conf={tmp_path / 'conf'}", "experiment=mine", *ports, f"output={tmp_path / 'out'}")
    done = tod("demo", *words)
    assert done.status == 0, done.err
    assert [line for line in done.out.splitlines() if "was not applied" in line] == []
    assert done.out.count("the request at 100 s was not made: the drive ended before") == 2
    for name in ("equal", "paper"):
        drive = read_drive(tmp_path / "out" / name)
        assert (sorted(drive.sides), drive.warnings) == (["link", "operator", "vehicle"], [])
        link = drive.sides["link"].lines
        assert len(link) > 2 * (link[-1].t - link[0].t)  # ten a second, unless the machine is busy
        assert link[-1].bytes > 100_000
        assert [(e.camera, e.on) for e in drive.sides["vehicle"].of(CameraSwitched)] == [("mast", False)]
        predicted = [event.kbps for event in drive.sides["vehicle"].of(BitratePredicted)]
        assert link[len(link) // 2].kbps <= 0.75 * max(predicted)
        carries = sum(125 * line.kbps * (after.t - line.t) for line, after in pairwise(link))
        assert link[-1].dropped > 0 or link[-1].bytes < 0.9 * carries  # more was sent, unless the machine is busy
    page = (tmp_path / "out" / "index.html").read_text()
    assert "equal" in page and "paper" in page
    again = tod("demo", *words)
    assert again.status == 2
    assert again.err.startswith(f"command line: output: '{tmp_path / 'out'}': must be a new or empty directory")


@pytest.mark.soak
def test_a_sweep_drives_each_of_its_runs_as_if_started_alone(tmp_path):
    ports = ("page.serve=false", f"media.port={free_port()}", f"control.port={free_port()}")
    words = (*ROBOT, *ports, "duration_s=3", "cameras.front.weight=1,3")
    wrong = run("demo", "-m", *words, "modes=paper,nothing", f"log={tmp_path / 'wrong'}")
    assert (wrong.returncode, wrong.stdout) == (2, "")
    assert not (tmp_path / "wrong").exists()  # nothing ran

    done = run("demo", "-m", *words, f"log={tmp_path / 'log'}", f"output={tmp_path / 'out'}")
    assert done.returncode == 0, done.stderr
    for directory in (tmp_path / "log", tmp_path / "out"):
        lines = [json.loads(line) for line in (directory / "runs.jsonl").read_text().splitlines()]
        assert [line["directory"] for line in lines] == ["0", "1"]
        assert [line["overrides"][-1] for line in lines] == ["cameras.front.weight=1", "cameras.front.weight=3"]
    for name, weight in (("0", 1), ("1", 3)):
        drive = read_drive(tmp_path / "log" / name)
        assert (sorted(drive.sides), drive.warnings) == (["operator", "vehicle"], [])
        assert [*drive.sides["operator"].of(Sample)][-1].cameras["front"].frames > 0
        first = json.loads((tmp_path / "log" / name / FILES["vehicle"]).read_text().splitlines()[0])
        assert first["config"]["cameras"]["front"]["weight"] == weight
        assert (tmp_path / "out" / name / "index.html").exists()


@pytest.mark.soak
@pytest.mark.skipif(not CLIPS, reason="needs the recorded clips")
def test_the_demo_runs_a_real_clip_along_a_real_map(tmp_path):
    words = (
        "page.serve=false",
        "fps_max=5",
        "source=file",
        f"source.clip={SHARED / 'video' / 'forward_highway_day_540p25_A.mp4'}",
        f"pqos.file={SHARED / 'traces' / 'raw' / 'tum_bandwidth_map.yaml'}",
        f"media.port={free_port()}",
        f"control.port={free_port()}",
    )
    done = run("demo", *words, "duration_s=6", f"log={tmp_path}")
    assert done.returncode == 0, done.stderr
    assert "front_left" in done.stdout
    lines = [json.loads(line) for line in (tmp_path / "drive.jsonl").read_text().splitlines()]
    assert {line["kbps"] for line in lines if line.get("event") == "bitrate_predicted"} <= {2500, 4500, 8000}


def test_missing_requirements_are_reported_in_one_line_with_status_1(broker, tmp_path):
    port = f"control.port={broker.port}"
    device = ("source=v4l2", "cameras.front.device=/dev/video99")
    absent = run("vehicle", *small_robot("front"), *device, "strict=true", port, f"media.port={free_port()}")
    assert absent.returncode == 1
    assert "camera front: Cannot identify device '/dev/video99'." in absent.stderr
    assert "Traceback" not in absent.stderr

    with socket.create_server(("127.0.0.1", 0)) as other:
        words = (f"media.port={other.getsockname()[1]}", f"log={tmp_path / 'never'}")
        taken = run("vehicle", *ROBOT, port, *words)
    assert taken.returncode == 1
    assert not (tmp_path / "never").exists()

    taken = run("vehicle", *ROBOT, port, f"media.port={broker.port}")
    assert taken.returncode == 2  # the same port twice is a mistake in the configuration

    busy = run("demo", *ROBOT, port, f"media.port={free_port()}", "duration_s=2")
    assert busy.returncode == 1
    assert f"cannot listen on 127.0.0.1:{broker.port}: address already in use" in busy.stderr


def test_an_encoder_whose_hardware_is_missing_is_named(broker):
    done = run("vehicle", *ROBOT, "graph=h264_va_rtsp", f"control.port={broker.port}", f"media.port={free_port()}")
    assert done.returncode == 1
    rule = "the GStreamer element vah264enc needs hardware and a driver that its plugin va does not find here"
    assert done.stderr.splitlines() == [rule]


def test_a_broker_that_cannot_start_is_reported(tmp_path, monkeypatch):
    broken = tmp_path / "mosquitto"
    broken.write_text("#!/bin/sh\necho 'Error: Address not available'\nexit 1\n")
    broken.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    with (
        pytest.raises(RunError, match=r"mosquitto does not start on .*: Error: Address not available; choose "),
        private_broker(Endpoint("127.0.0.1", free_port())),
    ):
        pass


BOTH_SIDES = """
import json, sys, time
from runner.operator.live import live_operator
from runner.vehicle.live import live_vehicle
with live_vehicle(sys.argv[2:], log=sys.argv[1], say=lambda line: None) as vehicle:
    vehicle.start()
    with live_operator(sys.argv[2:], log=sys.argv[1]) as operator:
        operator.start(lambda camera, unit: None)
        end = time.monotonic() + 60
        while not operator.station.state and time.monotonic() < end:
            time.sleep(0.1)
        assert operator.station.state
tools = ("runner.drive", "runner.link", "runner.rate_quality", "runner.synthetic")
print(json.dumps(sorted(name for name in sys.modules if name.startswith(tools))))
"""


def test_a_side_that_drives_loads_no_evaluation_tool_but_the_log_writer(broker, tmp_path):
    words = (*ROBOT, f"control.port={broker.port}", f"media.port={free_port()}", "link=relay")
    program = BOTH_SIDES.replace("sys.argv[1]", "__import__('pathlib').Path(sys.argv[1])")
    command = [sys.executable, "-c", program, str(tmp_path / "drive"), *words]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1]) == ["runner.drive", "runner.drive.log"]
