"""What the kernel knows about the error of its clock."""

from __future__ import annotations

import ctypes
import sys

TIME_ERROR = 5  # state of a clock that is not synchronised (adjtimex(2))
MICRO = 1e-6


class _Timex(ctypes.Structure):
    """struct timex of adjtimex(2), as far as it is read; the rest as reserve."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("freq", ctypes.c_long),
        ("maxerror", ctypes.c_long),
        ("esterror", ctypes.c_long),
        ("status", ctypes.c_int),
        ("reserve", ctypes.c_long * 32),
    )


def clock_error_s() -> float | None:
    """By how much CLOCK_REALTIME may differ from UTC, s, by the kernel's own account; None if it is not synchronised.

    NTP and PTP daemons state it by ntp_adjtime; the kernel lets it grow until their next update (RFC 1589).
    """
    if not sys.platform.startswith("linux"):
        return None
    timex = _Timex()
    state = ctypes.CDLL(None).adjtimex(ctypes.byref(timex))
    return timex.maxerror * MICRO if 0 <= state < TIME_ERROR else None
