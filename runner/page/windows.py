"""The open windows of all browsers: which of them are one page, and which page acts for the station."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from runner.core.events import Attention
from runner.page.control import Control, combined_attention, page_of
from runner.page.viewer import PageViewer, text_of


class Windows:
    """In the page's thread.

    on_attention  called with whether the driver can see the pictures, from the windows of the page in control
    on_shown      called when a window has been opened or closed, with the indexes of the cameras that all windows show,
                  and whether one of them is a page
    """

    def __init__(
        self, on_attention: Callable[[Attention | None], None], on_shown: Callable[[set[int], bool], None]
    ) -> None:
        self._viewers: list[PageViewer] = []  # the newest last
        self._control = Control()
        self._on_attention, self._on_shown = on_attention, on_shown

    def __iter__(self) -> Iterator[PageViewer]:
        """Those that may drive first: nobody who watches delays their pictures."""
        return iter(sorted(self._viewers, key=lambda viewer: not viewer.visitor.may_drive))

    def count(self, name: str) -> int:
        """How many a visitor has open."""
        return sum(viewer.visitor.name == name for viewer in self._viewers)

    def add(self, viewer: PageViewer) -> None:
        """A window connects; it does not know its page's selection yet."""
        self._viewers.append(viewer)
        viewer.selected = next((other.selected for other in self._others(viewer) if other.selected), "")

    def opened(self, viewer: PageViewer, before: str | None) -> None:
        """It has been told everything. before: as in `Control.on_opened`."""
        if not viewer.monitor and viewer.visitor.may_drive:
            self._control.on_opened(viewer.token, time.monotonic(), before)
        self.state_control()
        self._state_shown()

    def closed(self, viewer: PageViewer) -> None:
        self._viewers.remove(viewer)
        if viewer.token not in {other.token for other in self._viewers if not other.monitor}:
            self._control.on_closed(viewer.token, time.monotonic())
        self.state_control()
        self._state_shown()

    def broadcast(self, kind: str, message: Mapping[str, Any]) -> None:
        text = text_of(kind, message)
        for viewer in self._viewers:
            viewer.post_text(text)

    def holder_for(self, viewer: PageViewer) -> str:
        """The holder of control from a window's point of view: see `Control`."""
        holder = self._control.holder_for(page_of(viewer, self._viewers, self._control))
        return "another" if holder == "you" and not viewer.visitor.may_drive else holder

    def take_control(self, viewer: PageViewer, request_id: object) -> None:
        if viewer.monitor:
            reason = "only a page can take control, not its monitors"
            return viewer.post("reply", {"id": request_id, "result": "refused", "reason": reason})
        self._control.take(viewer.token)
        return self.state_control()

    def select(self, viewer: PageViewer, camera: str) -> None:
        """Select a camera in all windows of a page."""
        viewer.selected = camera
        for other in self._others(viewer):
            other.selected = camera
            other.post("selection", {"camera": camera})

    def in_control(self) -> list[PageViewer]:
        """The windows of the page in control."""
        return [viewer for viewer in self._viewers if self.holder_for(viewer) == "you"]

    @property
    def attention(self) -> Attention | None:
        """Whether the driver can see the pictures, from those windows; None: nothing is known."""
        if driving := self.in_control():
            return combined_attention([viewer.attention for viewer in driving])
        return Attention.ABSENT if self._control.is_held else None

    def state_control(self) -> None:
        """Send each window the holder of control, and whether another window of its page has the focus or is hidden.

        watching   names of those who only watch, for those who may drive
        abandoned  no page acts for the station because the one that did has closed
        """
        watching = sorted({viewer.visitor.name for viewer in self._viewers if not viewer.visitor.may_drive})
        for viewer in self._viewers:
            others = self._others(viewer)
            elsewhere = any(other.focused for other in others)
            covered = any(other.attention is Attention.HIDDEN for other in others)
            holder = self.holder_for(viewer)
            abandoned = holder == "nobody" and self._control.is_held
            message = {"holder": holder, "abandoned": abandoned, "elsewhere": elsewhere, "covered": covered}
            viewer.post("control", message | ({"watching": watching} if viewer.visitor.may_drive else {}))
        self._on_attention(self.attention)

    def _state_shown(self) -> None:
        shown = {camera for viewer in self._viewers for camera in viewer.cameras}
        self._on_shown(shown, any(not viewer.monitor and viewer.visitor.may_drive for viewer in self._viewers))

    def _others(self, viewer: PageViewer) -> list[PageViewer]:
        """The other windows of a viewer's page."""
        page = page_of(viewer, self._viewers, self._control)
        others = (other for other in self._viewers if other is not viewer)
        return [other for other in others if page_of(other, self._viewers, self._control) == page]
