"""Memory of a process that runs for weeks."""

from __future__ import annotations

import ctypes
import gc
from functools import cache

NEW_OBJECTS = 700  # until the youngest are looked through: Python's own number until 3.12; a start has a larger one


@cache
def libc() -> ctypes.CDLL:
    """The C library of this process. Cached, since each CDLL defines types, which only the cyclic collector frees."""
    return ctypes.CDLL(None)


def freeze_loaded() -> None:
    """Exempt all objects loaded so far from Python's cyclic collector: rescanning them would delay frames.

    A full collection is due when the objects that are new amount to a quarter of those that the last one kept. So the
    later ones are early and short, and return what accumulates meanwhile, such as CPython's lists of free tuples.
    """
    gc.set_threshold(NEW_OBJECTS)
    gc.freeze()
    gc.collect()  # keeps none
