"""Reads the access units of a drive's video file one by one. Offline work, so Python per frame is fine here."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from gi.repository import Gst

from runner.errors import RunError, os_errors_as
from runner.gst.caps import structure
from runner.gst.stream_times import RestoredTimes, stream_times
from runner.system.files import file_problem

WAIT_NS = 100 * Gst.MSECOND
SILENT = 100  # consecutive waits without a sample, EOS or error before the file is given up
PARSED = {  # by codec, the parser: whole pictures as Annex B, parameter sets with each keyframe
    codec: f"{codec}parse config-interval=-1 ! capsfilter caps=video/x-{codec},stream-format=byte-stream,alignment=au"
    for codec in ("h264", "h265")
}


class Unit(NamedTuple):
    """One access unit.

    after_ns    time since the first unit of the file, ns
    codec       h264 or h265
    data        Annex B
    demuxed_ns  likewise, by GStreamer's demuxer, which shortens gaps: the times of `runner.gst.pictures.decode_video`
    """

    after_ns: int
    codec: str
    data: bytes
    demuxed_ns: int


def read_video(path: Path) -> Iterator[Unit]:
    """Yield all readable units, in order.

    raises  RunError if there is no such file or it is damaged; units already yielded stay valid
    """
    if why := file_problem(path):
        raise RunError(f"{path}: {why}")
    with os_errors_as(lambda why: RunError(f"{path}: {why}")):
        times = RestoredTimes(stream_times(path))
    pipeline = Gst.parse_launch("filesrc name=file ! tsdemux name=demux  appsink name=out sync=false max-buffers=8")
    pipeline.get_by_name("file").set_property("location", str(path))
    pipeline.get_by_name("demux").connect("pad-added", _on_stream, pipeline.get_by_name("out"))
    try:
        pipeline.set_state(Gst.State.PLAYING)  # a failure is reported on the bus, with its reason
        yield from _units(pipeline, path, times)
    finally:
        pipeline.set_state(Gst.State.NULL)


def _on_stream(_demux: Gst.Element, pad: Gst.Pad, out: Gst.Element) -> None:
    """The demuxer has found the stream: insert the parser for its codec before the sink. Not called per frame."""
    codec = structure(pad.get_current_caps()).get_name().removeprefix("video/x-")
    if codec not in PARSED or out.get_static_pad("sink").is_linked():
        return  # no units are output
    parse = Gst.parse_bin_from_description(PARSED[codec], True)
    out.get_parent().add(parse)
    parse.link(out)
    pad.link(parse.get_static_pad("sink"))
    parse.sync_state_with_parent()


def _units(pipeline: Gst.Pipeline, path: Path, times: RestoredTimes) -> Iterator[Unit]:
    first, codec = 0, ""
    for sample in pulled(pipeline, path, "contains no readable video"):
        buffer = sample.get_buffer()
        if not codec:
            codec, first = structure(sample.get_caps()).get_name().removeprefix("video/x-"), buffer.pts
        if buffer.pts == Gst.CLOCK_TIME_NONE:
            continue  # a unit whose beginning is damaged
        demuxed_ns = buffer.pts - first
        yield Unit(times.next(demuxed_ns), codec, buffer.extract_dup(0, buffer.get_size()), demuxed_ns)


def pulled(pipeline: Gst.Pipeline, path: Path, empty: str) -> Iterator[Gst.Sample]:
    """The samples of a playing pipeline's sink `out`, up to their end.

    empty   what to say about the file if there are none
    raises  RunError if they do not end properly
    """
    out, silent, any_came = pipeline.get_by_name("out"), 0, False
    while silent < SILENT:
        if sample := out.emit("try-pull-sample", WAIT_NS):
            silent, any_came = 0, True
            yield sample
            continue
        if (is_over := out.get_property("eos")) and any_came:
            return
        if is_over or pipeline.get_bus().pop_filtered(Gst.MessageType.ERROR) is not None:
            break
        silent += 1
    raise RunError(f"{path}: {'is damaged' if any_came else empty}")
