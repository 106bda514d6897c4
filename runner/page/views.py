"""What the windows of the page in control show of the cameras, as each of them states it. In the page's thread."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from runner.core.events import Attention
from runner.core.model import Camera
from runner.core.view import KEYS, NOWHERE, Seen, View, united
from runner.operator.seen import StatedView
from runner.page.viewer import PageViewer
from runner.page.windows import Windows

VALID_S = 2.0  # what a window has stated holds for so long; it states it again every 0.5 s
LOOK_S = 0.1  # between two looks at what has expired


class _Stated(NamedTuple):
    view: View
    at: float


class PageViews:
    """A window sees no other cameras than the station sends it; of these, everything, unless it states otherwise.

    cameras  of the vehicle, in its order
    seen     is told what they show together
    """

    def __init__(self, cameras: Sequence[Camera], windows: Windows, seen: StatedView) -> None:
        self._cameras, self._windows, self._seen = cameras, windows, seen
        self._stated: dict[PageViewer, _Stated] = {}

    def take(self, window: PageViewer, message: Mapping[str, Any]) -> None:
        """What a window states. If that is refused, it counts as seeing everything."""
        self._stated.pop(window, None)
        if problem := self._problem(window, message):
            window.post("reply", {"id": None, "result": "refused", "reason": problem})
        else:
            view = {name: Seen(**seen) for name, seen in message["view"].items()}
            self._stated[window] = _Stated(view, time.monotonic())
        self.state()

    def forget(self, window: PageViewer) -> None:
        self._stated.pop(window, None)

    async def expire(self) -> None:
        """What a window has stated expires by itself."""
        while True:
            self.state()
            await asyncio.sleep(LOOK_S)

    def state(self) -> None:
        """State what the driver sees; while nobody is known to watch, nothing: all counts as seen."""
        watches = self._windows.attention is Attention.WATCHING
        self._seen.state(self._together(time.monotonic()) if watches else None, VALID_S, by="page")

    def _together(self, now: float) -> View:
        """What the windows of the page in control show, by camera; those not named: in full."""
        view = {camera.name: NOWHERE for camera in self._cameras}
        for window in self._windows.in_control():
            stated = self._stated.get(window)
            seen = stated.view if stated and now - stated.at < VALID_S else {}
            for name in [self._cameras[index].name for index in window.cameras]:
                if name not in seen:
                    view.pop(name, None)
                elif name in view:
                    view[name] = united(view[name], seen[name])
        return view

    def _problem(self, window: PageViewer, message: Mapping[str, Any]) -> str | None:
        stated = message["view"]
        if len(message) > 1 or not isinstance(stated, Mapping):
            return "view: must be an object, by camera, and the only key"
        cameras = {self._cameras[index].name: self._cameras[index] for index in window.cameras}
        for name, seen in stated.items():
            if name not in cameras:
                return f"view: {name[:64]!r}: this window shows no such camera"
            if problem := _problem_of(cameras[name], seen):
                return f"view: {name}: {problem}"
        return None


def _problem_of(camera: Camera, seen: object) -> str | None:
    """What is wrong with a region as a window states it."""
    if not isinstance(seen, Mapping) or set(seen) != set(KEYS):
        return f"must have {', '.join(KEYS)}, and no other key"
    return Seen(**seen).problem(camera)
