"""Numerical loops as machine code."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

from numba import njit

F = TypeVar("F", bound=Callable[..., Any])


def compiled(function: F) -> F:
    """Compile with numba; the code is cached on disk for the next run and does not block other threads."""
    return cast(F, njit(cache=True, fastmath=True, nogil=True)(function))
