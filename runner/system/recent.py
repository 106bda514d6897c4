"""A measured value that counts only while it is recent."""

from __future__ import annotations

import time
from typing import Generic, TypeVar

CURRENT_S = 1.0  # an older value is stale

T = TypeVar("T")


class RecentValue(Generic[T]):
    """The newest value of a measurement. One thread sets it, any other may read it."""

    def __init__(self) -> None:
        self._set: tuple[float, T] | None = None  # s by the monotonic clock, value

    def set(self, value: T) -> None:
        self._set = (time.monotonic(), value)

    def get(self) -> T | None:
        """The value; None if there is none, or it is older than CURRENT_S."""
        newest = self.reading()
        return newest[1] if newest else None

    def reading(self) -> tuple[float, T] | None:
        """When the value was set, s by the monotonic clock, and the value; None as in `get`."""
        newest = self._set  # another thread may replace it
        return newest if newest and time.monotonic() - newest[0] <= CURRENT_S else None
