"""Tracks how long packet loss shows in the decoded pictures of a stream. Pure."""

from __future__ import annotations

from collections.abc import Callable

from runner.h264.access_unit import CODECS, starts

HEAD_BYTES = 2048  # of an access unit: parameter sets, SEI and the header of its first slice


class Damage:
    """Tracks damage by packet loss: access units are damaged until the picture is healed.

    A picture is healed by an IDR picture (of H.265: IRAP), or after a whole refresh wave: `recovery_frame_cnt` frames
    after a recovery point (ITU-T H.264, D.2.8). A loss within the wave damages the part that is already refreshed.
    For other codecs healing is unknown; only incomplete units count as damaged.

    is_damaged  whether units before the first one were missed
    """

    def __init__(self, codec: str, *, is_damaged: bool = False) -> None:
        self._codec = codec
        self.is_damaged = is_damaged and codec in CODECS  # until the picture is healed
        self._left: int | None = None  # remaining frames of the healing wave; None: none has begun since the loss

    def add(self, incomplete: bool, head: Callable[[], bytes], *, whole: bool = False) -> bool:
        """Add the next access unit; returns whether its picture is damaged.

        incomplete  packets of it, or between it and the previous one, were lost
        head        returns its first HEAD_BYTES; called only while the picture is damaged
        whole       whether all packets of its newest picture are known to have come nevertheless
        """
        if incomplete and whole and self._codec in CODECS and starts(head(), self._codec)[0]:
            self.is_damaged, self._left = False, None
            return False
        if incomplete:
            self.is_damaged, self._left = self._codec in CODECS, None
            return True
        if self.is_damaged and self._heals(head()):
            self.is_damaged, self._left = False, None
        return self.is_damaged

    def _heals(self, head: bytes) -> bool:
        key, recovery = starts(head, self._codec)
        if self._left is not None:
            self._left -= 1
        if recovery is not None and (self._left is None or recovery < self._left):
            self._left = recovery
        return key or self._left == 0
