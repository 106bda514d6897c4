"""Whether a source opens; makes clips loop without a gap, with correct capture times."""

from __future__ import annotations

import ctypes
import threading
import time
from fractions import Fraction
from pathlib import Path

from gi.repository import GLib, Gst

from runner.core.model import Camera
from runner.graph import Plan, launch
from runner.gst.credentials import log_in
from runner.gst.probes import BufferProbe, PassingBuffer
from runner.inputs import input_problem

CHECK_MS = 1000
BEHIND_S = 0.3  # a clip that lags by more skips the lag instead of catching up
AHEAD_S = 0.5  # a synthetic drive begins so far ahead, and waits: seeking and starting take less, usually
INTO_FRAME_S = 1e-6  # a seek to exactly its start may hit the frame before, by rounding

# Not through PyGObject: from GStreamer 1.26 on, the reference held by its wrapper makes a query immutable.
_set_latency = ctypes.CDLL("libgstreamer-1.0.so.0").gst_query_set_latency
_set_latency.argtypes = (ctypes.c_void_p, ctypes.c_int, ctypes.c_uint64, ctypes.c_uint64)  # query, live, min, max
_set_latency.restype = None


def source_problem(plan: Plan) -> str | None:
    """Why a source does not open; None if it opens. GStreamer opens devices on the way to READY, and clips later."""
    if absent := input_problem(plan.camera):
        return str(absent)
    if unfit := _device_problem(plan.camera):
        return unfit
    pipeline = Gst.parse_launch(f"{launch(plan.source)} ! fakesink")
    try:
        if problem := log_in(pipeline, plan):
            return problem
        if pipeline.set_state(Gst.State.READY) != Gst.StateChangeReturn.FAILURE:
            return None
        message = pipeline.get_bus().pop_filtered(Gst.MessageType.ERROR)
        return str(message.parse_error()[0].message) if message else "its source does not start"
    finally:
        pipeline.set_state(Gst.State.NULL)


def _device_problem(camera: Camera) -> str | None:
    """Why a device cannot be the camera's; None if it can, or GStreamer says what is wrong."""
    if camera.device is None or not (path := Path(camera.device)).is_char_device():
        return None
    from runner.system.v4l2 import device_problem

    why = device_problem(path, camera.capture, Fraction(0))  # a slow camera is sent at its rate
    return f"{path} {why}" if why else None


def loop_clip(pipeline: Gst.Bin, plan: Plan, period_s: float | None = None) -> None:
    """Make a clip restart at its end while running time continues.

    period_s  length of the drive that the clips of several cameras show together: each is where the monotonic clock,
              modulo this, says, also one that starts later or has lagged; None: it begins with its first frame

    A segment seek makes the demuxer send SEGMENT_DONE instead of EOS; the next seek then queues the clip behind
    itself. Python runs once per round, not per frame.
    """
    identity = pipeline.get_by_name(plan.source[-1].name)
    pace = identity.get_static_pad("sink")
    _Loop(pace.get_peer(), identity, float(plan.camera.fps), period_s)
    _report_no_latency(pace)
    GLib.timeout_add(CHECK_MS, _Pace(identity).check)


class _Loop:
    """Watches the pad before the pacing element. The first seek, which flushes, is invisible downstream of it.

    It is kept by the pad, so it does not keep the pad.
    """

    def __init__(self, pad: Gst.Pad, identity: Gst.Element, fps: float, period_s: float | None) -> None:
        self._identity, self._fps, self._period_s = identity.weak_ref(), fps, period_s
        self._starts_round = True  # the next segment starts a round, and is not the current one with another offset
        self._round: tuple[int, int] | None = None  # start of this round: running time in ns, frames before it
        self._seek_sent = self._flushed = False
        self._start_s = 0.0  # where in the clip this round begins
        self._first = BufferProbe(identity.get_static_pad("src"), self._on_first_frame)
        if period_s is not None:
            self._first.arm()
        pad.add_probe(Gst.PadProbeType.BUFFER, self._on_early_frame)
        pad.add_probe(Gst.PadProbeType.EVENT_DOWNSTREAM | Gst.PadProbeType.EVENT_FLUSH, self._on_event)

    def _on_early_frame(self, pad: Gst.Pad, _info: Gst.PadProbeInfo) -> Gst.PadProbeReturn:
        """Drop frames from before the first seek, which would otherwise appear twice."""
        if self._flushed:
            return Gst.PadProbeReturn.REMOVE
        if not self._seek_sent:
            self._seek_sent = True
            self._begin(pad, Gst.SeekFlags.FLUSH | Gst.SeekFlags.SEGMENT, time.monotonic() + AHEAD_S)
        return Gst.PadProbeReturn.DROP

    def _begin(self, pad: Gst.Pad, flags: Gst.SeekFlags, due_s: float) -> None:
        """Begin a round, whose first frame is due at that time of the monotonic clock, where the drive is then."""
        frame = 0
        if self._period_s is not None:
            frames = round(self._period_s * self._fps)
            frame = round(due_s % self._period_s * self._fps) % frames
            frame = 0 if min(frame, frames - frame) <= 1 else frame  # rounding alone cuts no round short
        self._start_s = frame / self._fps
        _seek(pad, flags, self._start_s)

    def _on_first_frame(self, pad: Gst.Pad, frame: PassingBuffer) -> bool:
        """Delay the frames after the first one, which is early, so that they are where the drive is."""
        identity = self._identity()
        if identity is not None and self._period_s is not None and frame.pts is not None:
            early_s = (self._start_s - _due_s(pad, frame.pts)) % self._period_s
            if early_s <= AHEAD_S + 2 / self._fps:  # otherwise starting took longer; the next round makes up for it
                above = identity.get_static_pad("sink").get_peer()
                above.set_offset(above.get_offset() + round(early_s * Gst.SECOND))
        return True

    def _on_event(self, pad: Gst.Pad, info: Gst.PadProbeInfo) -> Gst.PadProbeReturn:
        match info.get_event().type:
            case Gst.EventType.FLUSH_START:
                return Gst.PadProbeReturn.DROP
            case Gst.EventType.FLUSH_STOP:
                self._flushed = self._starts_round = True
                return Gst.PadProbeReturn.DROP
            case Gst.EventType.SEGMENT if self._starts_round:
                self._starts_round = False
                self._extend_round(pad, info.get_event().parse_segment().base)
            case Gst.EventType.SEGMENT_DONE | Gst.EventType.EOS:
                self._starts_round = True
                self._begin(pad, Gst.SeekFlags.SEGMENT, self._next_due_s(pad, info.get_event()))
                return Gst.PadProbeReturn.DROP
        return Gst.PadProbeReturn.OK

    def _next_due_s(self, pad: Gst.Pad, end: Gst.Event) -> float:
        """When the frame after a round is due, by the monotonic clock. A round ends where its last frame begins."""
        is_told = end.type == Gst.EventType.SEGMENT_DONE
        return _due_s(pad.get_peer(), end.parse_segment_done()[1] if is_told else None) + 1 / self._fps

    def _extend_round(self, pad: Gst.Pad, base: int) -> None:
        """Extend a round to the duration of its frames.

        Demuxers end it at the start of its last frame, where the next round's first frame would coincide with it.
        """
        identity = self._identity()
        if identity is None:
            return
        base -= pad.get_offset()  # the demuxer's own value
        frames = identity.get_property("stats").get_value("num-buffers")
        if self._round:
            began, before = self._round
            missing = round((frames - before) / self._fps * Gst.SECOND) - (base - began)
            pad.set_offset(pad.get_offset() + missing)
        self._round = (base, frames)


