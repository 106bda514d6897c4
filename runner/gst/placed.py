"""Each encoded picture that shows a part of the full image only says which part, see `runner.h264.region`."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

from gi.repository import Gst

from runner.core.commands import KnobValue
from runner.core.model import Camera, Roi
from runner.gst.caps import structure
from runner.gst.probes import BufferProbe, PassingBuffer, RewritingProbe
from runner.h264.region import with_region
from runner.turning import assignments


class PlacedPictures:
    """From a turn of the knob `roi` to the first picture that leaves the encoder with the new region, by its PTS.

    While all pictures show the full image, nothing is added to them.

    sent  pad that encoded pictures pass
    """

    def __init__(self, pipeline: Gst.Bin, camera: Camera, sent: Gst.Pad) -> None:
        self._full = camera.full_roi
        # (PTS from which on, region); the last is the newest, and the first is in force at the encoder's output.
        self._regions: deque[tuple[int, Roi]] = deque([(0, self._full)])
        self._turned: deque[Roi] = deque()  # no picture has been cropped with it yet
        self._stated_pts: int | None = None
        cropping = pipeline.get_by_name(assignments(camera, "roi", self._full)[0][0])
        self._cropped = BufferProbe(cropping.get_static_pad("sink"), self._on_raw)
        self._stating = RewritingProbe(sent, self._on_encoded)

    @classmethod
    def of(cls, pipeline: Gst.Bin, camera: Camera, sent: Gst.Element | None) -> PlacedPictures | None:
        """None: of such a graph no picture can say what it shows."""
        if sent is None or not camera.graph.places:
            return None
        return cls(pipeline, camera, sent.get_static_pad("sink"))

    def on_turned(self, values: Mapping[str, KnobValue]) -> None:
        """Knobs were turned between two pictures, or before the first one."""
        region = values.get("roi")
        if isinstance(region, Roi):
            self._turned.append(region)
            self._cropped.arm()

    def _on_raw(self, _pad: Gst.Pad, picture: PassingBuffer) -> bool:
        """The first picture after a turn."""
        region = self._turned[-1]
        self._turned.clear()
        self._regions.append((picture.pts or 0, region))
        return True

    def _on_encoded(self, pad: Gst.Pad, picture: PassingBuffer) -> bytes | None:
        pts = picture.pts or 0
        while len(self._regions) > 1 and self._regions[1][0] <= pts:
            self._regions.popleft()
        region = self._regions[0][1]
        if region == self._full:
            return None
        caps = structure(pad.get_current_caps())
        # A picture may pass in several buffers, if these are not whole pictures. Different pictures may have one PTS.
        if caps.get_string("alignment") == "nal" and pts == self._stated_pts:
            return None
        self._stated_pts = pts
        prefixed = caps.get_string("stream-format") in ("avc", "avc3")
        return with_region(picture.extract(0, picture.size), region, prefixed=prefixed)
