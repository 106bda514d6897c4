"""What a program waits for, from a side that receives and decodes: pictures, sound."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sized
from contextlib import contextmanager
from typing import TYPE_CHECKING, Generic, TypeVar

if TYPE_CHECKING:
    from runner.apply import OperatorSide

CHECK_S = 0.25  # how often the side is sampled, which rebuilds what is silent
STOP_S = 1.0  # how long the last check may take

T = TypeVar("T")


class Awaited(Generic[T]):
    """Each delivered item once, in order.

    waiting  holds those that were not taken yet
    take     removes the next one from it, and returns it

    Who adds one holds `_changed`, and notifies it.
    """

    def __init__(self, waiting: Sized, take: Callable[[], T]) -> None:
        self._waiting, self._take = waiting, take
        self._changed = threading.Condition()
        self._closed = False

    def __iter__(self) -> Iterator[T]:
        while (item := self.next()) is not None:
            yield item

    def next(self, timeout_s: float | None = None) -> T | None:
        """The next item; None after the timeout, or once this is closed."""
        with self._changed:
            if not self._changed.wait_for(lambda: self._waiting or self._closed, timeout_s) or self._closed:
                return None
            return self._take()

    def close(self) -> None:
        with self._changed:
            self._closed = True
            self._changed.notify_all()


@contextmanager
def watched(side: OperatorSide, items: Awaited[T], look: Callable[[], object]) -> Iterator[None]:
    """Within the block the side is sampled by `look`; then it is stopped, and nobody waits for items any more."""
    stopped = threading.Event()

    def watch() -> None:
        try:
            while not stopped.wait(CHECK_S):
                look()
        finally:
            items.close()  # release a caller that waits for a failed side

    watcher = threading.Thread(target=watch, name="watch", daemon=True)
    watcher.start()
    try:
        yield
    finally:
        stopped.set()
        items.close()
        watcher.join(STOP_S)
        side.stop()
