"""From when until when certificates are valid, and what to say about it. Pure: the time is passed in."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import NamedTuple

DAY_S = 86_400.0
EXPIRING_S = 30 * DAY_S  # how long before its end a certificate is mentioned


class Validity(NamedTuple):
    """First and last moment, s since 1970."""

    begins: float
    ends: float


def invalid(validity: Validity, now: float) -> str | None:
    """Why a certificate does not count at a time; None if it does."""
    if now >= validity.ends:
        return f"expired on {date(validity.ends)}"
    if now < validity.begins:
        return f"is valid from {date(validity.begins)} on, but it is {date(now)} by this machine's clock"
    return None


def expiring(ends: Mapping[str, float], now: float) -> list[str]:
    """A sentence about each certificate that has expired, or will within EXPIRING_S.

    ends  by whose certificate it is, such as "own", its last moment, s since 1970
    """
    return [
        f"{whose} certificate expired on {date(at)}"
        if now >= at
        else f"{whose} certificate expires on {date(at)}, in {(at - now) / DAY_S:.0f} days"
        for whose, at in ends.items()
        if at - now < EXPIRING_S
    ]


def date(at: float) -> str:
    """A day in UTC."""
    return time.strftime("%Y-%m-%d", time.gmtime(at))
