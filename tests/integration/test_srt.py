"""The vehicle's SRT caller when nobody answers."""

from __future__ import annotations

import socket
import time
from itertools import pairwise
from statistics import median

import pytest

from rig import free_port, small_robot, until
from runner.configuration.config import configuration
from runner.plans import compile_plans

WORDS = (*small_robot("rear"), "source=test", "fps_max=15", "graph=h264_srt")


@pytest.mark.parametrize(("dscp", "byte"), [(34, 0x88), (0, 0), (-1, 0)])
def test_packets_carry_the_code_point(dscp, byte):
    from runner.gst import Gst

    with socket.socket(type=socket.SOCK_DGRAM) as operator:
        operator.bind(("127.0.0.1", 0))
        operator.setsockopt(socket.IPPROTO_IP, socket.IP_RECVTOS, 1)
        operator.settimeout(20)
        words = (*WORDS, f"graph.first_port={operator.getsockname()[1]}", f"graph.dscp={dscp}")
        (plan,) = compile_plans(configuration(words).setup())
        pipeline = Gst.parse_launch(plan.pipeline)
        pipeline.set_state(Gst.State.PLAYING)
        try:
            _, notes, _, _ = operator.recvmsg(2000, 100)
        finally:
            pipeline.set_state(Gst.State.NULL)
    assert [(kind, data[0]) for _, kind, data in notes] == [(socket.IP_TOS, byte)]


def test_an_unanswered_call_is_repeated_every_second():
    from runner.gst import Gst

    (plan,) = compile_plans(configuration([*WORDS, f"graph.first_port={free_port()}"]).setup())
    pipeline = Gst.parse_launch(plan.pipeline)
    failed = []

    def on_message(_bus, message):
        if message.type == Gst.MessageType.WARNING:
            failed.append(time.monotonic())
        return Gst.BusSyncReply.PASS

    pipeline.get_bus().set_sync_handler(on_message)
    pipeline.set_state(Gst.State.PLAYING)
    try:
        until(lambda: len(failed) > 3)
    finally:
        pipeline.set_state(Gst.State.NULL)
    assert median(after - before for before, after in pairwise(failed)) < 2.0
