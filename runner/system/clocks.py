"""Whether the clocks of two machines agree well enough to determine the age of a picture. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

CLOCKS_APART_MS = -1.0  # an age below it shows that the vehicle's clock is ahead; a negative age above it is noise
TRUSTED_AGAIN_S = 10.0  # time without a negative age before ages are known again
CURRENT_S = 1.0  # an older picture has no current age


@dataclass
class Clocks:
    """Whether the ages of pictures are known: each is the difference of two machines' clocks.

    A negative age shows that the vehicle's clock is ahead, by at least as much. All ages are then too small, and
    treated as unknown. A clock that is behind makes them too large; this is not detectable.

    ahead_ms  by how much the vehicle's clock is ahead at least; None: not detected
    """

    ahead_ms: float | None = None
    _negative: float = field(default=float("-inf"))  # when an age was last negative
    _frames: dict[str, tuple[int, float]] = field(default_factory=dict)  # by camera, the count and when it last rose

    def checked(self, t: float, samples: Mapping[str, Any]) -> dict[str, Any]:
        """Samples with `frames` and `latency_ms` at time t, s: an age is None where unknown or no longer current."""
        risen = {name for name, sample in samples.items() if self._rose(name, sample.frames, t)}
        lowest = min((samples[name].latency_ms or 0.0 for name in risen), default=0.0)
        if lowest < CLOCKS_APART_MS:
            self.ahead_ms, self._negative = max(-lowest, self.ahead_ms or 0.0), t
        elif t - self._negative > TRUSTED_AGAIN_S:
            self.ahead_ms = None
        return {
            name: sample if self._known(name, sample, t) else replace(sample, latency_ms=None)
            for name, sample in samples.items()
        }

    def _rose(self, name: str, frames: int, t: float) -> bool:
        before = self._frames.get(name, (0, t))[0]
        if frames != before:
            self._frames[name] = (frames, t)
        return frames != before

    def _known(self, name: str, sample: Any, t: float) -> bool:
        current = name in self._frames and t - self._frames[name][1] <= CURRENT_S
        return current and self.ahead_ms is None and (sample.latency_ms or 0.0) >= 0
