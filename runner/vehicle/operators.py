"""Tracks which operators are present and whether a request is too old to execute. Pure: time is passed in.

An operator is a client that sends requests under its own id, which is part of the topic. It is present from its
`operator_connected` until it falls silent or signs off; any later message brings it back. Which of those present is in
control: `runner.core.driving`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection
from dataclasses import dataclass, field
from math import inf

from runner.mqtt.messages import MAX_ROUND_TRIP_S

SILENT_S = 1.0  # an operator that sends nothing for this long is offline; it normally sends four messages a second
AHEAD_S = 0.1  # by how much `as_of` may exceed the vehicle's time: two monotonic clocks drift apart
DELAYS = 64  # delays remembered of each operator; their minimum is the round trip
CLOCK_S = 0.1  # between two answers about the clock to an operator, which asks five times a second
PRESENT_S = 1.0  # a process of an operator that has reported within this time still runs
MAX_OPERATORS = 64  # remembered; a new one replaces the one that has been silent longest


@dataclass(slots=True)
class _Operator:
    last_message: float
    present: bool = False
    announced: bool = False
    watching: bool = False
    clock_asked: float = -inf
    runs: dict[int, float] = field(default_factory=dict)  # by process, when it last sent a reception report
    delays: deque[float] = field(default_factory=lambda: deque(maxlen=DELAYS))


class Operators:
    """All operators known to the vehicle.

    expires_s  age from which a request is dropped, beyond the measured round trip
    """

    def __init__(self, expires_s: float) -> None:
        self._expires_s = expires_s
        self._known: dict[str, _Operator] = {}

    @property
    def present(self) -> frozenset[str]:
        return frozenset(name for name, operator in self._known.items() if operator.present)

    @property
    def watching(self) -> frozenset[str]:
        """Those who say that they only watch."""
        return frozenset(name for name, operator in self._known.items() if operator.watching)

    def connected(self, name: str, t: float, *, watching: bool = False) -> bool:
        """An operator announces itself, initially or as its heartbeat; returns whether it was absent."""
        operator = self._operator(name, t)
        operator.announced, operator.watching = True, watching
        return self.message_received(name, t)

    def message_received(self, name: str, t: float) -> bool:
        """An operator sent any message at time t, s; returns whether it was absent."""
        operator = self._operator(name, t)
        operator.last_message = t
        returns = operator.announced and not operator.present
        operator.present = operator.present or returns
        return returns

    def signed_off(self, name: str) -> bool:
        """An operator has signed off; returns whether it was present."""
        operator = self._known.get(name)
        was_present = operator is not None and operator.present
        if operator:
            operator.present = operator.announced = False  # a report may be queued behind it
        return was_present

    def expire_silent(self, t: float, queued: Collection[str] = ()) -> list[str]:
        """Mark operators that have been silent for too long as offline; returns them.

        queued  operators with messages still to be processed
        """
        silent = [name for name, o in self._known.items() if o.present and t - o.last_message > SILENT_S]
        offline = [name for name in silent if name not in queued]
        for name in offline:
            self._known[name].present = False
        return offline

    def expired(self, name: str, t: float, as_of: float) -> str | None:
        """Why a request is too old to execute at time t; None if it is not.

        as_of  the vehicle's time in the newest telemetry that the sender had, plus the time since by the sender's
               clock. So `t - as_of` is one round trip for a request that was not delayed; no clocks are compared.
        """
        delay = t - as_of
        if delay < -AHEAD_S:
            return f"as_of {as_of:g} is ahead of the vehicle's time, {t:g}"
        operator = self._operator(name, t)
        round_trip = min(operator.delays, default=0.0)
        operator.delays.append(max(0.0, delay))
        limit = self._expires_s + min(round_trip, MAX_ROUND_TRIP_S)
        return f"{delay:.2f} s old, limit {limit:.2f} s" if delay > limit else None

    def overdue_s(self, name: str, t: float, as_of: float) -> float:
        """How much longer a message took than its sender's shortest round trip; see `expired`."""
        return max(0.0, t - as_of - min(self._operator(name, t).delays, default=0.0))

    def reported(self, name: str, t: float, run: int) -> None:
        """A process of an operator sent a reception report."""
        operator = self._operator(name, t)
        operator.runs = {each: at for each, at in operator.runs.items() if t - at < PRESENT_S} | {run: t}

    def stays(self, name: str, t: float, ended: int | None, will: bool) -> str | None:
        """Why an operator stays although a goodbye of it has arrived; None: it goes.

        ended  the process that the goodbye is of; None: not stated. Another one may still send reports
        will   whether the broker sent it, of a connection that broke or that a new one of this operator has replaced
        """
        operator = self._known.get(name)
        runs = operator.runs if operator and ended is not None else {}
        if any(t - at < PRESENT_S for run, at in runs.items() if run != ended):
            return "another process of this operator goes on"
        return "a connection broke: silence shows whether the operator has gone" if will else None

    def may_ask_clock(self, name: str, t: float) -> bool:
        """Whether to answer an operator that compares clocks: answers to a flood would fill the uplink."""
        operator = self._operator(name, t)
        if t - operator.clock_asked < CLOCK_S:
            return False
        operator.clock_asked = t
        return True

    def _operator(self, name: str, t: float) -> _Operator:
        if name not in self._known:
            if len(self._known) >= MAX_OPERATORS:
                del self._known[min(self._known, key=lambda n: (self._known[n].present, self._known[n].last_message))]
            self._known[name] = _Operator(last_message=t)
        return self._known[name]
