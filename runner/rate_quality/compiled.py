"""Numerical loops as machine code."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

from numba import njit

F = TypeVar("F", bound=Callable[..., Any])


def compiled(function: F) -> F:
    """Compile with numba; the code is kept on disk for the next run and leaves other threads running."""
    return cast(F, njit(cache=True, fastmath=True, nogil=True)(function))
