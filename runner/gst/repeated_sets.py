"""Parameter sets of H.264 that an encoder states beside its stream are repeated in it: whoever joins later needs them.

GStreamer's payloader and parser repeat them at IDR pictures only, of which a stream with refresh waves has one.
"""

from __future__ import annotations

from gi.repository import Gst

from runner.graph import Plan, video_codec
from runner.gst.caps import structure
from runner.gst.probes import EventProbe, PassingBuffer, RewritingProbe
from runner.h264.codec_data import stated_sets, with_sets


class RepeatedSets:
    """Adds those that an encoder states in its caps to the pictures with which waves begin.

    IDR pictures get them from the payloader. That forgets them when a stream starts anew, as with each round of a clip,
    and is not told them again, since the caps stay as they are. So for it the stream goes on.

    sent  pad that encoded pictures pass
    """

    def __init__(self, sent: Gst.Pad) -> None:
        self._sent = sent
        self._pictures = RewritingProbe(sent, self._on_encoded)
        self._events = EventProbe(Gst.PadProbeType.EVENT_DOWNSTREAM, self._starts_anew)
        self._events.add_to(sent)

    @classmethod
    def of(cls, plan: Plan, sent: Gst.Element | None) -> RepeatedSets | None:
        """None: the graph does not encode H.264."""
        graph = plan.camera.graph
        if sent is None or graph.passes or video_codec(graph) != "h264":
            return None
        return cls(sent.get_static_pad("sink"))

    def _starts_anew(self, event: Gst.EventType) -> bool:
        return bool(event == Gst.EventType.STREAM_START and self._sent.has_current_caps())

    def _on_encoded(self, pad: Gst.Pad, picture: PassingBuffer) -> bytes | None:
        if picture.has_flags(Gst.BufferFlags.DELTA_UNIT):
            return None
        caps = structure(pad.get_current_caps())
        if caps.get_string("stream-format") != "avc" or caps.get_string("alignment") != "au":
            return None
        record = caps.get_value("codec_data")
        return with_sets(picture.extract(0, picture.size), stated_sets(record.extract_dup(0, record.get_size())))
