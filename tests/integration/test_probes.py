"""Reading buffers: the same as GStreamer's own binding reads, without keeping memory."""

from __future__ import annotations

import threading
from collections import Counter
from contextlib import contextmanager
from pathlib import Path

import pytest

from rig import SMALL_ROBOT, free_port, until
from rtsp_client import RtspClient
from runner.apply import OperatorSide, VehicleSide, VideoFiles
from runner.configuration.config import configuration
from runner.core.commands import Command
from runner.gst import GLib, Gst, supervised
from runner.gst.probes import BufferProbe, IdleProbe
from runner.gst.supervised import SupervisedPipeline
from runner.plans import compile_plans

SAMPLES = 20_000
STAMPED = 3_900_000_000 * Gst.SECOND
FED = "appsrc name=fed format=time ! identity name=seen ! fakesink sync=false"
MADE = "videotestsrc ! video/x-raw,width=40,height=30 ! identity name=seen ! fakesink sync=false"


@contextmanager
def running(line):
    """A pipeline, and a pad that its buffers pass."""
    pipeline = Gst.parse_launch(line)
    try:
        yield pipeline, pipeline.get_by_name("seen").get_static_pad("src")
    finally:
        pipeline.set_state(Gst.State.NULL)


@pytest.fixture
def playing():
    """A pipeline that produces pictures as fast as it can."""
    with running(MADE) as parts:
        yield parts


class Watcher:
    """An owner of a probe."""

    def __init__(self, pad, on_buffer):
        self._on_buffer = on_buffer
        self.probe = BufferProbe(pad, self.on_passed)

    def on_passed(self, pad, buffer):
        return self._on_buffer(pad, buffer)


def resident_kb():
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return int(status["RssAnon"].split()[0])


def fed_buffers():
    """With a timestamp, without one, and with a reference timestamp; of different sizes."""
    for number, pts in enumerate((5, Gst.CLOCK_TIME_NONE, 7)):
        buffer = Gst.Buffer.new_wrapped(bytes(range(40 + number)))
        buffer.pts = pts
        buffer.set_flags(Gst.BufferFlags.LAST)
        if pts == 7:
            buffer.set_flags(Gst.BufferFlags.DISCONT)
            reference = Gst.Caps.from_string("timestamp/x-ntp")
            buffer.add_reference_timestamp_meta(reference, STAMPED, Gst.CLOCK_TIME_NONE)
        yield buffer


def test_it_reads_the_same_as_the_binding():
    stated, read, both = [], [], threading.Event()

    def on_binding(_pad, info):
        buffer = info.get_buffer()
        meta, size = buffer.get_reference_timestamp_meta(None), buffer.get_size()
        pts = None if buffer.pts == Gst.CLOCK_TIME_NONE else buffer.pts
        ends = buffer.extract_dup(0, 16), buffer.extract_dup(size - 8, 16)
        flags = buffer.has_flags(Gst.BufferFlags.DISCONT), buffer.has_flags(Gst.BufferFlags.LAST)
        stated.append((pts, size, *ends, meta.timestamp if meta else None, *flags))
        return Gst.PadProbeReturn.OK

    def on_buffer(_pad, buffer):
        ends = buffer.extract(0, 16), buffer.extract(buffer.size - 8, 16)
        buffer.unset_flags(Gst.BufferFlags.LAST)
        flags = buffer.has_flags(Gst.BufferFlags.DISCONT), buffer.has_flags(Gst.BufferFlags.LAST)
        read.append((buffer.pts, buffer.size, *ends, buffer.reference_ns, *flags))
        if len(read) == 3:
            both.set()
        return len(read) >= 3

    with running(FED) as (pipeline, pad):
        watcher = Watcher(pad, on_buffer)
        watcher.probe.arm()  # probes of a pad are called in order
        pad.add_probe(Gst.PadProbeType.BUFFER, on_binding)
        pipeline.set_state(Gst.State.PLAYING)
        for buffer in fed_buffers():
            pipeline.get_by_name("fed").emit("push-buffer", buffer)
        assert both.wait(20)
    until(lambda: len(stated) == 3)
    assert read == stated
    assert [one[5:] for one in read] == [(True, False), (False, False), (True, False)], "the first is marked as well"
    assert [(one[0], one[1], one[4]) for one in read] == [(5, 40, None), (None, 41, None), (7, 42, STAMPED)]
    assert read[0][2:4] == (bytes(range(16)), bytes(range(32, 40)))  # there are no more bytes


