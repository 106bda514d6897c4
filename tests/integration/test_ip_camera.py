"""An IP camera that freezes, disappears or is switched off, while its viewers stay."""

from __future__ import annotations

import re
import signal
import subprocess
import threading
import time
from contextlib import ExitStack, contextmanager

import inside
import pytest

from rig import (
    STREAM_END_SIGNALS,
    count_handlers,
    faults,
    free_port,
    ip_camera,
    rtp_session,
    streaming,
    until,
    watching,
)
from runner.core.commands import Command

WORDS = ("vehicle=delivery_robot", "source=rtsp", "fps_max=15")


def knobs(side, **values):
    side.turn([Command("rear", knob, value) for knob, value in values.items()])


@contextmanager
def driving(*words):
    """A robot whose rear camera is an IP camera. Yields (camera's process, side, vehicle, plan, reported)."""
    with (
        ip_camera(free_port()) as (address, camera),
        streaming(*WORDS, f'source.address="{address}"', *words, cameras=("rear",)) as (side, setup, plans, reported),
    ):
        knobs(side, sending=True, size=(424, 240), bitrate=500)
        yield camera, side, setup, plans[0], reported


@contextmanager
def ffmpeg(setup, transport):
    """A third-party viewer. Yields a function: how many frames it has decoded."""
    url = f"rtsp://127.0.0.1:{setup.media.port}/rear"
    command = ["ffmpeg", "-v", "error", "-progress", "-", "-rtsp_transport", transport, "-i", url, "-f", "null", "-"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
        seen = [0]

        def read():
            for line in child.stdout:
                if line.startswith("frame="):
                    seen[0] = int(line.removeprefix("frame="))

        reader = threading.Thread(target=read, daemon=True)
        reader.start()
        try:
            yield lambda: seen[0] if child.poll() is None else -1
        finally:
            child.kill()
            reader.join(5)


@pytest.mark.parametrize("frozen_s", [4, pytest.param(15, marks=pytest.mark.soak)])
def test_a_camera_that_froze_comes_back_and_viewers_keep_their_session(frozen_s):
    with (
        driving() as (camera, side, setup, plan, reported),
        watching(plan) as client,
        ffmpeg(setup, "tcp") as over_tcp,
        ffmpeg(setup, "udp") as over_udp,
    ):

        def counts():
            return client.frames_with_retry(), over_tcp(), over_udp()

        until(lambda: min(counts()) > 10)
        assert side.read()["rear"].fault is None
        camera.send_signal(signal.SIGSTOP)
        until(lambda: side.read()["rear"].fault)
        assert side.read()["rear"].fault == "source: no frame for 1 s"
        time.sleep(frozen_s - 1)
        frozen = counts()
        camera.send_signal(signal.SIGCONT)
        until(lambda: side.read()["rear"].fault is None)
        until(lambda: all(now > then + 10 for now, then in zip(counts(), frozen, strict=True)))
        assert client.errors == []
        messages = [line.removeprefix("rear: ") for line in faults(reported)]
    assert messages[:2] == ["pipeline built", "source: no frame for 1 s"]
    assert int(re.match(r"works again after (\d+)", messages[-1])[1]) >= frozen_s - 1
    assert len(set(messages)) == len(messages) <= 5  # each reason once, however many attempts


@pytest.mark.parametrize("fps_max", [15, 60])  # after a stall, frames come faster than 30 a second
def test_frames_keep_the_times_of_a_camera_that_is_faster_or_slower(fps_max):
    """It sends 25 a second. None is repeated, and none waits for the next one."""
    from runner.gst import Gst

    decoded, sent = [], []

    def noting(times):
        return lambda _, info: times.append(info.get_buffer().pts) or Gst.PadProbeReturn.OK

    with driving(f"fps_max={fps_max}", "source.frozen_s=10") as (_, side, _, plan, reported), watching(plan) as client:
        until(lambda: client.frames_with_retry() > 10)
        source = inside.sender(side, "rear")
        source.get_by_name("rate").get_static_pad("src").add_probe(Gst.PadProbeType.BUFFER, noting(sent))
        source.get_by_name("convert").get_static_pad("sink").add_probe(Gst.PadProbeType.BUFFER, noting(decoded))
        until(lambda: len(sent) > 20)
        until(lambda: len(decoded) > 40)
        if fps_max > 25:
            until(lambda: set(decoded[-25:-5]) <= set(sent))  # a busy machine may drop some, the rate drops none
        passed, own = [time for time in tuple(sent) if time >= decoded[1]], decoded[1:]  # in this order: both grow
        assert faults(reported) == ["rear: pipeline built"]
    assert passed == [time for time in own if time in passed]  # the camera's times, in order, none twice
    if fps_max < 25:
        assert len(passed) < len(own)


def test_a_camera_that_ends_its_stream_is_reported_and_connected_again():
    """The client's own handlers of RTCP BYE and time-outs may deadlock with the failure of its connection."""
    with driving("source.frozen_s=3") as (camera, side, _, plan, reported), watching(plan) as client:
        until(lambda: client.frames_with_retry() > 10)
        session, ssrc = rtp_session(inside.sender(side, "rear").get_by_name("source"))
        assert [count_handlers(session, name) for name in STREAM_END_SIGNALS] == [2, 2, 2]
        camera.send_signal(signal.SIGSTOP)
        time.sleep(1)  # frames in flight arrive
        source = next(source for source in session.props.sources if source.props.ssrc == ssrc)
        session.emit("on-bye-ssrc", source)
        until(lambda: side.read()["rear"].fault)
        assert side.read()["rear"].fault == "source: the stream ended"
        camera.send_signal(signal.SIGCONT)
        until(lambda: side.read()["rear"].fault is None)
        before = len(client.sizes)
        until(lambda: len(client.sizes) > before + 10)
        assert client.errors == []
        assert faults(reported)[:2] == ["rear: pipeline built", "rear: source: the stream ended"]


def test_a_camera_that_is_off_is_still_monitored():
    with driving("source.frozen_s=3") as (camera, side, _, plan, reported), watching(plan) as client:
        until(lambda: client.frames_with_retry() > 10)
        knobs(side, sending=False)
        until(lambda: side.read()["rear"].applied["sending"] is False)
        time.sleep(5)  # more than the limit for a frozen source
        assert side.read()["rear"].fault is None
        camera.kill()
        until(lambda: side.read()["rear"].fault)
        built, failed, *_ = faults(reported)
        assert built == "rear: pipeline built"
        assert failed.startswith("rear: source: ")


def test_frames_blocked_downstream_are_no_fault_of_the_source():
    from runner.gst import Gst

    with driving("source.frozen_s=3") as (_, side, _, plan, reported), watching(plan) as client:
        until(lambda: client.frames_with_retry() > 10)
        below = inside.sender(side, "rear").get_by_name("gate").get_static_pad("src")
        held = below.add_probe(Gst.PadProbeType.BLOCK_DOWNSTREAM, lambda *_: Gst.PadProbeReturn.OK)
        time.sleep(5)  # more than the limit for a frozen source
        assert side.read()["rear"].fault is None
        before = len(client.sizes)
        below.remove_probe(held)
        until(lambda: len(client.sizes) > before + 10)
        assert faults(reported) == ["rear: pipeline built"]


def test_a_camera_that_restarts_is_connected_again():
    port = free_port()
    with ExitStack() as stack:
        address, camera = stack.enter_context(ip_camera(port))
        words = (*WORDS, f'source.address="{address}"')
        side, _, (plan,), reported = stack.enter_context(streaming(*words, cameras=("rear",)))
        knobs(side, sending=True, size=(424, 240), bitrate=500)
        client = stack.enter_context(watching(plan))
        until(lambda: client.frames_with_retry() > 10)
        camera.kill()
        until(lambda: side.read()["rear"].fault)
        before = len(client.sizes)
        stack.enter_context(ip_camera(port))
        until(lambda: len(client.sizes) > before + 10)
        assert client.errors == []
        until(lambda: side.read()["rear"].fault is None)
        assert reported.count("rear: pipeline built") == 1


def test_a_viewer_of_a_missing_camera_is_refused_and_served_when_it_is_back():
    with driving() as (camera, side, _, plan, reported):
        camera.send_signal(signal.SIGSTOP)
        with watching(plan) as client:
            until(lambda: client.errors)
        camera.send_signal(signal.SIGCONT)
        until(lambda: "rear: pipeline stopped" in reported)
        with watching(plan) as client:
            until(lambda: len(client.sizes) > 10)
            until(lambda: side.read()["rear"].fault is None)


def test_a_paused_pipeline_is_neither_a_fault_nor_a_recovery():
    """The server pauses a pipeline with its last viewer."""
    from runner.gst import Gst

    with driving() as (camera, side, _, plan, reported), watching(plan) as client:
        until(lambda: client.frames_with_retry() > 10)
        camera.send_signal(signal.SIGSTOP)
        until(lambda: side.read()["rear"].fault)
        client.pipeline.set_state(Gst.State.PAUSED)
        time.sleep(1)
        client.pipeline.set_state(Gst.State.PLAYING)
        time.sleep(1)
        assert side.read()["rear"].fault == "source: no frame for 1 s"
        assert not any("works" in what for what in reported)
