"""Requests to the vehicle: each with an id and the vehicle's time as this side knows it, until it is answered."""

from __future__ import annotations

import threading
import time
import uuid
from collections.abc import Callable
from typing import NamedTuple

from runner.mqtt.messages import JsonObject, MqttMessage, read_reply
from runner.records.vehicle import Outcome

OnReply = Callable[[Outcome], None]


class _Pending(NamedTuple):
    on_reply: OnReply | None
    event: str
    until: float


class Requests:
    """Requests of one operator. May be used from any thread.

    publish   sends a request
    answer_s  how long to wait for an answer
    note      called with why a request was refused that nobody waits for
    """

    def __init__(self, publish: Callable[[JsonObject], bool], answer_s: float, note: Callable[[str], None]) -> None:
        self._publish, self._answer_s, self._note = publish, answer_s, note
        self.vehicle_time = (0.0, 0.0)  # the vehicle's time in the newest telemetry, and when it arrived
        self._pending: dict[str, _Pending] = {}
        self._lock = threading.Lock()

    def send(self, event: JsonObject, on_reply: OnReply | None = None, *, awaited: bool = True) -> None:
        """Send a request.

        on_reply  called with its outcome
        awaited   whether an answer is expected
        """
        identity, now = uuid.uuid4().hex, time.monotonic()
        if awaited:
            with self._lock:
                self._pending[identity] = _Pending(on_reply, event["event"], now + self._answer_s)
        self._publish({**event, "id": identity, "as_of": self.vehicle_now(now)})

    def refuse(self, on_reply: OnReply | None, reason: str) -> None:
        """Answer a request that cannot be sent."""
        if on_reply:
            on_reply(Outcome(self.vehicle_time[0], "refused", reason))

    def vehicle_now(self, now: float) -> float:
        """The vehicle's time in the newest telemetry, plus the time since."""
        t, arrived = self.vehicle_time
        return round(t + now - arrived, 6)

    def own_time(self, t: float) -> float:
        """A time of the vehicle by this machine's clock, s since 1970."""
        return time.time() - (self.vehicle_now(time.monotonic()) - t)

    def heard_within(self, seconds: float) -> bool:
        """Whether the vehicle has stated its time within the last seconds."""
        t, arrived = self.vehicle_time
        return 0 < time.monotonic() - arrived <= seconds and t > 0

    def on_reply(self, message: MqttMessage) -> None:
        reply = read_reply(message.payload)
        with self._lock:
            pending = self._pending.pop(reply.id, None)
        if pending is None:
            return
        if pending.on_reply:
            pending.on_reply(reply)
        elif reply.result == "refused":
            self._note(f"{pending.event} refused: {reply.reason}")

    def time_out(self, now: float) -> None:
        with self._lock:
            expired = {identity: each for identity, each in self._pending.items() if now > each.until}
            for identity in expired:
                del self._pending[identity]
        for pending in expired.values():
            if pending.on_reply:
                reason = f"no answer from the vehicle within {self._answer_s:g} s"
                pending.on_reply(Outcome(self.vehicle_now(now), "timed out", reason))
