"""Memory of pictures and of ended pipelines goes back to the system. For the GNU C library; others keep their ways."""

from __future__ import annotations

import ctypes

PICTURE_BYTES = 256 * 1024  # blocks of this size and more are mapped one by one, and unmapped when they are freed
_M_MMAP_THRESHOLD = -3  # malloc.h


def map_pictures() -> None:
    """Keep pictures out of the heaps of threads, which shrink only from their ends, see mallopt(3).

    By default the library raises the threshold to the largest block ever freed, up to 32 MB; what lies above a freed
    picture in its heap then keeps it there. Pools and encoders allocate their pictures once, so this costs no time
    while streaming.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt:
        mallopt(_M_MMAP_THRESHOLD, PICTURE_BYTES)


def give_back() -> None:
    """Return freed memory to the system; takes a few ms, see malloc_trim(3).

    The library keeps up to eight heaps for each core; the threads of a pipeline free memory in whichever they got it.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim:
        trim(0)
