"""What the pipelines of cameras and of sound have in common at the RTSP server."""

from __future__ import annotations

from gi.repository import Gst, GstRtp

from runner.gst.arriving import CAPTURE_ID
from runner.gst.probes import TypeProbe

CAPTURE_TIME = "urn:ietf:params:rtp-hdrext:ntp-64"  # RTP header extension with the capture time (RFC 6051)
# A stream is reported as not seekable, by answering the query unchanged. The RTSP server relies on the source's answer:
# it would seek a clip or a test picture for every PLAY with a Range, Scale or Speed, flush the stream of all viewers,
# and wait for a frame that a closed gate never passes.
NOT_SEEKABLE = TypeProbe(Gst.PadProbeType.QUERY_UPSTREAM, {Gst.QueryType.SEEKING: Gst.PadProbeReturn.HANDLED})


def drop_queued_packet(pipeline: Gst.Bin) -> None:
    """Drop the packet that the server's sinks around a pipeline hold for an interleaved viewer, if any."""
    while parent := pipeline.get_parent():
        pipeline = parent
    sinks = pipeline.iterate_all_by_element_factory_name("appsink")
    sinks.foreach(lambda sink: sink.emit("try-pull-sample", 0))


def add_capture_time(payloader: Gst.Element) -> None:
    """Make room for the capture time in the first packet of each frame. An rtpsession after it fills in the time."""
    extension = GstRtp.RTPHeaderExtension.create_from_uri(CAPTURE_TIME)
    extension.set_id(CAPTURE_ID)
    payloader.emit("add-extension", extension)


def passed_counts(identity: Gst.Element) -> tuple[int, int]:
    """Number of buffers and bytes that an identity has passed."""
    stats = identity.get_property("stats")
    return stats.get_value("num-buffers"), stats.get_value("num-bytes")
