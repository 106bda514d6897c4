"""Cameras that cannot be opened: the others are served and get their share; each is tried again."""

from __future__ import annotations

import json
import shutil
import signal
from pathlib import Path

import pytest

from rig import CLIPS, ROBOT, Operator, free_port, process, run, until
from runner.operator.frames import live_frames

needs_clips = pytest.mark.skipif(not CLIPS, reason="needs the recorded clips")


def events(directory: Path):
    lines = [json.loads(line) for line in (directory / "drive.jsonl").read_text().splitlines()]
    return [line for line in lines if line.get("event") == "source_reported"], lines


def await_frames(frames, *cameras):
    """Wait until each of these cameras has delivered a frame."""
    wanted = set(cameras)

    def seen():
        if frame := frames.next(1.0):
            wanted.discard(frame.camera)
        return not wanted

    until(seen)


def decided(lines):
    return [line for line in lines if line.get("log") == "decision"]


@needs_clips
def test_a_vehicle_drives_without_a_camera_until_it_is_found(tod, broker, tmp_path):
    """Its share goes to the others, and a replay decides the same."""
    clip, drive = tmp_path / "clip.mp4", tmp_path / "drive"
    own = ("+source@cameras.mast.source=file", f"cameras.mast.source.clip={clip}")
    ports = (f"media.port={free_port()}", f"control.port={broker.port}")
    with process("vehicle", *ROBOT, *own, *ports, f"log={drive}") as vehicle:
        operator = Operator(broker)
        state = operator.state(lambda state: state["online"])
        mast, rest = state["cameras"]["mast"], [state["cameras"][name] for name in ("front", "rear")]
        assert (mast["on"], mast["sending"], mast["kbps"]) == (True, False, 0)
        assert mast["fault"] == f"clip: '{clip}': no such file"
        assert sum(camera["kbps"] for camera in rest) in (2999, 3000)
        with live_frames([*ROBOT, *ports]) as frames:
            await_frames(frames, "front", "rear")
            shutil.copy(next(path for path in CLIPS if path.suffix == ".mp4"), tmp_path / "part")
            (tmp_path / "part").rename(clip)
            await_frames(frames, "mast")
        state = operator.reach(lambda state: state["cameras"]["mast"]["sending"])
        assert state["cameras"]["mast"].get("fault") is None
        vehicle.send_signal(signal.SIGTERM)
        output, _ = vehicle.communicate(timeout=20)
    assert f"mast: lost: clip: '{clip}': no such file; trying again" in output
    assert "mast: found again" in output
    reported, lines = events(drive)
    assert [event["works"] for event in reported] == [False, True]
    done = tod("replay", f"input={drive}", f"log={tmp_path / 'again'}", f"output={tmp_path / 'decisions'}")
    assert done.status == 0, done.err
    assert decided(lines) == decided(events(tmp_path / "again")[1])


@needs_clips
def test_a_strict_vehicle_does_not_start_without_a_clip(tmp_path):
    words = ("source=file", f"source.clip={tmp_path}/none.mp4", "strict=true", f"media.port={free_port()}")
    done = run("vehicle", "vehicle=delivery_robot", *words)
    assert (done.returncode, "none.mp4': no such file" in done.stderr) == (2, True)


NOWHERE = 'address="rtsp://127.0.0.1:1/x"'
ABSENT = {
    "device": ("v4l2", ("device=/dev/video99",), "Cannot identify device '/dev/video99'"),
    "no camera": ("v4l2", ("device=/dev/null",), "/dev/null is no camera"),
    "credentials": ("rtsp", (f"source.{NOWHERE}", "source.credentials=/none"), "credentials /none: no such file"),
    "address": ("rtsp", (f"source.{NOWHERE}",), "Could not"),
    "bag": ("bag", ("source.bag=/none.mcap", "source.topic=/camera"), "/none.mcap: no such file"),
    "topic": ("ros", ("source.topic=/camera",), "it has delivered nothing for 3 s"),
}


@pytest.mark.soak
@pytest.mark.sources
@pytest.mark.parametrize("kind", ABSENT)
@pytest.mark.parametrize("graph", ["h264_rtsp", "h264_srt"])
def test_every_kind_of_source_may_be_missing(kind, graph, broker, tmp_path):
    """An address and a topic are only known to be silent once a viewer has asked for them."""
    source, keys, why = ABSENT[kind]
    if graph == "h264_srt" and kind in ("address", "topic"):
        pytest.skip("a camera that dials is tried by its own pipeline")
    own = (f"+source@cameras.mast.source={source}", *(f"cameras.mast.{key}" for key in keys))
    words = (*ROBOT, *own, f"graph={graph}", f"media.port={free_port()}", f"control.port={broker.port}")
    with process("vehicle", *words, f"log={tmp_path / 'drive'}") as vehicle, live_frames([*words]) as frames:
        operator = Operator(broker)
        state = operator.state(lambda state: (state["cameras"]["mast"].get("fault") or "").count(why))
        assert sum(camera["kbps"] for camera in state["cameras"].values()) in (2999, 3000)
        await_frames(frames, "front", "rear")
        assert vehicle.poll() is None
