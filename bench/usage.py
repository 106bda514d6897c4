"""Processor time and memory of a process, from proc(5)."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path


def processor_s(pid: int) -> float:
    """Processor time that a process has used so far, s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def processor_of_tree_s(pid: int) -> float:
    """Processor time that a process and its descendants that still run have used so far, s."""
    return sum(processor_s(each) for each in (pid, *descendants(pid)))


def descendants(pid: int) -> Iterator[int]:
    """Processes that a process has started, directly or through others, and that still run."""
    for task in Path(f"/proc/{pid}/task").iterdir():
        with suppress(FileNotFoundError):  # the thread has ended
            for child in map(int, (task / "children").read_text().split()):
                yield child
                yield from descendants(child)


def memory_mb(pid: int) -> float:
    """Resident memory of a process, MB."""
    status = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines())
    return float(status["VmRSS"].split()[0]) / 1024
