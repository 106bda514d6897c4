"""The vehicle's SRT caller when nobody answers."""

from __future__ import annotations

import time

from rig import free_port, until
from runner.configuration.config import configuration
from runner.plans import compile_plans

WORDS = ("vehicle=delivery_robot", "~cameras.front", "~cameras.mast", "source=test", "fps_max=15", "graph=h264_srt")


def test_an_unanswered_call_is_repeated_every_second():
    from runner.gst import Gst

    (plan,) = compile_plans(configuration([*WORDS, f"graph.first_port={free_port()}"]).vehicle())
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
    assert failed[3] - failed[0] < 3 * 2.0
