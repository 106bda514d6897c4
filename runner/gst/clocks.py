"""Converts pipeline times to wall-clock times."""

from __future__ import annotations

import time

from gi.repository import Gst


def unix_time(clock: Gst.Clock, base_time: int, running: int) -> float:
    """A running time of a pipeline, as s since 1970.

    clock, base_time, running  the pipeline's clock; ns by it
    """
    from runner.system.kernel_clock import ahead_of

    return float((ahead_of(clock.get_time) + base_time + running) / Gst.SECOND)


def captured_at(pad: Gst.Pad, pts: int) -> float:
    """Capture time of a frame on this machine, s since 1970, from its timestamp at a pad."""
    element = pad.get_parent_element()
    segment, clock = pad.get_sticky_event(Gst.EventType.SEGMENT, 0), element.get_clock()
    if segment is None or clock is None:
        return time.time()
    running = segment.parse_segment().to_running_time(Gst.Format.TIME, pts)
    return unix_time(clock, element.get_base_time(), running)
