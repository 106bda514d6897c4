"""Whether more pictures pass than a rate allows, from looks at a counter."""

from __future__ import annotations

ONE = 1.5  # picture, which may be early by half an interval


class Allowance:
    """Whether more pictures pass than a rate allows."""

    def __init__(self) -> None:
        self._due, self._looked = ONE, 0.0

    def is_exceeded(self, now: float, new: int, fps: float) -> bool:
        """To be called with each look.

        now  s by any steady clock
        new  pictures since the last look
        fps  allowed, Hz
        """
        since, self._looked = (now - self._looked) * fps, now
        # What has passed since the last look may have passed just after it.
        self._due = min(self._due + since, ONE + min(since, 1)) - new
        if self._due >= 0:
            return False
        self._due = ONE
        return True
