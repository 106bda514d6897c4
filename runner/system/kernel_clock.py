"""What the kernel knows about the error of its clock."""

from __future__ import annotations

import ctypes
import sys

TIME_ERROR = 5  # state of a clock that is not synchronised (adjtimex(2))
STA_NANO = 0x2000  # the offset is in ns, otherwise in us
MICRO, NANO = 1e-6, 1e-9


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

    NTP and PTP daemons state it by ntp_adjtime; the kernel lets it grow until their next update (RFC 1589). What is
    still to be slewed comes on top. systemd-timesyncd states 0 for all errors: it is not believed.
    """
    if not sys.platform.startswith("linux"):
        return None
    timex = _Timex()
    state = ctypes.CDLL(None).adjtimex(ctypes.byref(timex))
    if not 0 <= state < TIME_ERROR or timex.esterror <= 0:
        return None
    return float(timex.maxerror * MICRO + abs(timex.offset) * (NANO if timex.status & STA_NANO else MICRO))
