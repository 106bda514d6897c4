"""Everything that touches GStreamer, behind the one door `runner/apply.py`."""

import gi

for _name in ("Gst", "GstPbutils", "GstRtp", "GstRtsp", "GstRtspServer", "GstVideo"):
    gi.require_version(_name, "1.0")

from gi.repository import GLib, Gst  # noqa: E402

__all__ = ["GLib", "Gst"]

Gst.init(None)
