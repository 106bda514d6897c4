"""The vehicle's sound in the log of a drive, and in its exports, from a real drive."""

from __future__ import annotations

import json
from itertools import pairwise
from statistics import median

import pytest
from test_export import bag_messages, fields, messages
from test_sound import TONE_DB, rms

from rig import SMALL_ROBOT, free_port, run

pytest.importorskip("foxglove")
pytestmark = pytest.mark.gst
DEMO = (*SMALL_ROBOT, "source=test", "fps_max=5", "sound=test", "page.serve=false", "duration_s=6")


def demo(log, *words):
    ports = (f"media.port={free_port()}", f"control.port={free_port()}")
    done = run("demo", *DEMO, *ports, f"log={log}", *words)
    assert done.returncode == 0, done.stdout + done.stderr
    return [json.loads(line) for line in (log / "operator.jsonl").read_text().splitlines()]


def decoded(packets):
    """The samples of Opus packets."""
    from runner.gst import Gst

    caps = "audio/x-opus,channel-mapping-family=0,channels=1,rate=48000"
    pipeline = Gst.parse_launch(
        f"appsrc name=src format=time caps={caps} ! opusdec ! audio/x-raw,format=S16LE ! appsink name=sink sync=false"
    )
    source, sink, samples = pipeline.get_by_name("src"), pipeline.get_by_name("sink"), b""
    pipeline.set_state(Gst.State.PLAYING)
    try:
        for number, packet in enumerate(packets):
            buffer = Gst.Buffer.new_wrapped(packet)
            buffer.pts, buffer.duration = 20 * number * Gst.MSECOND, 20 * Gst.MSECOND
            source.emit("push-buffer", buffer)
        source.emit("end-of-stream")
        while sample := sink.emit("try-pull-sample", 5 * Gst.SECOND):
            buffer = sample.get_buffer()
            samples += buffer.extract_dup(0, buffer.get_size())
    finally:
        pipeline.set_state(Gst.State.NULL)
    return samples


def test_recorded_sound_is_exported_and_can_be_decoded(tod, tmp_path):
    drive = tmp_path / "drive"
    lines = demo(drive, "log.sound=true")
    samples = [line["sound"] for line in lines if line.get("log") == "sample"]
    assert all(sample["recorded"] for sample in samples)
    kept = [packet for line in lines if line.get("log") == "sound" for packet in line["packets"]]
    assert len(kept) > 100
    assert tod("export", str(drive)).status == 0
    schema, _, found = messages(drive / "drive.mcap")["/sound_received"]
    assert schema.name == "foxglove.CompressedAudio"
    packets = [fields(message.data)[2] for message in found]
    assert (len(packets), {len(packet) for packet in packets}) == (len(kept), {60})
    times = [message.log_time / 1e9 for message in found]
    assert times == pytest.approx([captured for captured, _ in kept if captured], abs=1e-6)
    assert median(b - a for a, b in pairwise(times)) == pytest.approx(0.02, abs=0.001)
    assert rms(decoded(packets)[-48000:]) == pytest.approx(32768 * 10 ** (TONE_DB / 20), rel=0.1)
    pytest.importorskip("rosbags")
    assert tod("export", str(drive), "format=rosbag2").status == 0
    kind, same = bag_messages(drive / "rosbag2")["/sound_received"]
    assert kind == "audio_common_msgs/msg/AudioDataStamped"
    assert [message.audio.data.tobytes() for _, message in same] == packets
    assert [ns for ns, _ in same] == [message.log_time for message in found]


def test_sound_is_recorded_only_if_asked(tmp_path):
    lines = demo(tmp_path / "drive")
    assert not [line for line in lines if line.get("log") == "sound"]
    assert not [line for line in lines if line.get("log") == "sample" and line["sound"]["recorded"]]
