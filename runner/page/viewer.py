"""One browser that views the page: the messages queued for it, always bounded. No network here."""

from __future__ import annotations

import asyncio
import json
import math
import struct
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from runner.core.events import Attention
from runner.h264.access_unit import AccessUnit

HEADER = struct.Struct("<BBHIdd")  # camera, flags, 0, sequence, captured ms, arrived ms (since 1970)
KEY, CATCH_UP, RESTART = 1, 2, 4  # flags: a decoder can start here; decode but do not draw; reset the decoder first
DAMAGED = 8  # flag: the picture shows that packets were lost
WAITING_UNITS = 30  # of one camera; a viewer that is further behind restarts from the last IDR
WAITING_TEXTS = 500

Burst = Callable[[int], list[AccessUnit]]  # by camera index: the units for a decoder that starts now


class PageViewer:
    """Queues of one viewer. Used from one thread.

    token      its identity: a random name that the browser keeps when the page is reloaded
    cameras    indexes of those that it shows
    burst      returns the units that bring a late decoder up to date; called only when the viewer is ready for them
    browser    see `runner.page.control.Window`
    monitor    see there
    attention  whether its user can see the pictures; None: it has not stated that yet
    selected   name of the selected camera; "": it has not stated that yet
    """

    def __init__(
        self, token: str, cameras: Sequence[int], burst: Burst, browser: str = "", monitor: bool = False
    ) -> None:
        self.token, self.cameras, self.browser, self.monitor = token, cameras, browser, monitor
        self.attention: Attention | None = None
        self.selected = ""
        self._burst = burst
        self._filled = asyncio.Event()
        self._texts: deque[str] = deque(maxlen=WAITING_TEXTS)
        self._waiting = {camera: _Waiting() for camera in cameras}
        self._turn = 0  # of the camera at this place among them
        self._sequence = 0

    def tell(self, kind: str, message: Mapping[str, Any]) -> None:
        self._texts.append(json.dumps({"kind": kind, **message}))
        self._filled.set()

    def show(self, camera: int, unit: AccessUnit) -> None:
        """A newly received unit."""
        waiting = self._waiting.get(camera)
        if waiting is None:
            return
        self._filled.set()
        if waiting.behind:
            return  # it will be part of the burst
        waiting.live.append(unit)
        if len(waiting.live) > WAITING_UNITS:
            self.restart(camera)

    def restart(self, camera: int) -> None:
        """Clear the queue; what is sent next for this camera is a burst."""
        if camera in self._waiting:
            self._waiting[camera] = _Waiting()
            self._filled.set()

    async def next(self) -> str | bytes:
        """The next message to send, as soon as there is one."""
        while (message := self.pop()) is None:
            self._filled.clear()
            await self._filled.wait()
        return message

    def pop(self) -> str | bytes | None:
        """The next message to send, texts first, then the cameras in turn; None if there is nothing."""
        if self._texts:
            return self._texts.popleft()
        for _ in self.cameras:
            camera, self._turn = self.cameras[self._turn], (self._turn + 1) % len(self.cameras)
            waiting = self._waiting[camera]
            if waiting.behind:
                self._catch_up(camera, waiting)
            if waiting.burst:
                return self._packed(camera, *waiting.burst.popleft())
            if waiting.live:
                unit = waiting.live.popleft()
                return self._packed(camera, 0, unit)
        return None

    def _catch_up(self, camera: int, waiting: _Waiting) -> None:
        units = self._burst(camera)
        waiting.behind = not units
        last = len(units) - 1
        for number, unit in enumerate(units):
            flags = (RESTART if number == 0 else 0) | (CATCH_UP if number < last else 0)
            waiting.burst.append((flags, unit))

    def _packed(self, camera: int, flags: int, unit: AccessUnit) -> bytes:
        self._sequence = (self._sequence + 1) % 2**32
        flags |= (KEY if unit.key else 0) | (0 if unit.exact else CATCH_UP) | (DAMAGED if unit.damaged else 0)
        captured = math.nan if unit.captured is None else unit.captured * 1000
        return HEADER.pack(camera, flags, 0, self._sequence, captured, unit.arrived * 1000) + unit.data


@dataclass
class _Waiting:
    """Of one camera: whether it starts with a burst, the rest of that burst, and the units received since."""

    behind: bool = True
    burst: deque[tuple[int, AccessUnit]] = field(default_factory=deque)
    live: deque[AccessUnit] = field(default_factory=deque)
