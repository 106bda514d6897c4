"""Pushes pictures from another process's shared memory into an appsrc, without a copy."""

from __future__ import annotations

import os
import time
from fractions import Fraction

from gi.repository import Gst, GstAllocators, GstVideo

from runner.bag.pictures import SUBSAMPLED, bayer_pattern
from runner.gst.bag_feed import accept_bayer, caps
from runner.ros.cameras import SharedPicture
from runner.system.kernel_clock import ahead_of


def push_shared(source: Gst.Element | None, picture: SharedPicture, fps: Fraction) -> bool:
    """Push a picture with its capture time. Its memory is mapped without a copy, and freed with the buffer.

    source   an appsrc; None: it is being replaced
    fps      stated in the caps, Hz
    returns  False if it was not accepted: the picture is older than the pipeline, or nobody is watching
    """
    clock = source.get_clock() if source else None
    # Capture times use CLOCK_MONOTONIC; a pipeline's clock may differ.
    pts = picture.captured - ahead_of(clock.get_time, time.monotonic_ns) - source.get_base_time() if clock else -1  # type: ignore[union-attr]
    form = picture.type.format
    if source is None or pts < 0 or (bayer_pattern(form) and not accept_bayer(source, form)):
        os.close(picture.memory)
        return False
    stated = Gst.Caps.from_string(caps(*picture.type, fps))
    sample = Gst.Sample.new(_buffer(picture, pts), stated, None, None)
    return bool(source.emit("push-sample", sample) == Gst.FlowReturn.OK)


def _buffer(picture: SharedPicture, pts: int) -> Gst.Buffer:
    allocator = GstAllocators.FdAllocator.new()
    buffer = Gst.Buffer.new()
    flags = GstAllocators.FdMemoryFlags.NONE  # the memory closes its descriptor
    buffer.append_memory(GstAllocators.FdAllocator.alloc(allocator, picture.memory, picture.size, flags))
    buffer.pts = pts
    raw, width, height = picture.type
    if picture.step and not bayer_pattern(raw):  # of which GstVideo knows nothing
        form, none = GstVideo.VideoFormat.from_string(raw), GstVideo.VideoFrameFlags.NONE
        offsets, strides = [0, picture.step * height, 0, 0], [picture.step] * 2 + [0, 0]
        planes = 2 if raw in SUBSAMPLED else 1
        GstVideo.buffer_add_video_meta_full(buffer, none, form, width, height, planes, offsets, strides)
    return buffer
