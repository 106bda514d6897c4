"""The bounded message queues of one browser that views the page. No network here."""

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
from runner.page.login import OPERATOR, Visitor

HEADER = struct.Struct("<BBHIdd")  # camera, flags, 0, sequence, captured ms, arrived ms (since 1970)
KEY, CATCH_UP, RESTART = 1, 2, 4  # flags: a decoder can start here; decode but do not draw; reset the decoder first
DAMAGED = 8  # flag: the picture shows that packets were lost
REGION = struct.Struct("<HHHH")  # of the full image that the picture shows: x, y, width, height, px
PLACED = 16  # flag: a region follows the header
MAX_UNITS = 30  # queued for one camera; a viewer that is further behind gets a burst in their place
MAX_TEXTS = 500
SOUND = 255  # in place of a camera's index
MAX_SOUNDS = 25  # packets; older ones would be played too late

Burst = Callable[[int], list[AccessUnit]]  # by camera index: the units that a decoder starting now needs


class PageViewer:
    """Queues of one viewer. Not thread-safe.

    token      its identity: a random name that the browser keeps across a reload
    cameras    indexes of the cameras that it shows
    burst      returns the units that bring a late decoder up to date; called only when the viewer is ready for them
    browser    random name that all windows of a browser share; "": none given
    monitor    whether it shows some cameras for a page in another window of the same browser
    visitor    who looks at it
    attention  whether its user can see the pictures; None: not reported yet
    focused    whether its browser's keys reach it
    selected   name of the selected camera; "": none yet
    """

    def __init__(
        self,
        token: str,
        cameras: Sequence[int],
        burst: Burst,
        browser: str = "",
        monitor: bool = False,
        visitor: Visitor = OPERATOR,
    ) -> None:
        self.token, self.cameras, self.browser, self.monitor, self.visitor = token, cameras, browser, monitor, visitor
        self.attention: Attention | None = None
        self.focused = False
        self.selected = ""
        self._burst = burst
        self._nonempty = asyncio.Event()
        self._texts: deque[str] = deque(maxlen=MAX_TEXTS)
        self._sounds: deque[bytes] = deque(maxlen=MAX_SOUNDS)
        self._queues = {camera: _CameraQueue() for camera in cameras}
        self._next = 0  # index in `cameras` of the one whose turn it is
        self._sequence = 0

    def post(self, kind: str, message: Mapping[str, Any]) -> None:
        self.post_text(text_of(kind, message))

    def post_text(self, text: str) -> None:
        """As `post`, of what `text_of` returns."""
        self._texts.append(text)
        self._nonempty.set()

    def show(self, camera: int, unit: AccessUnit) -> None:
        """A newly received unit."""
        queue = self._queues.get(camera)
        if queue is None:
            return
        self._nonempty.set()
        if queue.needs_burst or queue.is_behind:
            return  # a burst will include it
        queue.live.append(unit)
        if len(queue.live) > MAX_UNITS and queue.burst:
            queue.live.clear()
            queue.is_behind = True  # it first gets the picture at the end of this burst, or would never see any
        elif len(queue.live) > MAX_UNITS:
            self.restart(camera)

    def hear(self, number: int, captured: float | None, arrived: float, data: bytes) -> None:
        """A newly received packet of the vehicle's sound; arguments as of `runner.gst.sound_receiver.SoundPacket`."""
        head = HEADER.pack(SOUND, 0, 0, number % 2**32, _ms(captured), _ms(arrived))
        self._sounds.append(head + data)
        self._nonempty.set()

    def restart(self, camera: int) -> None:
        """Clear the queue; the next units sent for this camera are a burst."""
        if camera in self._queues:
            self._queues[camera] = _CameraQueue()
            self._nonempty.set()

    def waits(self, camera: int) -> bool:
        """Whether it has nothing yet to begin with."""
        return camera in self._queues and self._queues[camera].needs_burst

    async def next(self) -> str | bytes:
        """Wait for the next message to send."""
        while (message := self.pop()) is None:
            self._nonempty.clear()
            await self._nonempty.wait()
        return message

    def pop(self) -> str | bytes | None:
        """The next message to send, texts first, then sound, then the cameras in turn; None if all queues are empty."""
        if self._texts:
            return self._texts.popleft()
        if self._sounds:
            return self._sounds.popleft()
        for _ in self.cameras:
            camera, self._next = self.cameras[self._next], (self._next + 1) % len(self.cameras)
            if self._queues[camera].is_behind and not self._queues[camera].burst:
                self._queues[camera] = _CameraQueue()
            queue = self._queues[camera]
            if queue.needs_burst:
                self._catch_up(camera, queue)
            if queue.burst:
                return self._pack(camera, *queue.burst.popleft())
            if queue.live:
                unit = queue.live.popleft()
                queue.is_mixed = queue.is_mixed and not unit.whole
                return self._pack(camera, CATCH_UP if queue.is_mixed else 0, unit)
        return None

    def _catch_up(self, camera: int, queue: _CameraQueue) -> None:
        units = self._burst(camera)
        queue.needs_burst = not units
        queue.is_mixed = bool(units) and not units[-1].whole
        last = len(units) - (0 if queue.is_mixed else 1)
        for number, unit in enumerate(units):
            flags = (RESTART if number == 0 else 0) | (CATCH_UP if number < last else 0)
            queue.burst.append((flags, unit))

    def _pack(self, camera: int, flags: int, unit: AccessUnit) -> bytes:
        self._sequence = (self._sequence + 1) % 2**32
        flags |= (KEY if unit.key else 0) | (0 if unit.exact else CATCH_UP) | (DAMAGED if unit.damaged else 0)
        region = unit.region and REGION.pack(unit.region.x, unit.region.y, unit.region.width, unit.region.height)
        flags |= PLACED if region else 0
        head = HEADER.pack(camera, flags, 0, self._sequence, _ms(unit.captured), _ms(unit.arrived))
        return head + (region or b"") + unit.data


@dataclass
class _CameraQueue:
    """Units of one camera: whether a burst is due, the rest of that burst, and the units received since.

    is_behind  whether units were dropped while the burst is sent: another one follows
    is_mixed  whether the viewer's decoder started too late to show the whole picture, see `AccessUnit.whole`
    """

    needs_burst: bool = True
    burst: deque[tuple[int, AccessUnit]] = field(default_factory=deque)
    live: deque[AccessUnit] = field(default_factory=deque)
    is_behind: bool = False
    is_mixed: bool = False


def _ms(time: float | None) -> float:
    return math.nan if time is None else 1000 * time


def text_of(kind: str, message: Mapping[str, Any]) -> str:
    """A message for pages."""
    return json.dumps({"kind": kind, **message})
