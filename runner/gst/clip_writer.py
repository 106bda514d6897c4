"""Encodes frames generated in Python into an H.264 clip. Offline work, so Python per frame is fine here."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any

from gi.repository import GLib, Gst

QUANTIZER = 28  # constant: at least 37 dB, far above the quality of the sent stream, at half the decoding cost of 20
FRAMES_IN_FLIGHT = 3


def write_clip(
    path: Path, frames: Iterable[bytes], width: int, height: int, fps: Fraction, *, quantizer: int = QUANTIZER
) -> None:
    """Encode I420 frames (BT.709, limited range) at a constant frame rate and quantizer into an MP4 file.

    frames  each width * height * 3 / 2 bytes: Y, U, V, contiguous
    raises  RuntimeError with GStreamer's message

    The stream is cheap to decode: no B-frames, no CABAC, no deblocking, a keyframe every second.
    """
    caps = (
        f"video/x-raw,format=I420,width={width},height={height},framerate={fps.numerator}/{fps.denominator},"
        "pixel-aspect-ratio=1/1,interlace-mode=progressive,colorimetry=bt709,chroma-site=mpeg2"
    )
    pipeline = _parse(
        f"appsrc name=frames caps={caps} format=time max-bytes=0 "
        f"! x264enc pass=quant quantizer={quantizer} speed-preset=ultrafast bframes=0 threads=1 "
        f"key-int-max={max(1, round(fps))} ! h264parse ! mp4mux ! filesink name=file",
    )
    pipeline.get_by_name("file").set_property("location", str(path))
    try:
        pipeline.set_state(Gst.State.PLAYING)  # a failure is reported on the bus, with its reason
        _push(pipeline, frames, fps)
        _wait(pipeline, Gst.CLOCK_TIME_NONE, Gst.MessageType.EOS)
    finally:
        pipeline.set_state(Gst.State.NULL)


def _parse(description: str) -> Any:
    try:
        return Gst.parse_launch(description)
    except GLib.Error as error:
        raise RuntimeError(f"writing the clip: {error.message}") from None


def _push(pipeline: Any, frames: Iterable[bytes], fps: Fraction) -> None:
    """Push all frames with exact timestamps, then the end of the stream.

    The queue level is checked here instead of using `block=true`: if the pipeline fails, a blocked push never returns.
    """
    source = pipeline.get_by_name("frames")
    for number, frame in enumerate(frames):
        while source.get_property("current-level-bytes") >= FRAMES_IN_FLIGHT * len(frame):
            _wait(pipeline, Gst.MSECOND, Gst.MessageType.ERROR)
        buffer = Gst.Buffer.new_wrapped(frame)
        start, end = (int(count * Gst.SECOND / fps) for count in (number, number + 1))
        buffer.pts, buffer.duration = start, end - start
        source.emit("push-buffer", buffer)
    source.emit("end-of-stream")


def _wait(pipeline: Any, nanoseconds: int, for_what: Any) -> None:
    """Wait for a message or the timeout; raises the error of an error message."""
    message = pipeline.get_bus().timed_pop_filtered(nanoseconds, for_what | Gst.MessageType.ERROR)
    if message and message.type == Gst.MessageType.ERROR:
        error, _ = message.parse_error()
        raise RuntimeError(f"writing the clip: {error.message}")
