"""Which of several pages may send requests. Pure: time is passed in."""

from __future__ import annotations

KEPT_S = 5.0  # a page that is reloaded within this time keeps control


class Control:
    """At most one page holds control; a page is known by its token, which survives a reload.

    A page that opens takes control if it is free; any page may take it on request, and the former holder then watches.
    """

    def __init__(self) -> None:
        self._holder = ""
        self._left: float | None = None  # when the holder's last page closed

    def opened(self, token: str, now: float) -> None:
        free = not self._holder or (self._left is not None and now - self._left > KEPT_S)
        if free or token == self._holder:
            self.take(token)

    def closed(self, token: str, now: float) -> None:
        if token == self._holder:
            self._left = now

    def take(self, token: str) -> None:
        self._holder, self._left = token, None

    def release(self, token: str) -> None:
        if token == self._holder:
            self._holder, self._left = "", None

    @property
    def is_held(self) -> bool:
        """Whether a page holds control, also one that is closed."""
        return bool(self._holder)

    def seen_by(self, token: str) -> str:
        """you, another or nobody"""
        if token == self._holder:
            return "you"
        return "another" if self._holder and self._left is None else "nobody"
