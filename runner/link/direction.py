"""Effects of a forwarding process on packets: a limited queue, losses and a delay in each direction."""

from __future__ import annotations

import asyncio
import json
import selectors
import sys
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from typing import Any, NamedTuple

from runner.link.bucket import Bucket
from runner.link.limit import How, Rates
from runner.link.losses import LossModel
from runner.link.policer import Policer

Delivery = Callable[[], object]
UNLIMITED = {"kbps": 1e7, "queue_ms": 1000, "delay_ms": 0}


class Direction:
    """All traffic from one side to the other: a policer, one queue with one rate, then losses and the delay."""

    def __init__(
        self,
        kbps: float,
        queue_ms: float,
        delay_ms: float,
        loss: float = 0.0,
        burst: float = 1.0,
        policer: tuple[float, float] | None = None,
    ) -> None:
        self._bucket: Bucket[Delivery] = Bucket(kbps, queue_ms, time.monotonic())
        self._delay_s = delay_ms / 1000
        self._losses, self._lost = LossModel(loss, burst), 0
        self._policer, self._policed = Policer(*policer, now=time.monotonic()) if policer else None, 0
        self._delayed: deque[tuple[float, Delivery]] = deque()
        self._cut: How | None = None
        self._repeated: deque[Delivery] = deque()  # of connections, which send again what vanishes in a cut
        self._timer: asyncio.TimerHandle | None = None
        self._departed = asyncio.Event()
        self._turn = asyncio.Lock()  # connections take turns, in order

    def put(self, size: int, delivery: Delivery, *, keep: bool = False) -> None:
        """Queue a packet of `size` bytes; without `keep` it may be dropped or lost. `delivery` is called on arrival."""
        now = time.monotonic()
        if self._policer and not keep and not self._policer.passes(size, now):
            self._policed += 1
            return
        if not keep and self._losses.draw():
            delivery = self._lose
        self._bucket.put(size, partial(self._arrive, delivery, keep), now, keep=keep)
        self._deliver()

    def change(self, kbps: float | None, delay_ms: float | None, cut: How | None = None) -> dict[str, Any]:
        """Change rate and delay; None: unchanged. Returns `runner.link.limit.LinkCounters` as a dictionary.

        cut  see `runner.link.limit.Cut`; None: packets pass
        """
        now = time.monotonic()
        self._deliver()  # what has left by now has the former delay, and passed if nothing was cut
        self._cut = cut
        while self._repeated and not cut:
            self._repeated.popleft()()
        if kbps is not None:
            self._bucket.set_rate(kbps, now)
        if delay_ms is not None:
            self._delay_s = delay_ms / 1000
        self._deliver()
        counters = self._bucket.counters(now)
        return asdict(counters) | {"dropped": counters.dropped + self._policed, "lost": self._lost}

    def _lose(self) -> None:
        self._lost += 1

    def _arrive(self, delivery: Delivery, keep: bool) -> None:
        """A packet is at the end of the link."""
        if not self._cut:
            delivery()
        elif keep:
            self._repeated.append(delivery)
        else:
            self._lose()

    async def room(self, size: int) -> None:
        """Wait until the queue has room for `size` bytes, which packets that may be dropped do not take meanwhile."""
        async with self._turn:
            self._bucket.reserved = size
            try:
                while not self._bucket.has_room(size):
                    self._departed.clear()
                    await self._departed.wait()
            finally:
                self._bucket.reserved = 0

    def _deliver(self) -> None:
        """Deliver all packets that are due, and set a timer for the rest."""
        now = time.monotonic()
        for left, delivery in self._bucket.take(now):
            newest = self._delayed[-1][0] if self._delayed else left
            self._delayed.append((max(newest, left + self._delay_s), delivery))  # packets stay in order
        arriving = self._delayed if self._cut != "hold" else deque()
        while arriving and arriving[0][0] <= now:
            arriving.popleft()[1]()
        self._departed.set()
        if self._timer:
            self._timer.cancel()
        times = [self._bucket.due(), arriving[0][0] if arriving else None]
        known = [when for when in times if when is not None]
        self._timer = asyncio.get_running_loop().call_at(min(known), self._deliver) if known else None


class Link(NamedTuple):
    """Both directions: from vehicle to operator, and back."""

    up: Direction
    down: Direction

    @classmethod
    def of(cls, settings: Mapping[str, Any]) -> Link:
        """The link that `runner.link.limit.Limit.settings` describes."""
        return cls(Direction(**settings["up"]), Direction(**(settings["down"] or UNLIMITED)))


async def take_rates(links: Sequence[Link], more: Callable[[Rates], Mapping[str, int]] = lambda _: {}) -> None:
    """Set rates from standard input until it ends: a line in JSON has a link's number and `runner.link.limit.Rates`.

    Each line is answered with the counters of that link's first direction.

    more  called with each; returns further counters
    """
    lines = asyncio.StreamReader()
    await asyncio.get_running_loop().connect_read_pipe(lambda: asyncio.StreamReaderProtocol(lines), sys.stdin)
    while line := await lines.readline():
        number, stated = json.loads(line)
        link, rates = links[number], Rates(*stated)
        link.down.change(rates.down, rates.down_delay_ms, rates.cut)
        counters = link.up.change(rates.up, rates.up_delay_ms, rates.cut)
        print(json.dumps({**counters, **more(rates)}), flush=True)


def exact_loop() -> asyncio.AbstractEventLoop:
    """An event loop with timers accurate to 0.1 ms (select), not to 1 ms (epoll)."""
    return asyncio.SelectorEventLoop(selectors.SelectSelector())
