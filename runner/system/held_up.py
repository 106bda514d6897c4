"""Checks for silence by a process that may itself be held up, as on a busy machine."""

from __future__ import annotations

HELD_UP_S = 0.75  # between two checks that come a few times a second


class LateCheck:
    """Excuses a check that comes late: what has arrived meanwhile may not have been handled yet.

    Never two in succession, so that silence is noticed by a process that is always late. Times are s.

    held_up_s  time since the last check from which one is late
    """

    def __init__(self, held_up_s: float = HELD_UP_S) -> None:
        self._held_up_s = held_up_s
        self._last = float("-inf")
        self._was_excused = False

    def is_excused(self, now: float) -> bool:
        """Whether the check at this time should judge nothing. To be called at every check."""
        late, self._last = now - self._last > self._held_up_s, now
        self._was_excused = late and not self._was_excused
        return self._was_excused
