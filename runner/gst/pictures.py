"""Decoded pictures as numpy arrays. Offline work, so Python per frame is fine here."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from gi.repository import Gst, GstVideo
from numpy.typing import NDArray

from runner.errors import RunError
from runner.gst.caps import structure
from runner.gst.video_reader import pulled
from runner.system.files import file_problem

LumaPlane = NDArray[np.uint8]  # height x width


def luma_of(buffer: Gst.Buffer, caps: Gst.Caps) -> LumaPlane:
    """A copy of the first plane of a picture with one byte per sample."""
    picture = structure(caps)
    width, height = picture.get_int("width")[1], picture.get_int("height")[1]
    meta: Any = GstVideo.buffer_get_video_meta(buffer)
    stride, offset = (meta.stride[0], meta.offset[0]) if meta else (-(-width // 4) * 4, 0)
    plane = buffer.extract_dup(offset, stride * (height - 1) + width)
    rows = np.frombuffer(plane.ljust(stride * height, b"\0"), np.uint8).reshape(height, stride)
    return rows[:, :width]


def decode_video(path: Path, size: tuple[int, int] | None, *, fitted: bool = False) -> Iterator[tuple[int, LumaPlane]]:
    """Decode a file, whatever sizes its pictures change to: ns since its first access unit, and luma.

    size    to which pictures are scaled; None: as they were coded
    fitted  as conf/source/file.yaml fits a clip to a camera: turned upright and cropped to the aspect ratio, too
    raises  RunError if the path names no file or nothing can be decoded. Damaged pictures come as they were decoded
    """
    if why := file_problem(path):
        raise RunError(f"{path}: {why}")
    form = "video/x-raw,format=I420"
    if size:
        fit = f"videoflip video-direction=auto ! aspectratiocrop aspect-ratio={size[0]}/{size[1]} ! " if fitted else ""
        form = f"{fit}videoscale add-borders=false ! {form},width={size[0]},height={size[1]},pixel-aspect-ratio=1/1"
    pipeline = Gst.parse_launch(
        "filesrc name=file ! parsebin ! identity name=units ! decodebin ! videoconvert"
        f" ! {form} ! appsink name=out sync=false max-buffers=4"
    )
    pipeline.get_by_name("file").set_property("location", str(path))
    first: list[int] = []
    units = pipeline.get_by_name("units").get_static_pad("src")
    units.add_probe(Gst.PadProbeType.BUFFER, _on_first_unit, first)
    try:
        pipeline.set_state(Gst.State.PLAYING)  # a failure is reported on the bus, with its reason
        for sample in pulled(pipeline, path, "contains no picture that can be decoded"):
            buffer = sample.get_buffer()
            if first and buffer.pts != Gst.CLOCK_TIME_NONE:
                yield buffer.pts - first[0], luma_of(buffer, sample.get_caps())
    finally:
        pipeline.set_state(Gst.State.NULL)


def _on_first_unit(_pad: Gst.Pad, info: Gst.PadProbeInfo, first: list[int]) -> Gst.PadProbeReturn:
    if info.get_buffer().pts == Gst.CLOCK_TIME_NONE:
        return Gst.PadProbeReturn.OK
    first.append(info.get_buffer().pts)
    return Gst.PadProbeReturn.REMOVE
