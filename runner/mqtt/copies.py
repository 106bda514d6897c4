"""Which copies of a message to ignore: with several uplinks, each one comes once by every connection. Pure."""

from __future__ import annotations

from dataclasses import dataclass, field
from hashlib import blake2b
from math import inf

from runner.mqtt.messages import SILENT_S, MqttMessage

KEPT_S = 60.0  # how long a message is known: its copies may come so much later
MOST_KEPT = 10_000  # messages; two operators' of a minute, who report 25 times a second by each of two uplinks


@dataclass(slots=True)
class _Seen:
    """A message: how often it was taken, when it last came, and how often it came by each connection."""

    taken: int = 0
    at: float = 0.0
    came: dict[str, int] = field(default_factory=dict)


class FirstCopies:
    """Tells the first copy of a message from those that come by other connections.

    A message that its sender repeats is new: it comes once more by a connection than it was taken.
    """

    def __init__(self) -> None:
        self._seen: dict[bytes, _Seen] = {}  # by digest, in the order in which they last came

    def is_first(self, connection: str, message: MqttMessage, now: float) -> bool:
        """Whether a message that came by a connection at time `now`, s, has not come by another one."""
        self._forget(now)
        key = blake2b(b"%s\0%s" % (message.topic.encode(), message.payload), digest_size=16).digest()
        seen = self._seen[key] = self._seen.pop(key, _Seen())
        seen.at, seen.came[connection] = now, seen.came.get(connection, 0) + 1
        is_first = seen.came[connection] > seen.taken
        seen.taken += is_first
        return is_first

    def _forget(self, now: float) -> None:
        while self._seen:
            oldest = next(iter(self._seen))
            if len(self._seen) < MOST_KEPT and now - self._seen[oldest].at <= KEPT_S:
                return
            del self._seen[oldest]


class Newest:
    """Tells what a vehicle newly states from copies, and from what one of its uplinks held and then delivers.

    Nothing is older than what was taken, unless nothing was taken for SILENT_S: the vehicle may have been restarted.
    """

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        self._newest: dict[str, float] = {}  # by kind of message, the vehicle's time in it
        self._taken = -inf

    def takes(self, kind: str, t: float, now: float) -> bool:
        """Whether a message of a kind is newer than all before; t: as it states, now: when it came, both in s."""
        if t <= self._newest.get(kind, -inf):
            if now - self._taken <= SILENT_S:
                return False
            self._newest.clear()
        self._newest[kind], self._taken = t, now
        return True
