"""Which of several pages may send requests, and which windows belong to one page. Pure: time is passed in."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from runner.core.events import Attention
from runner.page.viewer import PageViewer

GRACE_S = 5.0  # a page that is reloaded within this time keeps control
# The driver needs the pictures of every window but the focus in only one: the first of these that any reports counts.
PRECEDENCE = (Attention.HIDDEN, Attention.SLOW, Attention.WATCHING, Attention.UNFOCUSED)


class Control:
    """At most one page holds control: it acts for the station, whose operator need not be the vehicle's driver.

    A page is known by its token, which survives a reload.

    A page that opens takes control if it is free; one that only connects again, if it held control before, since nobody
    asked for another one to drive. Any page may take control on request; the previous holder then watches.
    """

    def __init__(self) -> None:
        self._holder = ""
        self._closed_at: float | None = None  # when the holder's last page closed

    def on_opened(self, token: str, now: float, before: str | None = None) -> None:
        """A page has connected.

        before  the holder from the page's point of view when it was last connected; None: it has just opened
        """
        free = not self._holder or (self._closed_at is not None and now - self._closed_at > GRACE_S)
        if token == self._holder or (free and before in (None, "you")):
            self.take(token)

    def on_closed(self, token: str, now: float) -> None:
        if token == self._holder:
            self._closed_at = now

    def take(self, token: str) -> None:
        self._holder, self._closed_at = token, None

    @property
    def is_held(self) -> bool:
        """Whether any page holds control, even one that has closed."""
        return bool(self._holder)

    def holder_for(self, token: str) -> str:
        """The holder from a page's point of view: you, another or nobody."""
        if token == self._holder:
            return "you"
        return "another" if self._holder and self._closed_at is None else "nobody"


def page_of(window: PageViewer, windows: Sequence[PageViewer], control: Control) -> str:
    """The token of the page that a window belongs to: its own, or for a monitor that of a page in the same browser.

    Of several pages it is the one in control, otherwise the newest. A monitor without a page has no control.

    windows  all open windows, the newest last
    """
    if not (window.monitor and window.browser):
        return window.token
    pages = [other.token for other in windows if other.browser == window.browser and not other.monitor]
    driving = (page for page in pages if control.holder_for(page) == "you")
    return next(driving, pages[-1] if pages else window.token)


def combined_attention(reported: Collection[Attention | None]) -> Attention | None:
    """The attention that the windows of a page report together; None: no window has reported any yet."""
    return next((attention for attention in PRECEDENCE if attention in reported), None)
