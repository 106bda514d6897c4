"""Returns the memory of pictures and of ended pipelines to the system. For the GNU C library; no effect with others."""

from __future__ import annotations

import os

from runner.system.memory import libc

PICTURE_BYTES = 256 * 1024  # blocks of this size and more are mapped individually, and unmapped when freed
_M_MMAP_THRESHOLD, _M_ARENA_MAX = -3, -8  # malloc.h


def limit_heaps() -> None:
    """Keep pictures out of the heaps, and limit the number of heaps to that of processors, see mallopt(3).

    Heaps shrink only from their ends, or page by page. By default the library has eight per processor, all of which
    pipeline threads use, and it raises the size from which it maps blocks to the largest ever freed, up to 32 MB.
    Pools and encoders allocate their pictures once, so this costs no time while streaming.
    """
    mallopt = getattr(libc(), "mallopt", None)
    if mallopt:
        mallopt(_M_MMAP_THRESHOLD, PICTURE_BYTES)
        mallopt(_M_ARENA_MAX, max(2, os.cpu_count() or 1))


def give_back() -> None:
    """Return freed memory to the system; takes a few ms, see malloc_trim(3)."""
    trim = getattr(libc(), "malloc_trim", None)
    if trim:
        trim(0)
