"""A first look at the stream of a camera that encodes by itself, before it drives."""

from __future__ import annotations

import time

from gi.repository import Gst

from runner.graph import Plan, launch
from runner.gst.ip_camera import follow_cameras
from runner.gst.passed import LOOKED_AT, PassedStream
from runner.gst.rtspsrc import limit_teardown
from runner.gst.streams import passed_counts

CHECK_S = 0.05
AGAIN_S = 0.5  # after an error


def first_look(plan: Plan, limit_s: float) -> tuple[int, list[str]]:
    """Receive some pictures of a camera, without a login.

    limit_s  from the start to the last of them
    returns  how many came, and what their viewers will have trouble with
    """
    elements = plan.vehicle[: [element.name for element in plan.vehicle].index("sent") + 1]
    pipeline = Gst.parse_launch(f"{launch((*plan.source, *elements))} ! fakesink sync=false")
    found: list[str] = []
    limit_teardown(pipeline)
    follow_cameras(pipeline, plan)
    sent = pipeline.get_by_name("sent")
    stream = PassedStream(sent.get_static_pad("sink"), plan.camera, found.append)
    end, bus = time.monotonic() + limit_s, pipeline.get_bus()
    try:
        pipeline.set_state(Gst.State.PLAYING)
        while time.monotonic() < end and (count := passed_counts(sent)[0]) < LOOKED_AT:
            message = bus.timed_pop_filtered(int(CHECK_S * Gst.SECOND), Gst.MessageType.ERROR)
            if message and not count and time.monotonic() < end - AGAIN_S:
                pipeline.set_state(Gst.State.NULL)
                time.sleep(AGAIN_S)  # a camera may still be ending its last session
                pipeline.set_state(Gst.State.PLAYING)
            elif message:
                found.append(message.parse_error()[0].message)
                break
            stream.look()
        stream.look()  # all of them may have come between two checks
        return count, found
    finally:
        pipeline.set_state(Gst.State.NULL)