def _seek(pad: Gst.Pad, flags: Gst.SeekFlags, start_s: float) -> None:
    start = 0
    if start_s:
        start, flags = round((start_s + INTO_FRAME_S) * Gst.SECOND), flags | Gst.SeekFlags.ACCURATE
    event = Gst.Event.new_seek(1.0, Gst.Format.TIME, flags, Gst.SeekType.SET, start, Gst.SeekType.NONE, 0)
    # Not from the streaming thread, which the seek waits for. A source pad accepts it from downstream.
    threading.Thread(target=pad.send_event, args=(event,), daemon=True).start()


class _Pace:
    """Skips the time by which a clip lags, as a camera loses frames.

    Otherwise a machine after an overload would play overdue frames at full speed, and stay overloaded.

    A frame's own time tells whether it is overdue. Frames that are missing do not: they are also missing after a skip
    that went too far, and another one would only make the clip stand still again, at every check.
    """

    def __init__(self, identity: Gst.Element) -> None:
        self._identity = identity.weak_ref()  # of the element, not of its Python wrapper
        self._next = BufferProbe(identity.get_static_pad("sink"), self._on_frame)

    def check(self) -> bool:
        """Check the next frame; once a second. Ends with the pipeline."""
        identity = self._identity()
        if identity is None:
            return False
        if identity.get_state(0).state == Gst.State.PLAYING:
            self._next.arm()
        return True

    def _on_frame(self, pad: Gst.Pad, frame: PassingBuffer) -> bool:
        """In the streaming thread, so no frame passes meanwhile."""
        late = _late_ns(pad, frame.pts)
        if late > BEHIND_S * Gst.SECOND:
            above = pad.get_peer()
            above.set_offset(above.get_offset() + late)
        return True


def _late_ns(pad: Gst.Pad, pts: int | None) -> int:
    """By how much a frame is overdue at a pad; 0 if that is unknown."""
    element, segment = pad.get_parent_element(), pad.get_sticky_event(Gst.EventType.SEGMENT, 0)
    clock = element.get_clock()
    if clock is None or segment is None or pts is None:
        return 0
    due: int = element.get_base_time() + segment.parse_segment().to_running_time(Gst.Format.TIME, pts)
    return int(clock.get_time()) - due


def _due_s(pad: Gst.Pad, pts: int | None) -> float:
    """When a frame is due at a pad, s of the monotonic clock; now if that is unknown."""
    return time.monotonic() - _late_ns(pad, pts) / 1e9


def fixed_rate(pipeline: Gst.Bin) -> list[Gst.Element]:
    """The elements that repeat and drop frames to keep a constant rate, and count them."""
    counts = ("duplicate", "drop", "skip-to-first")
    return [e for e in pipeline.children if all(e.find_property(key) for key in counts)]


def _report_no_latency(pad: Gst.Pad) -> None:
    """Count a frame of a clip as captured when it is released: decoding ahead of time is not latency."""

    def on_query(_pad: Gst.Pad, info: Gst.PadProbeInfo) -> Gst.PadProbeReturn:
        if info.get_query().type != Gst.QueryType.LATENCY:
            return Gst.PadProbeReturn.OK
        _set_latency(info.data, True, 0, Gst.CLOCK_TIME_NONE)
        return Gst.PadProbeReturn.HANDLED

    pad.add_probe(Gst.PadProbeType.QUERY_UPSTREAM, on_query)
