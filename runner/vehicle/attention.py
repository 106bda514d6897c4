"""The driver's attention, as the operator in control states it. Pure: time is passed in."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from runner.core.events import Attention, AttentionChanged, Event
from runner.core.state import State
from runner.vehicle.operators import SILENT_S


@dataclass
class StatedAttention:
    """Who stated one last, and when."""

    _by: str = ""
    _at: float = 0.0

    def events(self, known: State, operator: str, stated: Attention | None, t: float) -> Iterator[Event]:
        """What a heartbeat of the operator in control changes.

        A heartbeat without it, such as of a ROS interface with the same keys, leaves what a page stated just before.
        """
        if stated is None and self._by == operator and t - self._at < SILENT_S:
            return
        if stated is not None:
            self._by, self._at = operator, t
        if stated is not known.attention:
            yield AttentionChanged(t=t, attention=stated)
