"""What a source needs beyond its elements: clips that loop without a gap, and a truthful capture time."""

from __future__ import annotations

import threading

from gi.repository import Gst

from runner.graph import Plan

_FIRST = Gst.SeekFlags.FLUSH | Gst.SeekFlags.SEGMENT
_AGAIN = Gst.SeekFlags.SEGMENT


def loop_clip(pipeline: Gst.Bin, plan: Plan) -> None:
    """Make a clip start again at its end, with running time going on.

    A segment seek tells the demuxer to say SEGMENT_DONE in place of EOS; the next seek then queues the clip behind
    itself. Python runs once per round, not per frame.
    """
    pace = pipeline.get_by_name(plan.source[-1].name)
    pad = pace.get_static_pad("sink")

    def seek(flags: Gst.SeekFlags) -> None:
        event = Gst.Event.new_seek(1.0, Gst.Format.TIME, flags, Gst.SeekType.SET, 0, Gst.SeekType.NONE, 0)
        # Not from the streaming thread, which the seek has to wait for.
        threading.Thread(target=pad.push_event, args=(event,), daemon=True).start()

    def on_first_frame(_pad: Gst.Pad, _info: Gst.PadProbeInfo) -> Gst.PadProbeReturn:
        seek(_FIRST)
        return Gst.PadProbeReturn.REMOVE

    def on_event(_pad: Gst.Pad, info: Gst.PadProbeInfo) -> Gst.PadProbeReturn:
        if info.get_event().type not in (Gst.EventType.SEGMENT_DONE, Gst.EventType.EOS):
            return Gst.PadProbeReturn.OK
        seek(_AGAIN)
        return Gst.PadProbeReturn.DROP

    pad.add_probe(Gst.PadProbeType.BUFFER, on_first_frame)
    pad.add_probe(Gst.PadProbeType.EVENT_DOWNSTREAM, on_event)
    _born_on_release(pad)


def _born_on_release(pad: Gst.Pad) -> None:
    """A frame of a clip is captured when it is released: decoding ahead of time is no latency."""

    def on_query(_pad: Gst.Pad, info: Gst.PadProbeInfo) -> Gst.PadProbeReturn:
        query = info.get_query()
        if query.type != Gst.QueryType.LATENCY:
            return Gst.PadProbeReturn.OK
        query.set_latency(True, 0, Gst.CLOCK_TIME_NONE)
        return Gst.PadProbeReturn.HANDLED

    pad.add_probe(Gst.PadProbeType.QUERY_UPSTREAM, on_query)
