"""Short histories: entries of (time, value), the oldest first. Pure."""

from __future__ import annotations

from typing import TypeVar

T = TypeVar("T")
History = tuple[tuple[float, T], ...]


def recorded(history: History[T], t: float, value: T, kept_s: float) -> History[T]:
    """With the value from t on, and without what was in force only longer ago than `kept_s`."""
    newest_old = (i for i in range(len(history) - 1, -1, -1) if history[i][0] <= t - kept_s)
    return (*history[next(newest_old, 0) :], (t, value))


def rate(history: History[float], t: float, within_s: float) -> float:
    """Sum per second of the values of the last seconds, each of the time before it; 0: too few are known."""
    recent = [(at, value) for at, value in history if at >= t - within_s]
    return sum(value for _, value in recent[1:]) / (t - recent[0][0]) if recent and t > recent[0][0] else 0.0


def value_at(history: History[T], t: float) -> T | None:
    """The value in force at t; None: unknown."""
    return next((value for at, value in reversed(history) if at <= t), None)
