"""Finds clips whose luma uses the full range, 0 to 255, as action cameras and phones write them.

In GStreamer what an MP4 box states takes precedence over the stream, although the demuxer of 1.22 overlooks the box's
flag for the range; and videoconvert changes nothing where only the range differs. Such clips would be sent with too
much contrast.
"""

from __future__ import annotations

from gi.repository import Gst, GstVideo

from runner.gst.caps import structure
from runner.gst.video_reader import PARSED

DECODE = "decodebin force-sw-decoders=true"
WAIT_NS = 5 * Gst.SECOND
FULL, LIMITED = map(GstVideo.VideoColorRange, (1, 2))  # Python has no names for them, which begin with digits
LARGEST_BT601 = 576  # lines; GStreamer's rule for pictures that state no matrix
CONVERTED = ("image/jpeg",)  # always full range and BT.601, which videoconvert converts, here as for live cameras


def full_range(clip: str, caps: Gst.Caps) -> str:
    """Colorimetry of a full-range clip once it is converted to limited range; "" for any other clip.

    Of H.264 and H.265 the parameter sets decide; the container says what they leave open.

    caps  of its compressed pictures, according to the container
    """
    kind = structure(caps)
    if kind.get_name() in CONVERTED:
        return ""
    stated = _merged(_of_pictures(clip, kind.get_name().removeprefix("video/x-")), _colorimetry(caps))
    if stated.range != FULL or stated.matrix == GstVideo.VideoColorMatrix.RGB:
        return ""
    if stated.matrix == GstVideo.VideoColorMatrix.UNKNOWN:
        small = kind.get_int("height")[1] <= LARGEST_BT601
        stated.matrix = GstVideo.VideoColorMatrix.BT601 if small else GstVideo.VideoColorMatrix.BT709
    stated.range = LIMITED
    return str(stated.to_string())


def _of_pictures(clip: str, codec: str) -> GstVideo.VideoColorimetry:
    """What decoded pictures state; of H.264 and H.265 without knowledge of the container."""
    if codec not in PARSED:
        picture = _first_sample(f"filesrc name=in ! {DECODE}", location=clip)
    elif unit := _first_sample(f"filesrc name=in ! parsebin ! {PARSED[codec]}", location=clip):
        bare = Gst.Caps.from_string(f"video/x-{codec},stream-format=byte-stream,alignment=au")
        picture = _first_sample(f"appsrc name=in ! {PARSED[codec]} ! {DECODE}", unit.get_buffer(), caps=bare)
    else:
        picture = None
    return _colorimetry(picture.get_caps() if picture else Gst.Caps.new_empty_simple("video/x-raw"))


def _first_sample(line: str, pushed: Gst.Buffer | None = None, **properties: object) -> Gst.Sample | None:
    """The first output of a line, whose first element is named `in`; None: it fails, or has none for long."""
    pipeline = Gst.parse_launch(f"{line} ! appsink name=out sync=false max-buffers=1")
    source, sink = map(pipeline.get_by_name, ("in", "out"))
    for key, value in properties.items():
        source.set_property(key, value)
    try:
        pipeline.set_state(Gst.State.PLAYING)
        if pushed is not None:
            source.emit("push-buffer", pushed)
            source.emit("end-of-stream")
        return sink.emit("try-pull-sample", WAIT_NS)
    finally:
        pipeline.set_state(Gst.State.NULL)


def _colorimetry(caps: Gst.Caps) -> GstVideo.VideoColorimetry:
    found = GstVideo.VideoColorimetry()
    found.from_string(structure(caps).get_string("colorimetry") or "0:0:0:0")
    return found


def _merged(first: GstVideo.VideoColorimetry, second: GstVideo.VideoColorimetry) -> GstVideo.VideoColorimetry:
    """What the first states, and what only the second does."""
    for key in ("range", "matrix", "transfer", "primaries"):
        if not int(getattr(first, key)):
            setattr(first, key, getattr(second, key))
    return first
