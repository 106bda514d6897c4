"""Encodes the access units of a drive's video file again, with key frames at an interval. Offline work, in Python."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

from gi.repository import Gst, GstVideo

from runner.errors import RunError
from runner.gst.registry import why_missing
from runner.gst.video_reader import Unit, read_video

QUALITY = 18  # quantizer of x264 at which no difference is seen
ENCODER = f"x264enc name=encoder tune=zerolatency speed-preset=superfast pass=qual quantizer={QUALITY}"
PIPELINE = (
    "appsrc name=units format=time max-buffers=8 block=true ! decodebin ! videoconvert ! video/x-raw,format=I420"
    f" ! {ENCODER} ! h264parse config-interval=-1 ! video/x-h264,stream-format=byte-stream,alignment=au"
    " ! appsink name=out sync=false"
)
WAIT_NS = 20 * Gst.SECOND  # for the last pictures


def read_again(path: Path, interval_s: float, on_warning: Callable[[str], None]) -> Iterator[Unit]:
    """The pictures of a file encoded in H.264 again, each at its own time, with key frames `interval_s` apart.

    on_warning  called with a line if pictures could not be decoded
    raises      RunError as `read_video` does, or if nothing encodes
    """
    if Gst.ElementFactory.find("x264enc") is None:
        raise RunError(why_missing("x264enc"))
    pipeline = Gst.parse_launch(PIPELINE)
    out, encoder = pipeline.get_by_name("out"), pipeline.get_by_name("encoder")
    keys = _Keys(encoder, interval_s)
    encoder.get_static_pad("sink").add_probe(Gst.PadProbeType.BUFFER, keys.on_picture)
    read = written = 0
    pipeline.set_state(Gst.State.PLAYING)
    try:
        for unit in read_video(path):
            _push(pipeline, path, unit, first=not read)
            read += 1
            for again in _pulled(out, 0):
                written += 1
                yield again
        pipeline.get_by_name("units").emit("end-of-stream")
        for again in _pulled(out, WAIT_NS):
            written += 1
            yield again
        _check(pipeline, path)
    finally:
        pipeline.set_state(Gst.State.NULL)
    if written < read:
        on_warning(f"{path}: {read - written} of {read} pictures cannot be decoded and were left out")


class _Keys:
    """Requests a key frame for the first picture, and for each that is an interval later than the last key frame."""

    def __init__(self, encoder: Gst.Element, interval_s: float) -> None:
        self._pad, self._interval = encoder.get_static_pad("src"), interval_s * Gst.SECOND
        self._due = 0.0

    def on_picture(self, _pad: Gst.Pad, info: Gst.PadProbeInfo) -> Gst.PadProbeReturn:
        if (pts := info.get_buffer().pts) >= self._due:
            self._due = pts + self._interval
            self._pad.send_event(GstVideo.video_event_new_upstream_force_key_unit(Gst.CLOCK_TIME_NONE, True, 0))
        return Gst.PadProbeReturn.OK


def _push(pipeline: Gst.Pipeline, path: Path, unit: Unit, first: bool) -> None:
    source = pipeline.get_by_name("units")
    if first:
        form = f"video/x-{unit.codec},stream-format=byte-stream,alignment=au"
        source.set_property("caps", Gst.Caps.from_string(form))
    buffer = Gst.Buffer.new_wrapped(unit.data)
    buffer.pts = unit.after_ns
    if source.emit("push-buffer", buffer) != Gst.FlowReturn.OK:
        _check(pipeline, path)


def _pulled(out: Gst.Element, wait_ns: int) -> Iterator[Unit]:
    """The pictures that are encoded by now; with time to wait, all until the end."""
    while sample := out.emit("try-pull-sample", wait_ns):
        buffer = sample.get_buffer()
        after_ns = sample.get_segment().to_running_time(Gst.Format.TIME, buffer.pts)
        yield Unit(after_ns, "h264", buffer.extract_dup(0, buffer.get_size()), after_ns)


def _check(pipeline: Gst.Pipeline, path: Path) -> None:
    if message := pipeline.get_bus().pop_filtered(Gst.MessageType.ERROR):
        raise RunError(f"{path}: cannot be encoded again: {message.parse_error()[0].message}")
