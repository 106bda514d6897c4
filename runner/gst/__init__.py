"""Everything that touches GStreamer, behind the one door `runner/apply.py`."""

import ctypes
from contextlib import suppress

# GStreamer brings libunwind, whose functions stand in for those of libgcc in all that is loaded later: the next C++
# exception, in Matplotlib or OpenCV, ends the process. What is loaded first, is found first.
with suppress(OSError):
    ctypes.CDLL("libgcc_s.so.1", mode=ctypes.RTLD_GLOBAL)

import gi

for _name in ("Gst", "GstPbutils", "GstRtp", "GstRtsp", "GstRtspServer", "GstSdp", "GstVideo"):
    gi.require_version(_name, "1.0")

from gi.repository import GLib, Gst  # noqa: E402

__all__ = ["GLib", "Gst"]

Gst.init(None)
