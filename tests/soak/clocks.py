"""Ten minutes with one clock 50 ppm too fast: the measured difference of the clocks stays right."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import keyed
from rig import ROBOT, clock_ahead, free_port, run
from runner.drive.read import read_drive
from runner.records.operator import Sample

SECONDS, AHEAD_S, FAST_PPM = 600, 3.7, 50
SETTLED_S = 10.0  # before, a few exchanges between sides that are still starting leave a wider bound
MOST_ERROR_MS, SHARE = 1.0, 0.99


def soak(seed: int, scale: float) -> list[str]:
    seconds = max(20, round(SECONDS * scale))
    with tempfile.TemporaryDirectory() as directory:
        began = time.monotonic()
        environment = clock_ahead(Path(directory), AHEAD_S, fast_ppm=FAST_PPM)
        path = Path(directory) / "drive"
        words = (
            f"media.port={free_port()}",
            f"control.port={free_port()}",
            f"duration_s={seconds}",
            f"log={path}",
            *keyed.words(),
        )
        done = run("demo", *ROBOT, *words, env=environment, timeout=seconds + 120)
        if done.returncode:
            return [done.stdout + done.stderr]
        operator = read_drive(path).sides["operator"]
    # The operator's clock is this process's own.
    started = operator.began.time - time.time() + time.monotonic() - began
    samples = [sample for sample in operator.of(Sample) if sample.clock_bound_ms is not None]
    if not samples:
        return ["the clocks were never compared"]
    truth = [1000 * AHEAD_S + FAST_PPM / 1000 * (started + sample.t) for sample in samples]
    errors = [abs(sample.clock_ahead_ms - true) for sample, true in zip(samples, truth, strict=True)]
    bounds = [sample.clock_bound_ms for sample in samples]
    within = sum(error <= bound + 0.01 for error, bound in zip(errors, bounds, strict=True)) / len(samples)
    settled = max(error for error, sample in zip(errors, samples, strict=True) if sample.t >= SETTLED_S)
    print(
        f"{len(samples)} samples over {seconds} s, drift {truth[-1] - truth[0]:.1f} ms: within the bound {within:.1%}, "
        f"wrong by at most {max(errors):.3f} ms, after {SETTLED_S:g} s by {settled:.3f} ms; "
        f"bound at most {max(bounds):.3f} ms",
        flush=True,
    )
    problems = [f"only {within:.1%} within the bound"] if within < SHARE else []
    return problems + ([f"wrong by {settled:.3f} ms"] if settled >= MOST_ERROR_MS else [])
