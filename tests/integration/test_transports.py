"""How a viewer's packets travel: over UDP, or in the RTSP connection."""

from __future__ import annotations

import socket
from contextlib import ExitStack, contextmanager
from statistics import median

import pytest

from rig import over_tcp, streaming, until
from runner.core.commands import Command
from runner.gst.receiver import OVER_TCP

pytestmark = pytest.mark.gst
CAMERA = "rear"
SMALL = ("vehicle=delivery_robot", "cameras.rear.width_px=320", "cameras.rear.height_px=180")


@contextmanager
def driving(*overrides, tcp=False):
    """A camera that is sent; yields its vehicle's side, its operator's side, its plan and what both report."""
    from runner.apply import OperatorSide

    with streaming(*SMALL, *overrides, cameras=(CAMERA,)) as (side, _, (plan,), reported):
        knobs = {"sending": True, "size": (320, 180), "bitrate": 300}
        side.turn([Command(CAMERA, *knob) for knob in knobs.items()])
        operator = OperatorSide(
            [over_tcp(plan) if tcp else plan], lambda cameras, what: reported.append(f"operator: {cameras}: {what}")
        )
        try:
            yield side, operator, plan, reported
        finally:
            operator.stop()


def received(operator):
    return operator.sample({CAMERA: True})[CAMERA]


@pytest.mark.alone
@pytest.mark.parametrize("tcp", [True, pytest.param(False, marks=[pytest.mark.soak, pytest.mark.players])])
def test_a_picture_does_not_wait_for_the_next_one(tcp):
    """Over TCP, too; at 5 Hz the next one comes 200 ms later."""
    with driving("fps_max=5", tcp=tcp) as (_, operator, _, _):
        latencies = []

        def enough():
            latency_ms = received(operator).latency_ms
            if latency_ms is not None and latency_ms not in latencies:
                latencies.append(latency_ms)
            return len(latencies) >= 10

        until(enough, every_s=0.1)
        assert median(latencies) < 100


def test_a_viewer_that_falls_back_to_tcp_is_named():
    """Another program holds the ports for RTP."""
    with ExitStack() as stack:
        for port in range(28000, 28006):
            stack.enter_context(socket.socket(type=socket.SOCK_DGRAM)).bind(("127.0.0.1", port))
        _, operator, _, reported = stack.enter_context(driving("media.rtp_ports=[28000,28005]"))
        until(lambda: received(operator).frames > 5, every_s=0.1)
        until(
            lambda: {"rear: over TCP, UDP ports 28000-28005 are in use", f"operator: rear: {OVER_TCP}"} <= set(reported)
        )