def test_reading_keeps_no_memory(playing):
    pipeline, pad = playing
    looks = [0]

    def on_buffer(_pad, _buffer):
        looks[0] += 1
        return True

    watcher = Watcher(pad, on_buffer)
    pipeline.set_state(Gst.State.PLAYING)

    def look(count):
        def looked():
            watcher.probe.arm()
            return looks[0] >= count

        until(looked, every_s=0)
        return resident_kb()

    begun = look(SAMPLES // 4)
    assert look(SAMPLES) - begun < 500  # the binding's own probe would keep 130 bytes each time: 1950 kB


def test_a_deleted_owner_is_no_longer_called(playing):
    pipeline, pad = playing
    seen = []
    owner = Watcher(pad, lambda _pad, _buffer: seen.append(1))
    owner.probe.arm()
    probe = owner.probe
    Watcher(pad, lambda _pad, _buffer: seen.append(2)).probe.arm()
    del owner  # neither owner is kept alive, although a probe is
    last = Watcher(pad, lambda _pad, _buffer: True)
    pipeline.set_state(Gst.State.PLAYING)
    last.probe.arm()
    until(lambda: not last.probe.armed)
    assert seen == [] and not probe.armed


def test_a_fault_of_the_owner_does_not_drop_buffers(playing, capfd):
    pipeline, pad = playing
    failed, passed = [], []

    def fails(_pad, _buffer):
        if len(failed) == 3:
            return True  # nothing may be printed while it is read
        failed.append(1)
        raise ValueError("a fault")

    owner, after = Watcher(pad, fails), Watcher(pad, lambda _pad, _buffer: passed.append(1))
    owner.probe.arm()
    after.probe.arm()
    pipeline.set_state(Gst.State.PLAYING)
    until(lambda: len(passed) > 3)
    assert capfd.readouterr().err.count("ValueError: a fault") == 3


class FailingOwner:
    def __init__(self):
        self.called = 0
        self.probe = IdleProbe(self.on_idle)

    def on_idle(self):
        self.called += 1
        raise ValueError("a fault")


def test_a_fault_between_two_buffers_does_not_block_them(playing, capfd):
    pipeline, pad = playing
    passed, owner = [], FailingOwner()
    after = Watcher(pad, lambda _pad, _buffer: passed.append(1))
    after.probe.arm()
    pipeline.set_state(Gst.State.PLAYING)
    until(lambda: passed)
    owner.probe.add_to(pad)
    until(lambda: owner.called)
    seen = len(passed)
    until(lambda: len(passed) > seen + 3)
    assert "ValueError: a fault" in capfd.readouterr().err


def counting(made, name, function):
    def counted(*words, **options):
        made[name] += 1
        return function(*words, **options)

    return counted


@pytest.fixture
def made(monkeypatch):
    """Callbacks passed to C, by function: each would be kept forever."""
    counted = Counter()
    for owner, name in ((Gst.Pad, "add_probe"), (GLib, "idle_add"), (GLib, "timeout_add")):
        monkeypatch.setattr(owner, name, counting(counted, name, getattr(owner, name)))
    return counted


@pytest.mark.parametrize("stored", [False, True])
def test_attempts_to_reach_a_vehicle_that_is_away_make_no_callback(stored, made, monkeypatch, tmp_path):
    starts = Counter()
    monkeypatch.setattr(supervised, "RETRY_S", 0.05)
    monkeypatch.setattr(SupervisedPipeline, "_build", counting(starts, "start", SupervisedPipeline._build))
    words = [*SMALL_ROBOT, f"media.port={free_port()}", f"log.video={str(stored).lower()}"]
    setup = configuration(words, runnable=False).setup()
    files = VideoFiles(tmp_path, lambda *_: None, lambda *_: None) if stored else None
    viewer = OperatorSide(compile_plans(setup), lambda *_: None, video=files)
    try:
        until(lambda: starts["start"] > 10)
        made.clear()
        until(lambda: starts["start"] > 40)
        assert not made
    finally:
        viewer.stop()


@pytest.mark.parametrize("source", [(), ("source.frozen_s=1",)], ids=["plain", "watched"])
def test_a_pipeline_that_is_built_again_makes_no_callback(source, made):
    setup = configuration([*SMALL_ROBOT, "source=test", *source, f"media.port={free_port()}"]).setup()
    reported = []
    side = VehicleSide(compile_plans(setup), setup.media, lambda camera, what: reported.append(what))
    camera = next(iter(setup.vehicle.cameras))
    try:
        for number in range(1, 4):
            made.clear()  # those of the first pipeline include the server's own
            side.turn([Command(camera, "bitrate", 500 + number), Command(camera, "size", (160, 90))])
            with RtspClient(f"rtsp://127.0.0.1:{setup.media.port}/{camera}") as client:
                assert client.open() == [200, 200, 200]
                client.read()
                until(lambda c=client: c.frames > 5)
                side.turn([Command(camera, "bitrate", 600), Command(camera, "size", (320, 180))])
                until(lambda c=client: side.read()[camera].applied["size"] == (320, 180))
            until(lambda n=number: reported.count("pipeline stopped") == n)
        assert not made
    finally:
        side.stop()


def test_sides_that_are_sampled_make_no_callback(made):
    setup = configuration([*SMALL_ROBOT, "source=test", f"media.port={free_port()}"]).setup()
    plans = compile_plans(setup)
    side = VehicleSide(plans, setup.media, lambda *_: None)
    viewer = OperatorSide(plans, lambda *_: None)
    try:
        side.turn(Command(name, "bitrate", 500) for name in setup.vehicle.cameras)
        until(lambda: all(one.frames > 20 for one in viewer.sample({}).values()))
        until(lambda: all(side.stages().values()))
        made.clear()
        sampled = [viewer.sample({}) and side.stages() for _ in range(50)]
        latencies = viewer.sample({}).values()
        assert made.total() < len(sampled) // 10  # an RTCP packet from another SSRC adds a jitter buffer
    finally:
        viewer.stop()
        side.stop()
    assert all(sampled[-1].values())
    assert all(one.latency_ms is not None for one in latencies)
