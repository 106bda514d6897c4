"""Cameras that a viewer has left: the library would let its other interleaved viewers wait."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

from runner.gst.clients import Clients
from runner.gst.pipeline import CameraPipeline

if TYPE_CHECKING:
    from runner.gst.sound_pipeline import SoundPipeline

LEFT_S = 10.0  # how long a camera is monitored after a viewer has left
BLOCKED_S = 0.4  # a camera that should send but does not for this long and three frame intervals is blocked


class LeftCameras:
    def __init__(self, clients: Clients, pipelines: Mapping[str, CameraPipeline | SoundPipeline]) -> None:
        self._clients, self._pipelines, self._changed = clients, pipelines, clients.changed
        self._left: dict[str, float] = {}  # until when each is monitored
        self._progress: dict[str, tuple[int, float]] = {}  # of each, frame count and when it last changed

    def add(self, cameras: Iterable[str]) -> None:
        with self._changed:
            self._left |= dict.fromkeys(cameras, time.monotonic() + LEFT_S)

    def look(self, now: float) -> None:
        """Let their other viewers go on; to be called a few times a second."""
        with self._changed:
            self._left = {name: until for name, until in self._left.items() if now < until}
            left = tuple(self._left)
        for name in left:
            self.wake(name)
        for name in left:
            self._unblock(name, now)

    def wake(self, name: str) -> None:
        """Make the library recheck which interleaved viewers of a camera are ready.

        It stops a camera's interleaved stream while none is ready, and rechecks when one of them has accepted data, but
        not when the viewer that it waits for leaves or a ready one joins.
        """
        for connection in self._clients.watching(name):
            transport = connection.cameras.get(name)  # None if its client's thread has meanwhile torn it down
            if transport:
                transport.message_sent()

    def _unblock(self, name: str, now: float) -> None:
        """Unblock a camera whose last interleaved viewer has left: its next packet still waits and blocks all others.

        Only while nothing is sent: a packet that the library is about to send must not be dropped.
        """
        pipeline, watching = self._pipelines.get(name), self._clients.watching(name)
        if not pipeline or not watching or any(connection.interleaved for connection in watching):
            self._progress.pop(name, None)
            return
        frames, since = pipeline.counters().frames, now
        if self._progress.get(name, (-1, now))[0] == frames and not (pipeline.paused or pipeline.source_fault):
            since = self._progress[name][1]
        if now - since > BLOCKED_S + 3 * pipeline.frame_s:
            pipeline.drop_queued_packet()
            since = now
        self._progress[name] = (frames, since)
