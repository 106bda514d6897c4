"""The pipeline of the vehicle's sound, as the RTSP server serves it."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from gi.repository import Gst

from runner.core.model import Element
from runner.graph import launch
from runner.gst.probes import EventProbe
from runner.gst.requests import RequestLimit
from runner.gst.streams import NOT_SEEKABLE, add_capture_time, drop_queued_packet, passed_counts
from runner.gst.timers import later
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
        self.is_joined = False  # is not asked: each packet can be decoded by itself
        NOT_SEEKABLE.add_to(last)
        if plan.repeats:
            end = pipeline.get_by_name(plan.source[-1].name)
            self._repeating = _Repeating(end.get_static_pad("sink"))

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


class _Repeating:
    """Makes a clip begin again at its end. What is behind this pad neither sees the end nor is flushed.

    pad  in front of the element that paces the clip
    """

    def __init__(self, pad: Gst.Pad) -> None:
        self._pad = pad
        kinds = Gst.PadProbeType.EVENT_DOWNSTREAM | Gst.PadProbeType.EVENT_FLUSH
        self._probe = EventProbe(kinds, self._is_dropped)
        self._probe.add_to(pad)

    def _is_dropped(self, kind: Gst.EventType) -> bool:
        """From the clip's streaming thread, which must return before it can be started again."""
        if kind == Gst.EventType.EOS:
            later(0, self._begin)
        return kind in (Gst.EventType.EOS, Gst.EventType.FLUSH_START, Gst.EventType.FLUSH_STOP)

    def _begin(self) -> None:
        element = self._pad.get_parent_element()
        if element is None or element.get_clock() is None:  # it has been stopped
            return
        self._pad.set_offset(element.get_clock().get_time() - element.get_base_time())  # its time goes on
        flags, kinds = Gst.SeekFlags.FLUSH, Gst.SeekType
        self._pad.push_event(Gst.Event.new_seek(1.0, Gst.Format.TIME, flags, kinds.SET, 0, kinds.NONE, 0))


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
