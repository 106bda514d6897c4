"""Random sequences of reception reports: the cap stays a finite rate, and returns to the limit once all is well."""

from __future__ import annotations

import math
import random
from concurrent.futures import ProcessPoolExecutor
from fractions import Fraction

from runner.core.events import LinkMeasured, PositionReported
from runner.core.link_cap import LEAST, REPORT_S, LinkCap, believed_limit, update_cap
from runner.core.model import exact
from runner.core.uplink import LinkReport, ReceivedUnit, UplinkMemory, estimate

SEQUENCES, BATCH = 200_000, 500
RECOVERED = 100  # one sequence in this many is followed until the link is clear again
RECOVERY_S = 60.0
CAMERAS = ("front", "left", "right")
PLACES = tuple((48 + north / 2000, 11.5) for north in range(4))  # 56 m apart
LIMIT, LEAST_TRUST = Fraction(4000), Fraction(1, 2)


def soak(seed: int, scale: float) -> list[str]:
    count = max(BATCH, round(SEQUENCES * scale))
    batches = [seed * SEQUENCES + first for first in range(0, count, BATCH)]
    with ProcessPoolExecutor() as pool:
        problems = [problem for found in pool.map(_batch, batches) for problem in found]
    print(f"{len(batches) * BATCH} sequences of reports", flush=True)
    return problems


def _batch(first: int) -> list[str]:
    return [f"seed {seed}: {what}" for seed in range(first, first + BATCH) if (what := sequence(seed))]


def sequence(seed: int) -> str:
    """One random sequence; returns the problem, "" if there is none."""
    rng = random.Random(seed)
    uplink, cap, t, at = UplinkMemory(), LinkCap(), 0.0, rng.uniform(-1e6, 1e6)
    for _ in range(rng.randrange(1, 40)):
        passed = rng.choice((REPORT_S, REPORT_S, rng.expovariate(5), 0.0))
        t, at = t + passed, at + passed
        if rng.random() < 0.02:  # another operator, with another clock
            uplink, at = UplinkMemory(), rng.uniform(-1e6, 1e6)
        uplink, cap, problem = _step(uplink, cap, t, _report(rng, at), rng.choice(PLACES))
        if problem:
            return problem
    until = t + (0 if seed % RECOVERED else RECOVERY_S)
    while t < until and (cap.kbps is not None or cap.trust.share < 1):
        t, at = t + REPORT_S, at + REPORT_S
        size = int(float(min(LIMIT, cap.kbps or LIMIT)) * REPORT_S * 125 / len(CAMERAS))
        units = tuple(ReceivedUnit(name, at - 0.03, at - 0.01, size) for name in CAMERAS)
        uplink, cap, problem = _step(uplink, cap, t, LinkReport(at, units, 9, 0), PLACES[0])
        if problem:
            return problem
    return f"not recovered within {RECOVERY_S:g} s: {cap}" if seed % RECOVERED == 0 and t >= until else ""


def _report(rng: random.Random, at: float) -> LinkReport:
    units = sorted(
        (at - rng.expovariate(20), rng.choice(CAMERAS), rng.uniform(-10, 10) ** rng.choice((1, 3)))
        for _ in range(rng.choice((0, 1, 3, 8)))
    )
    return LinkReport(
        at,
        tuple(
            ReceivedUnit(name, arrived - delay, arrived, rng.randrange(10**5), rng.random() < 0.8)
            for arrived, name, delay in units
        ),
        rng.randrange(100),
        rng.choice((0, 0, 1, 100)),
    )


def _step(
    uplink: UplinkMemory, cap: LinkCap, t: float, report: LinkReport, place: tuple[float, float]
) -> tuple[UplinkMemory, LinkCap, str]:
    """The next estimate and cap, and a problem with them."""
    uplink, link = estimate(uplink, report)
    if link is None:
        return uplink, cap, ""
    known = [value for value in (link.kbps, link.queue_ms, link.loss) if value is not None]
    if not all(math.isfinite(value) and value >= 0 for value in known) or link.loss > 1:
        return uplink, cap, f"estimate {link}"
    kbps = None if link.kbps is None else exact(round(link.kbps, 1))
    measured = LinkMeasured(t=t, kbps=kbps, queue_ms=link.queue_ms, loss=link.loss, state=link.state, rtt_ms=30.0)
    position = PositionReported(t=t, lat=place[0], lon=place[1])
    cap = update_cap(cap, measured, t, LIMIT, LEAST_TRUST, position)
    total = min(believed_limit(cap, LIMIT, LEAST_TRUST), cap.kbps or LIMIT)
    if not LEAST <= total <= LIMIT or (cap.kbps is not None and cap.kbps < LEAST):
        return uplink, cap, f"total {float(total)} under {cap}"
    return uplink, cap, ""
