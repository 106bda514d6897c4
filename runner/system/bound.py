"""usage: python -I -S bound.py PARENT COMMAND [WORD ...]

Runs a command that the kernel kills when the process PARENT ends for any reason (prctl(2), PR_SET_PDEATHSIG).
The thread that started this must stay alive: the kernel tracks threads, not processes.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys

PR_SET_PDEATHSIG = 1  # linux/prctl.h


def die_with(parent: int) -> None:
    """Have this process killed when its parent ends; immediately if it has already ended."""
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:  # it ended before prctl took effect
        os.kill(os.getpid(), signal.SIGKILL)


if __name__ == "__main__":
    die_with(int(sys.argv[1]))
    os.execvp(sys.argv[2], sys.argv[2:])
