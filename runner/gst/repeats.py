"""Detects by content a source that repeats its last picture as new: a camera that hangs behind a working driver."""

from __future__ import annotations

import time
import zlib
from collections.abc import Callable

from gi.repository import Gst

from runner.gst.caps import structure
from runner.gst.outage import Outage
from runner.gst.probes import BufferProbe, PassingBuffer

SLICES, SLICE_BYTES = 16, 8192  # compared parts of a picture: sensor noise is everywhere
CHECKS = 4  # consecutive identical checks before a picture counts as repeated


class RepeatDetector:
    """Compares parts of sampled pictures; no Python runs for the others.

    pad        where raw pictures pass; encoded ones, and those outside main memory, are not compared
    after_s    how long a picture must repeat; None: pictures are not compared
    on_report  called with a sentence when repetition begins, and when it ends
    """

    def __init__(self, pad: Gst.Pad, after_s: float | None, on_report: Callable[[str], None]) -> None:
        self._after_s = after_s
        self._next = BufferProbe(pad, self._on_picture)
        self.outage = Outage(on_report)
        self._digest: int | None = None
        self._since, self._checks = 0.0, 0

    def check_next(self) -> None:
        """Check the next picture; to be called a few times a second, from one thread."""
        if self._after_s is not None:
            self._next.arm()

    def _on_picture(self, pad: Gst.Pad, picture: PassingBuffer) -> bool:
        caps, now = pad.get_current_caps(), time.monotonic()
        if not caps or not _is_readable(caps):
            return True
        digest = _digest(picture)
        if digest != self._digest:
            self._digest, self._since, self._checks = digest, now, 1
            self.outage.report_recovery(now)
        else:
            self._checks += 1
            if now - self._since >= (self._after_s or 0.0) and self._checks >= CHECKS:
                self.outage.report_failure("source: repeats the same picture", self._since)
        return True


def _is_readable(caps: Gst.Caps) -> bool:
    in_memory = caps.get_features(0).contains(Gst.CAPS_FEATURE_MEMORY_SYSTEM_MEMORY)
    return bool(in_memory and structure(caps).get_name() == "video/x-raw")


def _digest(picture: PassingBuffer) -> int:
    step = max(0, picture.size - SLICE_BYTES) / (SLICES - 1)
    digest = 0
    for number in range(SLICES):
        digest = zlib.crc32(picture.extract(round(number * step), SLICE_BYTES), digest)
    return digest
