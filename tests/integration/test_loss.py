"""Lost packets: no incomplete picture reaches a viewer, whatever is lost."""

from __future__ import annotations

import random
import struct
import subprocess
import time
from contextlib import contextmanager
from statistics import median

import inside
import pytest

from rig import rejected, streaming, until, watching
from runner.core.commands import Command

pytestmark = pytest.mark.gst
SENDING = {"front_left": True}


@pytest.mark.parametrize("graph", ["h264_rtsp", pytest.param("openh264_rtsp", marks=pytest.mark.soak)])
def test_incomplete_units_are_dropped(graph, monkeypatch):
    from runner.apply import OperatorSide

    chance = random.Random(1)
    inside.losing(monkeypatch, "rtpjitterbuffer", "sink", lambda _: chance.random() < 0.01)
    units = []
    overrides = (f"graph={graph}", "graph.retransmission_ms=0", "fps_max=15")  # lost packets stay lost
    with streaming(*overrides) as (side, _, plans, _):
        knobs = {"sending": True, "size": (960, 520), "bitrate": 3000}
        side.turn([Command("front_left", *knob) for knob in knobs.items()])
        operator = OperatorSide(plans, lambda *_: None, lambda camera, unit: units.append(unit))
        try:
            until(lambda: operator.sample({"front_left": True})["front_left"].lost > 20, seconds=40)
            time.sleep(1)
            received = operator.sample({"front_left": True})["front_left"]
        finally:
            operator.stop()
    assert 0 < received.frames - len(units) < received.frames / 2
    command = ["ffmpeg", "-v", "warning", "-threads", "1", "-err_detect", "explode", "-f", "h264", "-i", "-"]
    data = b"".join(unit.data for unit in units)
    errors = subprocess.run([*command, "-f", "null", "-"], input=data, capture_output=True, check=False).stderr.decode()
    assert "error while decoding" not in errors
    assert "concealing" not in errors


def test_lost_packets_are_retransmitted(monkeypatch):
    """Most packets lost in transit are retransmitted (RFC 4588), and few pictures are left out."""
    from runner.apply import OperatorSide

    chance, dropped = random.Random(1), []

    def is_lost(packet):
        lost = packet.get_size() >= 500 and chance.random() < 0.01  # never the control packets
        dropped.extend([packet.get_size()] if lost else [])
        return lost

    inside.losing(monkeypatch, "udpsrc", "src", is_lost)
    with streaming("fps_max=15") as (side, _, plans, _):
        knobs = {"sending": True, "size": (960, 520), "bitrate": 3000}
        side.turn([Command("front_left", *knob) for knob in knobs.items()])
        operator = OperatorSide(plans, lambda *_: None)
        try:
            until(lambda: len(dropped) > 30, seconds=60)
            time.sleep(1)
            lost = operator.sample({"front_left": True})["front_left"].lost
        finally:
            operator.stop()
    assert lost < len(dropped) / 2  # the others were sent again


@pytest.mark.alone
@pytest.mark.parametrize("by_time", [True, pytest.param(False, marks=pytest.mark.soak)])
def test_the_loss_of_the_end_of_a_frame_is_detected_before_the_next_frame(monkeypatch, by_time):
    from runner.apply import OperatorSide
    from runner.gst import arriving, repair

    dropped = []

    def is_lost(packet):
        kind = packet.extract_dup(1, 1)[0]
        lost = kind == arriving.MARKER | 96  # of the last packets, but not those that are sent again
        dropped.extend([kind] if lost else [])
        return lost

    inside.losing(monkeypatch, "udpsrc", "src", is_lost)
    if not by_time:  # as if only later packets revealed the loss
        monkeypatch.setattr(repair.RepairBuffer, "request_tail", lambda self: None)
    with streaming("fps_max=3") as (side, _, plans, _):
        knobs = {"sending": True, "size": (960, 520), "bitrate": 3000}
        side.turn([Command("front_left", *knob) for knob in knobs.items()])
        operator = OperatorSide(plans, lambda *_: None, arrivals=True)
        arrivals = []
        try:
            until(lambda: arrivals.extend(operator.sample(SENDING)["front_left"].arrivals) or len(arrivals) > 10)
            received = operator.sample(SENDING)["front_left"]
        finally:
            operator.stop()
    assert received.buffer_ms
    assert len(dropped) > 5
    assert (median(arrived - captured for arrived, captured in arrivals) < 1 / 3 / 2) is by_time


