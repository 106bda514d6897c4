"""Refresh waves of H.264 begin with parameter sets: a viewer who joins later, or a reader of a file, begins there.

GStreamer's payloader and parser repeat them at IDR pictures only, of which a stream with refresh waves has one.
"""

from __future__ import annotations

from gi.repository import Gst

from runner.graph import Plan, video_codec
from runner.gst.caps import structure
from runner.gst.probes import PassingBuffer, RewritingProbe
from runner.h264.codec_data import stated_sets, with_sets


class RepeatedSets:
    """Adds those that an encoder states in its caps to the pictures with which waves begin.

    sent  pad that encoded pictures pass
    """

    def __init__(self, sent: Gst.Pad) -> None:
        self._probe = RewritingProbe(sent, self._on_encoded)

    @classmethod
    def of(cls, plan: Plan, sent: Gst.Element | None) -> RepeatedSets | None:
        """None: the graph does not encode H.264."""
        graph = plan.camera.graph
        if sent is None or graph.passes or video_codec(graph) != "h264":
            return None
        return cls(sent.get_static_pad("sink"))

    def _on_encoded(self, pad: Gst.Pad, picture: PassingBuffer) -> bytes | None:
        if picture.has_flags(Gst.BufferFlags.DELTA_UNIT):
            return None
        caps = structure(pad.get_current_caps())
        if caps.get_string("stream-format") != "avc" or caps.get_string("alignment") != "au":
            return None
        record = caps.get_value("codec_data")
        return with_sets(picture.extract(0, picture.size), stated_sets(record.extract_dup(0, record.get_size())))
