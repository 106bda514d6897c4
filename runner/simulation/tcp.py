"""TCP flows that compete with the cameras: slow start, which ends when delays grow (HyStart, as in Linux), then CUBIC.

Pure. See RFC 9438 and 9406. A window reacts once to its losses. Windows are in packets, times in s.
"""

from __future__ import annotations

import random
from collections.abc import Iterator
from dataclasses import dataclass
from math import inf

from runner.link.limit import TcpFlows
from runner.simulation.queues import Queue

PACKET = 1500
PAYLOAD = 1448  # of a segment with time stamps
FIRST_WINDOW = 10.0  # RFC 6928
# Growth of the round trip that ends a slow start is between these, from this window on (Linux, tcp_cubic.c).
GROWN_S, LOW_WINDOW = (0.004, 0.016), 16
C, BETA = 0.4, 0.7  # RFC 9438, section 4.6
Feedback = tuple[float, bool, float]  # when the sender learns a packet's fate, whether it arrived, when it was sent


@dataclass
class Flow:
    """One transfer after the other, with pauses."""

    flows: TcpFlows
    rtt_s: float
    rng: random.Random
    delivered: int = 0  # bytes of payload
    _left: float = 0.0
    _begins: float = 0.0
    _window: float = FIRST_WINDOW
    _threshold: float = inf
    _in_flight: int = 0
    _reduced: float = -inf
    _least: float = inf  # round trip of this transfer
    _epoch: float = 0.0  # when the window began to follow CUBIC's curve ...
    _most: float = 0.0  # ... towards this one
    _k: float = 0.0  # s until it gets there

    def begin(self, t: float, queue: Queue) -> Iterator[Feedback]:
        """A new transfer."""
        size = self.flows.size
        self._left = self.rng.randint(*size) if size else inf
        self._window, self._threshold, self._least = FIRST_WINDOW, inf, inf
        return self._send(t, queue)

    def feedback(self, t: float, delivered: bool, sent: float, queue: Queue) -> Iterator[Feedback]:
        """The sender learns of a packet's fate."""
        self._in_flight -= 1
        if delivered:
            self.delivered += PAYLOAD
            least = self._least = min(self._least, t - sent)
            is_growing = t - sent > least + max(GROWN_S[0], min(GROWN_S[1], least / 8))
            if is_growing and LOW_WINDOW <= self._window < self._threshold:
                self._threshold = self._window
                self._begin_epoch(t, self._window)
            self._grow(t)
        else:
            self._left += PAYLOAD
            if sent > self._reduced:  # otherwise it is of the window that was too large before
                self._reduced, most = t, self._window
                self._window = self._threshold = max(2.0, BETA * self._window)
                self._begin_epoch(t, most)
        return self._send(t, queue)

    def _begin_epoch(self, t: float, most: float) -> None:
        self._epoch, self._most = t, most
        self._k = ((most - self._window) / C) ** (1 / 3)

    def done(self) -> bool:
        return self._left <= 0 and not self._in_flight

    def pause_s(self) -> float:
        return self.rng.expovariate(1 / self.flows.pause_s) if self.flows.pause_s else 0.0

    def _grow(self, t: float) -> None:
        if self._window < self._threshold:
            self._window += 1
            return
        target = C * (t - self._epoch - self._k) ** 3 + self._most
        self._window += max(0.01, min(0.5 * self._window, target - self._window)) / self._window

    def _send(self, t: float, queue: Queue) -> Iterator[Feedback]:
        while self._left > 0 and self._in_flight < self._window:
            self._in_flight += 1
            self._left -= PAYLOAD
            left = queue.put(t, PACKET)
            yield (t + queue.wait_s(t) if left is None else left) + self.rtt_s, left is not None, t
