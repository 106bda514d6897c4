"""Converts pipeline times to wall-clock times."""

from __future__ import annotations

import time

from gi.repository import Gst

CLOSE_NS = 20_000  # two clocks read within this count as read simultaneously
TRIES = 10


def unix_time(clock: Gst.Clock, base_time: int, running: int) -> float:
    """A running time of a pipeline, as s since 1970.

    clock, base_time, running  the pipeline's clock; ns by it
    """
    return float((_ahead(clock) + base_time + running) / Gst.SECOND)


def captured_at(pad: Gst.Pad, buffer: Gst.Buffer) -> float:
    """Capture time of a frame on this machine, s since 1970, from its running time."""
    element = pad.get_parent_element()
    segment, clock = pad.get_sticky_event(Gst.EventType.SEGMENT, 0), element.get_clock()
    if segment is None or clock is None:
        return time.time()
    running = segment.parse_segment().to_running_time(Gst.Format.TIME, buffer.pts)
    return unix_time(clock, element.get_base_time(), running)


def _ahead(clock: Gst.Clock) -> int:
    """By how much the wall clock is ahead of another, ns.

    Another thread may run between the two readings. So the wall clock is read before and after the other, several
    times if that took long, and the closest reading counts.
    """
    readings: list[tuple[int, int]] = []  # duration of the reading, ns; difference at its middle
    while len(readings) < TRIES and min(readings, default=(CLOSE_NS + 1, 0))[0] > CLOSE_NS:
        before, there, after = time.time_ns(), clock.get_time(), time.time_ns()
        readings.append((after - before, (before + after) // 2 - there))
    return min(readings)[1]
