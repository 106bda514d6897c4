"""When the frames of one camera left the vehicle, found by looking at its payloader: no Python runs for a frame."""

from __future__ import annotations

import time
from collections import deque

from gi.repository import Gst

from runner.gst.clocks import unix_time
from runner.records.reception import SentFrame

MAX_FRAMES = 256  # not taken yet; beyond that the oldest are dropped
TICKS = 2**32  # of an RTP timestamp, which then starts over (RFC 3550)


class SentFrames:
    """Looks which frame a payloader has output last.

    One thread looks, many times a second; any one other thread takes what it found.
    """

    def __init__(self, payloader: Gst.Element) -> None:
        self._payloader = payloader
        self._frames: deque[SentFrame] = deque(maxlen=MAX_FRAMES)
        self._stamp: int | None = None
        self._looked = 0.0  # when it last looked, s since 1970

    def look(self) -> None:
        before, stamp = time.time(), self._payloader.get_property("timestamp")
        if stamp != self._stamp:
            captured = self._captured() if self._stamp is not None else None
            if captured is not None:
                self._frames.append(SentFrame(captured, self._looked, time.time()))
            self._stamp = stamp
        self._looked = before

    def take(self) -> list[SentFrame]:
        """The frames found since the last call, in the order in which they were sent."""
        return [self._frames.popleft() for _ in range(len(self._frames))]

    def _captured(self) -> float | None:
        """Capture time of the newest frame, s since 1970; None while the payloader has no clock or no frame."""
        clock, stats = self._payloader.get_clock(), self._payloader.get_property("stats")
        rate = stats.get_value("clock-rate")
        if clock is None or not rate:
            return None
        base = self._payloader.get_base_time()
        ticks = (clock.get_time() - base) * rate // Gst.SECOND
        ago = (ticks - stats.get_value("timestamp") + stats.get_value("timestamp-offset")) % TICKS
        ago -= TICKS if 2 * ago >= TICKS else 0  # a frame of the near future
        return unix_time(clock, base, (ticks - ago) * Gst.SECOND // rate)
