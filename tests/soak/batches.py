"""Many random cases on all cores."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import partial


def problems(check: Callable[[int], str], name: str, seed: int, most: int, scale: float, batch: int) -> list[str]:
    """The problems of many cases.

    check  a function of a module: a case by its seed; returns the problem, "" if there is none
    name   of the cases, to print how many there were
    most   cases at scale 1; their seeds begin at `seed` times this
    batch  cases that a process checks at a time, and the least number
    """
    firsts = [seed * most + first for first in range(0, max(batch, round(most * scale)), batch)]
    with ProcessPoolExecutor() as pool:
        found = [problem for of_batch in pool.map(partial(_batch, check, batch), firsts) for problem in of_batch]
    print(f"{len(firsts) * batch} {name}", flush=True)
    return found


def _batch(check: Callable[[int], str], size: int, first: int) -> list[str]:
    return [f"seed {seed}: {what}" for seed in range(first, first + size) if (what := check(seed))]
