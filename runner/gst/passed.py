"""What a camera that encodes by itself delivers, compared with what its configuration and its viewers expect."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from gi.repository import Gst

from runner.core.model import Camera
from runner.gst.caps import structure
from runner.gst.probes import BufferProbe, PassingBuffer

LOOKED_AT = 60  # pictures in which B-frames are looked for: encoders that use them do so in every group
IN_PIECES = 10  # of these without a time: more than parameter sets that come for themselves
# What browsers decode everywhere; ITU-T H.264, A.2. Of H.265, whether they decode it at all differs.
PLAYED = ("constrained-baseline", "baseline", "main", "high", "progressive-high", "constrained-high")


class PassedStream:
    """Reports, once for each form of the stream, what its viewers will have trouble with.

    pad        that its whole pictures pass
    on_report  called, from any thread
    """

    def __init__(self, pad: Gst.Pad, camera: Camera, on_report: Callable[[str], None]) -> None:
        self._pad, self._camera, self._on_report = pad, camera, on_report
        self._caps: Gst.Caps | None = None  # those reported
        self._is_odd = False  # whether something of these was reported
        self._left, self._newest, self._untimed = LOOKED_AT, 0, 0
        self._order = BufferProbe(pad, self._on_picture)
        self._order.arm()

    def look(self) -> None:
        """A few times a second, from one thread."""
        caps = self._pad.get_current_caps()
        if caps is None or (self._caps is not None and caps.is_equal(self._caps)):
            return
        self._caps = caps
        found = list(self._unexpected(structure(caps)))
        for what in found:
            self._on_report(what)
        if self._is_odd and not found:
            self._on_report(f"sends what is expected again: {_described(structure(caps))}")
        self._is_odd = bool(found)

    def _unexpected(self, form: Gst.Structure) -> Iterator[str]:
        camera, sent = self._camera, tuple(form.get_int(key)[1] for key in ("width", "height"))
        expected = camera.source_size
        if all(sent) and sent != expected:
            is_said = f"width_px and height_px say {expected[0]}x{expected[1]}"
            yield f"sends {sent[0]}x{sent[1]}, but {is_said}: correct them, or set the camera"
        profile = form.get_string("profile")
        if camera.graph.passes == "h264" and profile and profile not in PLAYED:
            yield f"sends H.264 of profile {profile}, which browsers do not play: set the camera to main or high"

    def _on_picture(self, _pad: Gst.Pad, picture: PassingBuffer) -> bool:
        """From a streaming thread."""
        self._left -= 1
        self._untimed += picture.pts is None  # the time is that of the last piece, or of the only one
        if self._untimed > IN_PIECES:
            self._on_report("sends pictures in pieces, as if each were one: set one slice a picture in the camera")
            return True
        if picture.pts is not None and picture.pts < self._newest:
            self._on_report("sends B-frames: its pictures come late and out of order; switch them off in the camera")
            return True
        self._newest = picture.pts or self._newest
        return self._left <= 0


def _described(form: Gst.Structure) -> str:
    sizes, profile = [form.get_int(key)[1] for key in ("width", "height")], form.get_string("profile")
    return f"{sizes[0]}x{sizes[1]}" + (f", profile {profile}" if profile else "")
