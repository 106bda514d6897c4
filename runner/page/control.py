"""Which of several pages may send requests, and which windows belong to one page. Pure: time is passed in."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Protocol

from runner.core.events import Attention

KEPT_S = 5.0  # a page that is reloaded within this time keeps control
# The driver needs the pictures of all windows, and the focus in one of them: the first of these that any states counts.
OF_ALL_WINDOWS = (Attention.HIDDEN, Attention.SLOW, Attention.WATCHING, Attention.UNFOCUSED)


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


class Window(Protocol):
    """A browser's window.

    token    of the page in it, or of the monitor
    browser  random name that all windows of a browser share; "": it stated none
    monitor  whether it shows some cameras for a page in another window of that browser
    """

    @property
    def token(self) -> str: ...
    @property
    def browser(self) -> str: ...
    @property
    def monitor(self) -> bool: ...


def page_of(window: Window, windows: Sequence[Window], control: Control) -> str:
    """The token of the page that a window belongs to: its own; of a monitor, that of a page of its browser.

    Of several it is the one in control, else the newest. A monitor without a page is on its own, without control.

    windows  that are open, the newest last
    """
    if not (window.monitor and window.browser):
        return window.token
    pages = [other.token for other in windows if other.browser == window.browser and not other.monitor]
    driving = (page for page in pages if control.seen_by(page) == "you")
    return next(driving, pages[-1] if pages else window.token)


def attention_of(stated: Collection[Attention | None]) -> Attention | None:
    """What the windows of a page state together; None: none has stated anything yet."""
    return next((attention for attention in OF_ALL_WINDOWS if attention in stated), None)
