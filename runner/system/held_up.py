"""Checks for silence by a process that may itself be held up, as on a busy machine."""

from __future__ import annotations

HELD_UP_S = 0.75  # between two checks, which come a few times a second


class LateCheck:
    """Excuses a check that comes late: what has arrived meanwhile may not have been handled yet.

    Never two in succession, so that silence is noticed by a process that is always late. Times are s.
    """

    def __init__(self) -> None:
        self._last = float("-inf")
        self._was_excused = False

    def is_excused(self, now: float) -> bool:
        """Whether the check at this time should judge nothing. To be called at every check."""
        late, self._last = now - self._last > HELD_UP_S, now
        self._was_excused = late and not self._was_excused
        return self._was_excused
