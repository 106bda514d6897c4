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

FAMILIES = ("gauss_0.2_5", "gauss_0.5_5", "gauss_0.5_1", "gauss_0.3_0.3", "markov", "step", "ramp", "outage", "saw")

# Repeated functions of time, s, in kbit/s.
_SHAPES: dict[str, Callable[[float], float]] = {
    "step": lambda t: 4000.0 if int(t / 10) % 2 == 0 else 2000.0,
    "ramp": lambda t: 5000 - 4000 * abs((t % 20) / 10 - 1),
    "outage": lambda t: 0.0 if t % 12 > 10.5 else 4000.0,
    "saw": lambda t: 2000 + 4000 * ((t % 4) / 4),
}


def is_family(name: str) -> bool:
    return name in ("markov", *_SHAPES) or bool(GAUSS.fullmatch(name))


def generate(name: str, seed: int, duration_s: float) -> Steps:
    """A link of a family.

    name  gauss_DEVIATION_SECONDS: the logarithm is a Gauss-Markov process with this standard deviation and correlation
          time; markov: levels of 600 to 9000 kbit/s, each for 2 s on average; step, ramp, outage, saw: the same for
          every seed
    """
    times = [STEP_S * step for step in range(int(duration_s / STEP_S))]
    rng = random.Random(seed)
    if name in _SHAPES:
        return Steps(times, [_SHAPES[name](t) for t in times])
    if name == "markov":
        return Steps(times, _levels(rng, len(times)))
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