@pytest.mark.parametrize("graph", ["h264_rtsp", pytest.param("openh264_rtsp", marks=pytest.mark.soak)])
def test_a_picture_with_unrecovered_loss_is_healed_by_a_key_frame(graph, monkeypatch):
    """Long before the next refresh wave or key frame."""
    from runner.apply import OperatorSide

    left = [0]  # packets to lose

    def is_lost(_packet):
        left[0] -= 1
        return left[0] >= 0

    inside.losing(monkeypatch, "rtpjitterbuffer", "sink", is_lost)
    units = []
    overrides = (f"graph={graph}", "graph.retransmission_ms=0", "graph.key_interval_s=60", "fps_max=15")
    with streaming(*overrides) as (side, _, plans, reported):
        knobs = {"sending": True, "size": (480, 260), "bitrate": 2000}
        side.turn([Command("front_left", *knob) for knob in knobs.items()])
        operator = OperatorSide(plans, lambda *_: None, lambda camera, unit: units.append(unit))
        try:
            until(lambda: len(units) > 20)
            left[0] = 3
            until(lambda: operator.take_arrivals()[""].damaged)
            lost_at = len(units)
            until(lambda: len(units) > lost_at + 20)
            assert operator.take_arrivals()[""].damaged == ["front_left"]  # nothing else heals it
            side.send_key_frames(["front_left", "no_such_camera"])
            asked_at = len(units)
            until(lambda: not operator.take_arrivals()[""].damaged)
            assert len(units) - asked_at < 15
            until(lambda: len(units) > asked_at + 30)
            assert operator.take_arrivals()[""].damaged == []
            received = operator.sample(SENDING)["front_left"]
            assert (received.width, received.height) == knobs["size"]
        finally:
            operator.stop()
    assert not rejected(reported)


@contextmanager
def jitter_buffer():
    """Yields a function that pushes frames of one packet, and a list of the PTS of those that left, ms."""
    from runner.gst import Gst
    from runner.gst.repair import RepairBuffer

    caps = "application/x-rtp,media=video,clock-rate=90000,encoding-name=H264,payload=96"
    line = f"appsrc name=source format=time caps={caps} ! rtpjitterbuffer name=buffer ! fakesink name=sink"
    pipeline = Gst.parse_launch(line)
    left = []

    def note(_pad, info):
        left.append(info.get_buffer().pts / Gst.MSECOND)
        return Gst.PadProbeReturn.OK

    def push(number, sent_ms, arrived_ms):
        buffer = Gst.Buffer.new_wrapped(struct.pack(">BBHII", 0x80, 0x80 | 96, number, 90 * sent_ms, 1) + bytes(100))
        buffer.dts = round(arrived_ms * Gst.MSECOND) % 2**64
        pipeline.get_by_name("source").emit("push-buffer", buffer)

    repair = RepairBuffer(pipeline.get_by_name("buffer"), 5, kernel_times=True)
    pipeline.get_by_name("sink").get_static_pad("sink").add_probe(Gst.PadProbeType.BUFFER, note)
    pipeline.set_state(Gst.State.PLAYING)
    try:
        yield push, left
    finally:
        pipeline.set_state(Gst.State.NULL)
        del repair  # its probe ends with it


def test_an_outage_does_not_shift_the_time_base_of_the_jitter_buffer(monkeypatch):
    """By more than the longest wait: lost packets, and pictures behind them, are awaited longer by as much."""
    from runner.gst import packet_times, repair

    transit_ms, outage_ms = 50, (3000, 5000)
    # The link then carries three times what is sent, so that the delay falls slowly.
    sent_ms = range(0, 9000, 20)
    arrivals_ms = [max(at, outage_ms[1] + (at - outage_ms[0]) / 3) if at >= outage_ms[0] else at for at in sent_ms]
    for limit in ("UNREAD_S", "FUTURE_S"):  # they are pushed at once
        monkeypatch.setattr(packet_times, limit, float("inf"))
    with jitter_buffer() as (push, left):
        for number, (sent, arrived) in enumerate(zip(sent_ms, arrivals_ms, strict=True)):
            push(number, sent, arrived + transit_ms)
        until(lambda: len(left) == len(sent_ms))
    shifted = [pts - sent - transit_ms for pts, sent in zip(left, sent_ms, strict=True)]
    assert max(shifted) <= repair.LONGEST_MS


@pytest.mark.parametrize("ahead_ms", [-3700, 60_000])
def test_pictures_pass_whatever_the_kernels_clock_says(ahead_ms):
    """It states when packets arrived; where it is not this process's clock, as in tests, that makes no sense."""
    with jitter_buffer() as (push, left):
        for number in range(50):
            push(number, 20 * number, 20 * number + ahead_ms)
        until(lambda: len(left) == 50)
    assert max(left) < 10_000


def test_a_graph_without_key_frame_requests_gets_none():
    with streaming("graph.key_frame=null", "fps_max=15") as (side, _, (plan,), _), watching(plan) as client:
        until(lambda: len(client.sizes) > 5)
        side.send_key_frames(["front_left"])
        seen = len(client.sizes)
        until(lambda: len(client.sizes) > seen + 5)
        assert client.errors == []
