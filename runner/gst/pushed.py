"""Pushes pictures of a Python program into an appsrc: bytes or arrays, with their capture times."""

from __future__ import annotations

import time
from fractions import Fraction
from typing import Any, NamedTuple

from gi.repository import Gst, GstVideo

from runner.gst.bag_feed import caps
from runner.system.kernel_clock import ahead_of

FARTHEST_S = 60.0  # between a capture time and now; beyond, it is of another clock


class _Format(NamedTuple):
    """GStreamer's name of a format, and the bytes of a pixel, times two."""

    raw: str
    half_bytes: int


FORMATS = {"i420": _Format("I420", 3), "bgr": _Format("BGR", 6), "rgb": _Format("RGB", 6), "grey": _Format("GRAY8", 2)}


class PushedPictures:
    """The pictures of one camera, in order of capture.

    size  width and height of the camera's (native) picture, px
    fps   stated in the caps, Hz
    """

    def __init__(self, size: tuple[int, int], fps: Fraction) -> None:
        self._size, self._fps = size, fps
        self._last = -1
        self._i420: Gst.Caps | None = None  # of the source's file, with the colorimetry

    def push(self, source: Gst.Element | None, frame: Any, form: str | None, captured: float | None) -> bool:
        """Push one picture; returns False if it was not accepted: nobody is watching, or it is older than the last one.

        source    an appsrc; None: it is being replaced
        form      one of FORMATS; None: by its shape
        captured  s since 1970 by this machine's clock; None: now
        raises    ValueError
        """
        raw, data = self._checked(memoryview(frame), form)
        clock = source.get_clock() if source else None
        buffer = Gst.Buffer.new_wrapped(data)
        if captured is not None:
            if abs(captured - time.time()) > FARTHEST_S:
                raise ValueError(f"captured: {captured}: must be s since 1970, within a minute of this machine's clock")
            # Without a clock it does not play yet.
            pts = round(captured * 1e9) - ahead_of(clock.get_time) - source.get_base_time() if clock else -1  # type: ignore[union-attr]
            if pts <= self._last:
                return False
            self._last = buffer.pts = pts
        if source is None:
            return False
        width, height = self._size
        if raw != "I420":
            form_of, none = GstVideo.VideoFormat.from_string(raw), GstVideo.VideoFrameFlags.NONE
            step = len(data) // height
            GstVideo.buffer_add_video_meta_full(buffer, none, form_of, width, height, 1, [0] * 4, [step, 0, 0, 0])
        self._i420 = self._i420 or source.get_property("caps")  # a sample's caps replace it
        stated = self._i420 if raw == "I420" else Gst.Caps.from_string(caps(raw, width, height, self._fps))
        sample = Gst.Sample.new(buffer, stated, None, None)
        return bool(source.emit("push-sample", sample) == Gst.FlowReturn.OK)

    def _checked(self, view: memoryview, form: str | None) -> tuple[str, bytes]:
        """GStreamer's name of a picture's format, and its bytes without padding.

        raises  ValueError
        """
        width, height = self._size
        if view.itemsize != 1:
            raise ValueError(f"a frame of numbers of {view.itemsize} bytes must have numbers of one byte (uint8)")
        found = tuple(view.shape or ())
        form = form or self._by_shape(found)
        if form not in FORMATS:
            raise ValueError(f"format: {form!r}: must be one of {', '.join(FORMATS)}")
        raw, half_bytes = FORMATS[form]
        shape = (height * 3 // 2, width) if form == "i420" else (height, width, *([3] if half_bytes == 6 else []))
        size = width * height * half_bytes // 2
        if view.ndim == 1 and view.nbytes != size:
            raise ValueError(f"a frame of {view.nbytes} bytes must have {size}, {raw} of {width}x{height}")
        if view.ndim > 1 and tuple(n for n in found if n != 1) != tuple(n for n in shape if n != 1):
            raise ValueError(f"a frame of shape {found} must have {shape}, {raw} of {width}x{height}")
        return raw, view.tobytes()

    def _by_shape(self, shape: tuple[int, ...]) -> str:
        if len(shape) == 3 and shape[2] == 3:
            raise ValueError(f"a frame of shape {shape} needs format='bgr' or format='rgb'")
        return "grey" if len(shape) > 1 and shape[:2] == self._size[::-1] else "i420"
