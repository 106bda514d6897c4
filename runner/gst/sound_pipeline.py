"""The pipeline of the vehicle's sound, as the RTSP server serves it."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from gi.repository import Gst

from runner.core.model import Element
from runner.graph import launch
from runner.gst.requests import RequestLimit
from runner.gst.streams import NOT_SEEKABLE, add_capture_time, drop_queued_packet, passed_counts
from runner.records.vehicle import NOTHING_ENCODED, EncoderCounts
from runner.sound import SoundPlan

if TYPE_CHECKING:
    from runner.gst.uplinks import CameraUplinks

CHECK_S, LOOK_MS = 3.0, 20  # how long a source may take to start when it is tried; between two looks


class SoundPipeline:
    """Beside cameras' pipelines at the server; nothing of it changes while it plays.

    on_report  called, from any thread, with requests of viewers beyond their limit
    uplinks    None: the system's routes decide
    """

    is_opening = paused = False
    source_fault = None

    def __init__(
        self, pipeline: Gst.Bin, plan: SoundPlan, on_report: Callable[[str], None], uplinks: CameraUplinks | None
    ) -> None:
        self._pipeline, self.uplinks = pipeline, uplinks
        self.frame_s, self.kbps = plan.packet_ms / 1000, int(plan.wire_kbps)
        self._sent = pipeline.get_by_name("sent")  # None: nothing is counted
        payloader = pipeline.get_by_name(plan.vehicle[-1].name)
        add_capture_time(payloader)
        last = payloader.get_static_pad("src")
        self.requests = RequestLimit(last, on_report)
        NOT_SEEKABLE.add_to(last)

    def catch_up(self) -> None:
        """It has no knobs."""

    def has_waited(self, seconds: float) -> bool:
        return False

    def counters(self) -> EncoderCounts:
        """What the encoder has output so far, counted in C."""
        return EncoderCounts(*passed_counts(self._sent)) if self._sent else NOTHING_ENCODED

    def drop_queued_packet(self) -> None:
        """Drop the packet queued for an interleaved viewer, if any."""
        drop_queued_packet(self._pipeline)

    def send_key_frame(self) -> None:
        """Each packet can be decoded by itself."""


def sound_problem(plan: SoundPlan) -> str | None:
    """Why the source of sound does not open, or gives none; None if it does."""
    pipeline = Gst.parse_launch(f"{launch(plan.source)} ! fakesink name=sink-of-test sync=false")
    sink, bus, until = pipeline.get_by_name("sink-of-test"), pipeline.get_bus(), time.monotonic() + CHECK_S
    try:
        pipeline.set_state(Gst.State.PLAYING)
        while time.monotonic() < until:
            if message := bus.timed_pop_filtered(LOOK_MS * Gst.MSECOND, Gst.MessageType.ERROR):
                return f"{_named(plan.source[0])}: {str(message.parse_error()[0].message).rstrip('.')}"
            if sink.get_property("last-sample"):
                return None
        return f"{_named(plan.source[0])} gives no sound within {CHECK_S:g} s"
    finally:
        pipeline.set_state(Gst.State.NULL)


def _named(source: Element) -> str:
    """The element and what it reads: alsasrc hw:1."""
    read = (source.properties.get(key) for key in ("device", "location"))
    return " ".join(str(each) for each in (source.factory, *read) if each)
