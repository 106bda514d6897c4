"""Memory that was freed, and that the C library still holds."""

from __future__ import annotations

import ctypes


def give_back() -> None:
    """Return freed memory to the system; takes a few ms, see malloc_trim(3).

    The GNU C library keeps up to eight arenas for each core, and a pipeline's threads free pictures in whichever they
    were given. Each pipeline that is built anew would leave some MB behind. Other C libraries have no such function.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim:
        trim(0)
