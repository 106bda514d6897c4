"""Keeps videorate from letting a burst of pictures through after a gap: no Python runs for a picture."""

from __future__ import annotations

from gi.repository import Gst

from runner.dropping import DROPPING
from runner.gst.allowance import Allowance
from runner.gst.source import fixed_rate

GAP_S = 0.25  # without a picture, after which the rate is counted anew
GAP_INTERVALS = 2.5  # and at least this many intervals
LATER = 2**62  # running time at which a segment begins, ns: none ends there


class RateLimit:
    """Makes `videorate drop-only=true` count its rate anew after a gap.

    It lets as many pictures through as were due since it began to count. So after a gap in the times of its pictures
    it makes up for what is missing: until then all pictures of a faster camera pass. It begins anew with a segment in
    which the picture that is due would be in the past (GStreamer before 1.24: with any), so it gets such a segment just
    before its own. GStreamer sends that again, before the next picture, when the offset of a pad changes, here by 1 ns.
    The encoder goes on as before, without a key frame.

    fps  its rate, Hz
    """

    def __init__(self, rate: Gst.Element, fps: float) -> None:
        self._rate, self._fps = rate, fps
        rate.get_static_pad("sink").add_probe(Gst.PadProbeType.EVENT_DOWNSTREAM, _on_event)
        self._passed, self._passed_at = 0, 0.0
        self._allowance = Allowance()

    def look(self, now: float) -> None:
        """Look how many pictures have passed; many times a second, from one thread. now: s by any steady clock."""
        passed = self._rate.get_property("out")
        new, self._passed = passed - self._passed, passed
        if new:
            self._passed_at = now
        is_gap = now - self._passed_at > max(GAP_S, GAP_INTERVALS / self._fps)
        if self._allowance.is_exceeded(now, new, self._fps) or is_gap:
            self._begin_anew()
            self._passed_at = now

    def turn(self, fps: float) -> None:
        """It is given another rate, Hz: what was due at the one before counts no more."""
        self._fps = fps
        self._begin_anew()

    def _begin_anew(self) -> None:
        above = self._rate.get_static_pad("sink").get_peer()
        if above:
            above.set_offset(above.get_offset() ^ 1)


class RateLimits:
    """The limits of the elements that hold the rate of a source, which may be replaced by others."""

    def __init__(self, fps: float) -> None:
        self._fps = fps
        self._limits: list[RateLimit] = []

    def follow(self, source: Gst.Bin) -> None:
        """Limit the elements of a new source in place of those before."""
        dropping = [rate for rate in fixed_rate(source) if rate.get_property("drop-only")]
        # What drops pictures of the source is not of it, though both may be in one pipeline.
        self._limits = [RateLimit(rate, self._fps) for rate in dropping if rate.get_name() != DROPPING]

    def look(self, now: float) -> None:
        """As `RateLimit.look`."""
        for limit in self._limits:
            limit.look(now)


def _on_event(pad: Gst.Pad, info: Gst.PadProbeInfo) -> Gst.PadProbeReturn:
    event = info.get_event()
    if event.type == Gst.EventType.SEGMENT and (segment := event.parse_segment()).base != LATER:
        later = segment.copy()
        later.base = LATER
        pad.send_event(Gst.Event.new_segment(later))
    return Gst.PadProbeReturn.OK
