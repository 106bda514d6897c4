"""How much later than usual something arrives, by its sender's clock, which need not agree with this machine's."""

from __future__ import annotations

RESET_S = 10.0  # a larger step is not delay: the sender's clock was set, or the sender is another one
DRIFT = 0.001  # by which two clocks may differ, as a share of the time that passes


class Lateness:
    """Of one sender. Times are s."""

    def __init__(self) -> None:
        self._usual: float | None = None  # shortest difference between both clocks' times
        self._at = 0.0  # when that was

    def add(self, sent: float, arrived: float) -> float:
        """How much longer what was sent then has taken than the fastest."""
        took = arrived - sent
        if self._usual is None or abs(took - self._usual) > RESET_S:
            self._usual, self._at = took, arrived
        self._usual, self._at = min(took, self._usual + DRIFT * (arrived - self._at)), arrived
        return took - self._usual
