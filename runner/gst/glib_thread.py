"""GLib's main loop in a thread of its own, which runs what other threads need done there."""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, wait
from typing import TypeVar

from runner.errors import RunError
from runner.gst import GLib, load_types
from runner.gst.aside import settle

CALL_S = 10.0  # timeout of a call into GLib's thread, which normally takes milliseconds
BEAT_MS = 200  # how often GLib's thread shows that it runs
STOP_S = 2.0  # how long teardown waits for pipelines to stop

T = TypeVar("T")


class GlibThread:
    """GLib's main loop in its own thread, where the RTSP server and the buses run.

    `beat` is when it last ran its timers (time.monotonic).
    """

    def __init__(self) -> None:
        load_types()
        self._loop = GLib.MainLoop()
        self._calls: deque[Callable[[], None]] = deque()
        # One watch for all calls: see runner/gst/probes.py. Its priority is that of the timers: at a lower one,
        # calls would wait for as long as an overloaded loop always has a timer to run.
        self._wakeup = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        self._watch = GLib.unix_fd_add_full(GLib.PRIORITY_DEFAULT, self._wakeup, GLib.IOCondition.IN, self._on_wakeup)
        self.beat = time.monotonic()
        self._beating = GLib.timeout_add(BEAT_MS, self._on_beat)
        self._thread = threading.Thread(target=self._loop.run, name="glib", daemon=True)
        self._thread.start()

    def call(self, what: str, function: Callable[[], T]) -> T:
        """Run a function in the loop's thread and wait for what it returns; its exceptions are raised here.

        what    description of the work, for messages
        raises  RunError if it takes longer than CALL_S, or the loop has ended
        """
        if self._wakeup < 0:
            raise RunError(f"GStreamer's thread has ended: {what}")
        done: Future[T] = Future()

        def run() -> None:
            try:
                done.set_result(function())
            except BaseException as error:
                done.set_exception(error)

        self._calls.append(run)
        os.eventfd_write(self._wakeup, 1)
        if not wait((done,), CALL_S).done:
            raise RunError(f"GStreamer hangs: {what} takes more than {CALL_S:g} s")
        return done.result()

    def _on_beat(self) -> bool:
        self.beat = time.monotonic()
        return True

    def _on_wakeup(self, *_: object) -> bool:
        os.eventfd_read(self._wakeup)
        while self._calls:
            self._calls.popleft()()
        return True

    def end(self, stop: Callable[[], None]) -> None:
        """Run the last function, let state changes finish, and end the loop. Anything that still hangs is abandoned."""
        try:
            self.call("stopping", stop)
            settle(STOP_S)
        finally:
            self._quit()

    def _quit(self) -> None:
        self._loop.quit()
        self._thread.join(timeout=5)
        if not self._thread.is_alive():
            GLib.source_remove(self._beating)
            GLib.source_remove(self._watch)
            wakeup, self._wakeup = self._wakeup, -1  # its number may soon be reused
            os.close(wakeup)
