"""Links that are generated: kbit/s over time, the same for the same name and seed. Pure."""

from __future__ import annotations

import math
import random
import re
from collections.abc import Callable

from runner.simulation.steps import Steps

STEP_S = 0.1
KBPS = 4000.0  # around which all vary
LEVELS_KBPS = (600.0, 1500.0, 3000.0, 6000.0, 9000.0)
LEVEL_S = 2.0  # mean time at a level
GAUSS = re.compile(r"gauss_(\d+(?:\.\d+)?)_(\d+(?:\.\d+)?)")

CELLS_DEVIATION, CELL_S, HANDOVER_S = 0.5, 10.0, (0.1, 0.5)  # ln, between cells; mean time in one; interruption
FADING = (0.1, 1.0)  # deviation and correlation time within a cell
SHARED_KBPS, OTHERS, OTHER_S = 12000.0, 2.0, 3.0  # of a cell that others use too: their mean number, and stay

FAMILIES = ("gauss_0.2_5", "gauss_0.5_5", "gauss_0.5_1", "gauss_0.3_0.3", "markov", "step", "ramp", "outage", "saw")
# No number of any rule is chosen by what it does on these links, with any seed from this one on.
LEFT_OUT, LEFT_OUT_SEED = ("handover", "shared"), 100

# Repeated functions of time, s, in kbit/s.
_SHAPES: dict[str, Callable[[float], float]] = {
    "step": lambda t: 4000.0 if int(t / 10) % 2 == 0 else 2000.0,
    "ramp": lambda t: 5000 - 4000 * abs((t % 20) / 10 - 1),
    "outage": lambda t: 0.0 if t % 12 > 10.5 else 4000.0,
    "saw": lambda t: 2000 + 4000 * ((t % 4) / 4),
}


def is_family(name: str) -> bool:
    return name in (*_DRAWN, *_SHAPES) or bool(GAUSS.fullmatch(name))


def generate(name: str, seed: int, duration_s: float) -> Steps:
    """A link of a family.

    name  gauss_DEVIATION_SECONDS: the logarithm is a Gauss-Markov process with this standard deviation and correlation
          time; markov: levels of 600 to 9000 kbit/s, each for 2 s on average; handover: from cell to cell, with
          interruptions; shared: a fair share of a cell in which others come and go; step, ramp, outage, saw: the same
          for every seed
    """
    times = [STEP_S * step for step in range(int(duration_s / STEP_S))]
    rng = random.Random(seed)
    if name in _SHAPES:
        return Steps(times, [_SHAPES[name](t) for t in times])
    if name in _DRAWN:
        return Steps(times, _DRAWN[name](rng, len(times)))
    found = GAUSS.fullmatch(name)
    assert found, name
    return Steps(times, _gauss_markov(rng, len(times), float(found[1]), float(found[2])))


def _gauss_markov(rng: random.Random, count: int, deviation: float, seconds: float) -> list[float]:
    keep = math.exp(-STEP_S / seconds)
    x, values = rng.gauss(0, deviation), []
    for _ in range(count):
        values.append(KBPS * math.exp(x))
        x = keep * x + rng.gauss(0, deviation * math.sqrt(1 - keep * keep))
    return values


def _levels(rng: random.Random, count: int) -> list[float]:
    at, values = 2, []
    for _ in range(count):
        if rng.random() < STEP_S / LEVEL_S:
            at = max(0, min(len(LEVELS_KBPS) - 1, at + rng.choice([-2, -1, 1, 2])))
        values.append(LEVELS_KBPS[at])
    return values


def _handovers(rng: random.Random, count: int) -> list[float]:
    values: list[float] = []
    while len(values) < count:
        level = math.exp(rng.gauss(0, CELLS_DEVIATION))
        steps = max(1, round(rng.expovariate(1 / CELL_S) / STEP_S))
        values += [level * kbps for kbps in _gauss_markov(rng, steps, *FADING)]
        values += [0.0] * round(rng.uniform(*HANDOVER_S) / STEP_S)
    return values[:count]


def _shares(rng: random.Random, count: int) -> list[float]:
    leave = STEP_S / OTHER_S
    others, values = round(OTHERS), []
    for _ in range(count):
        values.append(SHARED_KBPS / (1 + others))
        others += (rng.random() < leave * OTHERS) - sum(rng.random() < leave for _ in range(others))
    return values


_DRAWN: dict[str, Callable[[random.Random, int], list[float]]] = {
    "markov": _levels,
    "handover": _handovers,
    "shared": _shares,
}
