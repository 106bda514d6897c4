"""Caps, read the same with any version of GStreamer's Python bindings."""

from gi.repository import Gst


def structure(caps: Gst.Caps, place: int = 0) -> Gst.Structure:
    """A copy of a structure of caps, the first if not stated.

    Until 1.24 `get_structure` returns the structure itself, whose memory belongs to the caps. From 1.26 on gst-python
    wraps it in a context manager that keeps the caps alive.
    """
    found = caps.get_structure(place)
    if isinstance(found, Gst.Structure):
        return found.copy()
    with found as own:
        return own.copy()
