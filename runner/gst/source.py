"""What a source needs beyond its elements: clips that loop without a gap, and a truthful capture time."""

from __future__ import annotations

import threading

from gi.repository import GLib, Gst

from runner.graph import Plan

CHECK_MS = 1000
BEHIND_S = 0.3  # a clip that is behind by more has lost it


def loop_clip(pipeline: Gst.Bin, plan: Plan) -> None:
    """Make a clip start again at its end, with running time going on.

    A segment seek tells the demuxer to say SEGMENT_DONE in place of EOS; the next seek then queues the clip behind
    itself. Python runs once per round, not per frame.
    """
    identity = pipeline.get_by_name(plan.source[-1].name)
    pace = identity.get_static_pad("sink")
    _Loop(pace.get_peer(), identity, float(plan.camera.fps))
    _report_no_latency(pace)
    clip = _Pace(identity, float(plan.camera.fps))
    GLib.timeout_add(CHECK_MS, clip.keep)


class _Loop:
    """Watches the pad in front of the pacing element. Nothing of the first seek, a flush, is seen behind it."""

    def __init__(self, pad: Gst.Pad, identity: Gst.Element, fps: float) -> None:
        self._pad, self._identity, self._fps = pad, identity.weak_ref(), fps
        self._begins = True  # the next segment is a round, and not one repeated with another offset
        self._round: tuple[int, int] | None = None  # where this round began: running time in ns, frames before it
        self._sought = self._flushed = False
        pad.add_probe(Gst.PadProbeType.BUFFER, self._on_early_frame)
        pad.add_probe(Gst.PadProbeType.EVENT_DOWNSTREAM | Gst.PadProbeType.EVENT_FLUSH, self._on_event)

    def _on_early_frame(self, _pad: Gst.Pad, _info: Gst.PadProbeInfo) -> Gst.PadProbeReturn:
        """Frames from before the first seek would come twice."""
        if self._flushed:
            return Gst.PadProbeReturn.REMOVE
        if not self._sought:
            self._sought = True
            self._seek(Gst.SeekFlags.FLUSH | Gst.SeekFlags.SEGMENT)
        return Gst.PadProbeReturn.DROP

    def _on_event(self, _pad: Gst.Pad, info: Gst.PadProbeInfo) -> Gst.PadProbeReturn:
        match info.get_event().type:
            case Gst.EventType.FLUSH_START:
                return Gst.PadProbeReturn.DROP
            case Gst.EventType.FLUSH_STOP:
                self._flushed = self._begins = True
                return Gst.PadProbeReturn.DROP
            case Gst.EventType.SEGMENT if self._begins:
                self._begins = False
                self._make_room(info.get_event().parse_segment().base)
            case Gst.EventType.SEGMENT_DONE | Gst.EventType.EOS:
                self._begins = True
                self._seek(Gst.SeekFlags.SEGMENT)
                return Gst.PadProbeReturn.DROP
        return Gst.PadProbeReturn.OK

    def _make_room(self, base: int) -> None:
        """Let a round last as long as its frames.

        Demuxers count it to the beginning of its last frame, which the first one of the next round then coincides with.
        """
        identity = self._identity()
        if identity is None:
            return
        base -= self._pad.get_offset()  # as the demuxer states it
        frames = identity.get_property("stats").get_value("num-buffers")
        if self._round:
            began, before = self._round
            missing = round((frames - before) / self._fps * Gst.SECOND) - (base - began)
            self._pad.set_offset(self._pad.get_offset() + missing)
        self._round = (base, frames)

    def _seek(self, flags: Gst.SeekFlags) -> None:
        event = Gst.Event.new_seek(1.0, Gst.Format.TIME, flags, Gst.SeekType.SET, 0, Gst.SeekType.NONE, 0)
        # Not from the streaming thread, which the seek has to wait for. A source pad takes it from below.
        threading.Thread(target=self._pad.send_event, args=(event,), daemon=True).start()


class _Pace:
    """Lets a clip lose the time that it is behind, as a camera loses frames.

    A machine that was too busy for a while would else play what is overdue as fast as it can, and stay too busy.
    """

    def __init__(self, identity: Gst.Element, fps: float) -> None:
        self._identity, self._fps = identity.weak_ref(), fps  # of the element, not of its Python wrapper
        self._usual: float | None = None  # s between the clock and the frames released so far

    def keep(self) -> bool:
        """Once a second; ends with the pipeline."""
        identity = self._identity()
        if identity is None:
            return False
        clock, pad = identity.get_clock(), identity.get_static_pad("sink")
        frames = identity.get_property("stats").get_value("num-buffers")
        if identity.get_state(0).state != Gst.State.PLAYING or clock is None or not frames:
            return True
        behind = (clock.get_time() - identity.get_base_time()) / Gst.SECOND - frames / self._fps
        if self._usual is None or behind < self._usual:
            self._usual = behind
        elif behind > self._usual + BEHIND_S:
            lost = int((behind - self._usual) * Gst.SECOND)
            pad.get_peer().set_offset(pad.get_peer().get_offset() + lost)
            self._usual = behind
        return True


def fixed_rate(pipeline: Gst.Bin) -> list[Gst.Element]:
    """The elements that repeat frames and leave some out to keep a rate, and count them."""
    counts = ("duplicate", "drop", "skip-to-first")
    return [e for e in pipeline.children if all(e.find_property(key) for key in counts)]


def _report_no_latency(pad: Gst.Pad) -> None:
    """A frame of a clip is captured when it is released: decoding ahead of time is no latency."""

    def on_query(_pad: Gst.Pad, info: Gst.PadProbeInfo) -> Gst.PadProbeReturn:
        query = info.get_query()
        if query.type != Gst.QueryType.LATENCY:
            return Gst.PadProbeReturn.OK
        query.set_latency(True, 0, Gst.CLOCK_TIME_NONE)
        return Gst.PadProbeReturn.HANDLED

    pad.add_probe(Gst.PadProbeType.QUERY_UPSTREAM, on_query)
