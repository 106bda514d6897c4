"""Key frames that repair pictures after packet loss. Pure: time is passed in."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

KEY_FRAME_S = 0.5  # between two of a camera: each costs bits of the next pictures


@dataclass
class KeyFrames:
    _sent: dict[str, float] = field(default_factory=dict)  # by camera, time of the last one

    def due(self, damaged: Iterable[str], t: float) -> list[str]:
        """The cameras that are sent a key frame now, of those with unrecovered loss."""
        due = sorted(name for name in damaged if t - self._sent.get(name, -KEY_FRAME_S) >= KEY_FRAME_S)
        self._sent |= dict.fromkeys(due, t)
        return due
