"""Arrival times of UDP packets by the kernel: those of a process that is held up would be late."""

from __future__ import annotations

import os
import socket

from gi.repository import Gst

SO_TIMESTAMPNS = 35  # asm-generic/socket.h
REALTIME = 1  # GstSocketTimestampMode, GStreamer 1.20
# A packet waits for less than the first in the kernel; one that seems to have waited longer, or to arrive in the future
# by more than the second, has another clock's time.
UNREAD_S, FUTURE_S = 2.0, 0.1


def state_arrivals(source: Gst.Element) -> bool:
    """Make a udpsrc state in the DTS of each packet when the kernel received it, not when the element read it.

    The element asks the kernel for it when it opens, which a client's has done before it can be configured.

    returns  whether it will
    raises   OSError if the system lacks such times
    """
    if source.find_property("socket-timestamp") is None or (used := source.get_property("used-socket")) is None:
        return False
    with socket.socket(fileno=os.dup(used.get_fd())) as duplicate:
        duplicate.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
    source.set_property("socket-timestamp", REALTIME)
    return True


def received_at(dts: int, base_time: int, now: float) -> float | None:
    """When the kernel received a packet, s, by DTS and base time of its element, ns; None if that cannot be right."""
    arrived = (base_time + dts) / Gst.SECOND  # a pipeline's clock is the monotonic one
    return min(arrived, now) if now - UNREAD_S < arrived < now + FUTURE_S else None
