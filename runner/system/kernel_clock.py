"""How far the wall clock is ahead of another clock, and the error that the kernel states for it."""

from __future__ import annotations

import ctypes
import sys
import time
from collections.abc import Callable

from runner.system.memory import libc

TIME_ERROR = 5  # state of a clock that is not synchronised (adjtimex(2))
STA_NANO = 0x2000  # the offset is in ns, otherwise in us
MICRO, NANO = 1e-6, 1e-9
CLOSE_NS = 20_000  # clocks read within this time count as read simultaneously
TRIES = 10


class _Timex(ctypes.Structure):
    """struct timex of adjtimex(2), as far as it is used; the rest is reserved."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("freq", ctypes.c_long),
        ("maxerror", ctypes.c_long),
        ("esterror", ctypes.c_long),
        ("status", ctypes.c_int),
        ("reserve", ctypes.c_long * 32),
    )


def ahead_of(read: Callable[[], int], own: Callable[[], int] = time.time_ns) -> int:
    """By how much the wall clock is ahead of another, ns.

    Another thread may run between the two readings. So the wall clock is read before and after the other one, several
    times if that took too long, and the closest reading counts.

    read  reads the other clock, ns
    own   reads a clock that replaces the wall clock
    """
    readings: list[tuple[int, int]] = []  # duration of the reading, ns; difference at its middle
    while len(readings) < TRIES and min(readings, default=(CLOSE_NS + 1, 0))[0] > CLOSE_NS:
        before, other, after = own(), read(), own()
        readings.append((after - before, (before + after) // 2 - other))
    return min(readings)[1]


def wall_ahead_s(clock: int = time.CLOCK_MONOTONIC) -> float:
    """By how much the wall clock is ahead of one that is never set, s: this changes when the wall clock is set.

    clock  CLOCK_BOOTTIME also runs while the machine is suspended
    """
    return NANO * ahead_of(lambda: time.clock_gettime_ns(clock))


def clock_error_s() -> float | None:
    """By how much CLOCK_REALTIME may differ from UTC, s, as stated by the kernel; None if it is not synchronised.

    NTP and PTP daemons set it with ntp_adjtime; the kernel lets it grow until their next update (RFC 1589). The offset
    still to be slewed is added. systemd-timesyncd states 0 for all errors, which is not trusted.
    """
    if not sys.platform.startswith("linux"):
        return None
    timex = _Timex()
    state = libc().adjtimex(ctypes.byref(timex))
    if not 0 <= state < TIME_ERROR or timex.esterror <= 0:
        return None
    return float(timex.maxerror * MICRO + abs(timex.offset) * (NANO if timex.status & STA_NANO else MICRO))
