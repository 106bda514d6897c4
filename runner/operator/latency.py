"""The latency of the cameras' pictures at the operator: table, page, log, reception report and metrics ask here.

raw        time of arrival or decoding by this machine's clock minus that of capture by the vehicle's
corrected  by the difference of the clocks, within its bound
confirmed  corrected, and a later exchange of messages shows that no clock was set meanwhile
worst      upper bound of what is displayed now
by stage   its parts
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

from msgspec import UNSET

from runner.mqtt.messages import MqttMessage, read_clock
from runner.records.operator import LatencyStages
from runner.records.reception import Arrival
from runner.records.vehicle import CameraState, CameraTelemetry
from runner.system.clocks import KEPT_S, MOST_DRIFT, STEP_S, ClockComparison, ClockDifference, Exchange
from runner.system.kernel_clock import clock_error_s, wall_ahead_s
from runner.system.recent import CURRENT_S

if TYPE_CHECKING:
    from runner.apply import Reception

CLOCK_S = 0.2  # between two comparisons of the clocks
READINGS = 8  # latencies of a camera that may still be confirmed
LONGEST_MS = 60_000.0  # of a frame that arrives: beyond, a clock was set in between


class Latency:
    """Compares the vehicle's clock with this machine's, and corrects latencies by it. May be used from any thread.

    fps      of each camera, where the vehicle states no other
    cameras  returns what the vehicle states of them; nothing while it is offline
    """

    def __init__(self, fps: Mapping[str, float], cameras: Callable[[], Mapping[str, CameraState]]) -> None:
        self._fps, self._cameras = fps, cameras
        self.clock: ClockDifference | None = None  # the vehicle's against this machine's; None: unknown
        self._lock = threading.Lock()  # of the comparison
        self._clocks = ClockComparison()
        self._questions: deque[float] = deque(maxlen=round(KEPT_S / CLOCK_S))  # unanswered
        self._question_due = 0.0  # time.monotonic
        self._wall_ahead_s = 0.0  # of the monotonic clock, at the newest exchange
        self._set_back = float("-inf")  # when a capture time went backwards: the vehicle's clock was set
        # By camera, time and value of raw latencies, which may still be confirmed.
        self._readings: dict[str, deque[tuple[float, float]]] = {name: deque(maxlen=READINGS) for name in fps}
        self._decoded: Mapping[str, Reception] = {}
        self._sampled = 0.0  # time.monotonic of `_decoded`
        self._newest: Mapping[str, Arrival] = {}  # by camera

    # --- the clocks ---------------------------------------------------------------------------------------------------

    def ask_clock(self, now: float) -> float | None:
        """This machine's time, s since 1970, if the vehicle should answer it with its own now; None: not yet."""
        if now < self._question_due:
            return None
        self._question_due, sent = now + CLOCK_S, time.time()
        with self._lock:
            self._questions.append(sent)
        return sent

    def on_clock(self, message: MqttMessage) -> None:
        """The vehicle's answer."""
        returned, now, answer = time.time(), time.monotonic(), read_clock(message.payload)
        own_set_s = wall_ahead_s()
        own_s = clock_error_s()
        errors_s = None if own_s is None or answer.error_s is None else own_s + answer.error_s
        set_s = (own_set_s, answer.set_s)
        with self._lock:
            if not message.retained and answer.sent in self._questions:
                self._questions.remove(answer.sent)
                exchange = Exchange(answer.sent, answer.received, answer.answered, returned, set_s, errors_s)
                self._clocks.add(now, exchange)
                self._wall_ahead_s = own_set_s

    def compare_clocks(self, now: float) -> str | None:
        """Update the difference; returns why it is no longer known, once."""
        with self._lock:
            before, self.clock = self.clock, self._clocks.difference(now)
        if self.clock or before is None:
            return None
        return (
            "a clock was stepped" if self._clocks.was_set else f"the vehicle has not stated its clock for {KEPT_S:g} s"
        )

    def own_time(self, at: float) -> float | None:
        """Convert a past time, s since 1970, from the vehicle's clock to this machine's; None: unknown."""
        clock = self.clock  # another thread may replace it
        if clock is None or self._was_set():
            return None
        here = at - clock.ahead_s
        return here if here <= time.time() + clock.bound_s else None  # in the future: a clock was set

    def _was_set(self) -> bool:
        """Whether this machine's clock was set, or the vehicle's was set back, and no exchange has followed."""
        set_back = self._clocks.last_sent < self._set_back and self._set_back > time.monotonic() - CURRENT_S
        return set_back or abs(wall_ahead_s() - self._wall_ahead_s) > STEP_S + MOST_DRIFT * KEPT_S

    # --- pictures -----------------------------------------------------------------------------------------------------

    def untimed(self, name: str) -> bool:
        """Whether the vehicle does not know when a camera's pictures are captured."""
        camera = self._cameras().get(name)
        return camera is not None and camera.untimed is True

    def captured(self, name: str, at: float | None) -> float | None:
        """A camera's capture time by this machine's clock, s since 1970; None: unknown.

        at  the same by the vehicle's
        """
        return None if at is None or self.untimed(name) else self.own_time(at)

    def to_arrival_ms(self, name: str, arrived: float, captured: float | None) -> float | None:
        """Corrected latency of a unit to its arrival; None: unknown. Both times in s since 1970, each by its clock.

        May be negative within the bound, so that a reader of the log can recover the capture time.
        """
        clock = self.clock
        if captured is None or clock is None or self.untimed(name):
            return None
        raw_ms = 1000 * (arrived - captured)
        found_ms = raw_ms + 1000 * clock.ahead_s
        return found_ms if corrected(raw_ms, clock) is not None and found_ms < LONGEST_MS else None

    def confirm(self, samples: Mapping[str, Reception], now: float) -> dict[str, Reception]:
        """Counters with the confirmed latency in place of the raw one; None if that is unknown."""
        counters = {name: replace(raw, latency_ms=self._confirmed(name, raw, now)) for name, raw in samples.items()}
        self._decoded, self._sampled = counters, now
        return counters

    def _confirmed(self, name: str, raw: Reception, now: float) -> float | None:
        readings, at, raw_ms = self._readings[name], raw.latency_at, raw.latency_ms
        if at is not None and raw_ms is not None and (not readings or readings[-1][0] != at):
            readings.append((at, raw_ms))
        return None if self.untimed(name) else self._newest_confirmed(readings, now)

    def _newest_confirmed(self, readings: Iterable[tuple[float, float]], now: float) -> float | None:
        """The newest confirmed one; without the control link, which reveals that clocks were set, the newest."""
        silent = now - self._clocks.last_sent > CURRENT_S
        recent = [(at, raw_ms) for at, raw_ms in readings if now - at <= CURRENT_S]
        for at, raw_ms in reversed(recent):
            latency_ms = corrected(raw_ms, self.clock)
            if latency_ms is not None and (silent or self._clocks.held(at - latency_ms / 1000, at)):
                return latency_ms
        return None

    def add_newest(self, newest: Mapping[str, Arrival], now: float) -> None:
        """The newest frame of each camera. Shows that the vehicle's clock was set back, before the next exchange."""
        before, self._newest = self._newest, newest
        if any(name in before and arrival.captured < before[name].captured for name, arrival in newest.items()):
            self._set_back = now

    def worst_ms(self, now: float) -> float | None:
        """Upper bound of the latency of the slowest displayed picture, ms; None: unknown, or nothing is displayed.

        Unknown if any source has a fault. For each camera it is the greater of the newest access unit's latency to
        arrival and the last sampled one's to decoding, plus the time by which the next one is overdue.
        """
        clock, found = self.clock, []
        if self._was_set():
            return None
        wall = time.time() - now  # of the monotonic clock
        for name, camera in self._cameras().items():
            if not camera.sending or name not in self._fps:
                continue
            if camera.fault or self.untimed(name):  # it may repeat a picture, whose age is unknown
                return None
            sampled, newest = self._decoded.get(name), self._newest.get(name)
            if not clock or not newest or not sampled or sampled.latency_ms is None or now - self._sampled > CURRENT_S:
                return None
            arrived_ms = corrected(1000 * (wall + newest.arrived - newest.captured), clock)
            if arrived_ms is None or self._clocks.was_set_since(newest.arrived - arrived_ms / 1000):
                return None
            fps = self._fps[name] if camera.fps is UNSET else camera.fps
            overdue_s = max(0.0, now - newest.arrived - 1 / fps)
            found.append(max(sampled.latency_ms, arrived_ms) + 1000 * overdue_s)
        return max(found) + 1000 * clock.bound_s if found and clock else None


def corrected(raw_ms: float | None, clock: ClockDifference | None) -> float | None:
    """A latency, ms, within the error bound of `clock`; None if either is unknown, or they contradict each other."""
    if raw_ms is None or clock is None:
        return None
    found = raw_ms + 1000 * clock.ahead_s
    return max(0.0, found) if found >= -1000 * (clock.bound_s + STEP_S) else None


def stages(received: Reception, measured: CameraTelemetry | None) -> LatencyStages:
    """The parts of a camera's latency: those that each side has measured, and the link as the remainder."""
    capture, encode = (measured.capture_ms, measured.encode_ms) if measured else (None, None)
    buffer, decode, total = received.waited_ms, received.decode_ms, received.latency_ms
    parts = [part for part in (capture, encode, buffer, decode) if part is not None]
    link = total - sum(parts) if total is not None and len(parts) == 4 else None
    if link is not None and link < 0:  # the parts are of other pictures than the latency, by up to a second
        link = None
    return LatencyStages(*(None if ms is None else round(ms, 2) for ms in (capture, encode, link, buffer, decode)))
