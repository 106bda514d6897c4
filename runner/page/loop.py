"""An asyncio loop in a thread of its own, in which a page is served."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Coroutine
from contextlib import suppress
from typing import Any

START_S = 10.0  # the port is known to be free: only a stalled machine takes longer
STOP_S = 0.5  # how long open connections may take to close


class PageLoop:
    """Runs until it is stopped. May be used from any thread."""

    def __init__(self) -> None:
        self._loop = asyncio.new_event_loop()
        self._stopped = asyncio.Event()
        self._thread = threading.Thread(target=self._run, name="page", daemon=True)

    def start(self, opening: Coroutine[Any, Any, None]) -> None:
        """Start the thread, and wait for what it does first; raises that one's exceptions."""
        self._thread.start()
        asyncio.run_coroutine_threadsafe(opening, self._loop).result(START_S)

    def stop(self, closing: Coroutine[Any, Any, None]) -> None:
        """End the thread, after what it does last."""
        with suppress(TimeoutError):  # a connection that does not close ends with the process
            asyncio.run_coroutine_threadsafe(closing, self._loop).result(STOP_S)
        self.call_soon(self._stopped.set)
        self._thread.join(STOP_S)

    def call_soon(self, callback: Callable[..., object], *values: object) -> None:
        """Call a function in the thread, unless it has ended."""
        with suppress(RuntimeError):
            self._loop.call_soon_threadsafe(callback, *values)

    def _run(self) -> None:
        """Serve until stopped, then cancel pending tasks: Python 3.11 may crash on them at exit."""
        with asyncio.Runner(loop_factory=lambda: self._loop) as runner:
            runner.run(self._stopped.wait())
