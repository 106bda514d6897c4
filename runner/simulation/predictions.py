"""Predictions of a link's rate that are right or wrong in a named way. Pure."""

from __future__ import annotations

import random
from collections.abc import Callable

from runner.core.model import Kbps, exact
from runner.pqos import LivePqos, Pqos, TimedPqos
from runner.simulation.steps import Steps

PER_VIDEO = 1.1  # kbit/s on the link for one of video: predictions are of video, headers come on top
LEAST_KBPS = 50.0  # of a prediction, also in an outage
DEVIATION = 0.35  # of the logarithm of a noisy prediction, drawn for each second
NOISE_SEED = 6  # added to the seed of a run
STEP_S = 0.1  # between two values
PERIOD_S = 0.5  # after which an unchanged prediction is repeated, as in conf/pqos/trace.yaml

Predict = Callable[[float], float]

_SCALED = {"right": 1.0, "low_30": 0.7, "low_50": 0.5, "high_30": 1.3, "high_50": 1.5}
_MOVED = {"late_1": 1.0, "late_2": 2.0, "early_2": -2.0}
_MIXED = ("right", "low_50", "noise", "high_50", "late_2", "right")  # one after the other
KINDS = (*_SCALED, "noise", *_MOVED, "absent", "mixed")


def prediction(kind: str, capacity: Steps, duration_s: float, seed: int) -> Pqos:
    """A source of predictions of one of KINDS.

    capacity  of the link, kbit/s
    """
    if kind == "absent":
        return LivePqos()
    predict = _predict(kind, capacity, duration_s, seed)
    values: list[Kbps] = []

    def kbps_at(t: float) -> Kbps:
        step = int(t / STEP_S + 1e-6)
        while len(values) <= step:
            values.append(exact(round(predict(len(values) * STEP_S), 1)))
        return values[step]

    return TimedPqos(kbps_at, PERIOD_S)


def _predict(kind: str, capacity: Steps, duration_s: float, seed: int) -> Predict:
    if kind == "mixed":
        parts = [_predict(part, capacity, duration_s, seed) for part in _MIXED]
        return lambda t: parts[min(len(parts) - 1, int(t * len(parts) / duration_s))](t)
    share, late_s = _SCALED.get(kind, 1.0) / PER_VIDEO, _MOVED.get(kind, 0.0)

    def predict(t: float) -> float:
        return max(LEAST_KBPS, share * capacity.at(max(0.0, t - late_s)))

    if kind != "noise":
        return predict
    rng = random.Random(NOISE_SEED + seed)
    errors = [rng.lognormvariate(0, DEVIATION) for _ in range(int(duration_s) + 5)]
    return lambda t: errors[int(t)] * predict(t)
