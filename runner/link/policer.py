"""A policer: a token bucket that drops what exceeds a rate, without a queue. Pure."""

from __future__ import annotations

from runner.link.limit import PACKET_BYTES


class Policer:
    """kbps: rate at which tokens arrive; depth_ms: of that rate in tokens at most, but at least one full packet."""

    def __init__(self, kbps: float, depth_ms: float, now: float = 0.0) -> None:
        self._rate = kbps * 1000 / 8  # bytes/s
        self._depth = max(PACKET_BYTES, self._rate * depth_ms / 1000)
        self._tokens, self._at = self._depth, now

    def passes(self, size: int, now: float) -> bool:
        """Whether a packet of so many bytes passes at a time, s, which never falls."""
        self._tokens = min(self._depth, self._tokens + (now - self._at) * self._rate)
        self._at = now
        if size > self._tokens:
            return False
        self._tokens -= size
        return True
