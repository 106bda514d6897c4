"""What to measure and how, valid once built."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise
from math import gcd
from pathlib import Path
from typing import Any

from runner.core.model import SMALLEST_SIDE_PX, Camera, ModelError, exact, plain
from runner.errors import suggest

FEWEST_SCORED = 40  # frames; a mean over fewer does not carry over to other sequences


@dataclass(frozen=True, slots=True)
class Study:
    """How rate-quality models are measured; see conf/study/paper.yaml for each key."""

    scalings: tuple[Fraction, ...]
    rates: tuple[int, ...]
    metrics: tuple[str, ...]
    plan: str
    metric_every: int
    tolerance: float | None
    narrowest: float
    b_full_quality: float | None
    cpu_cores: float | None
    screens: tuple[Fraction, ...]
    fps: tuple[Fraction, ...]
    pool: Mapping[str, tuple[str, ...]]
    masks: Mapping[str, Path]
    vmaf_model: str
    brisque_model: Path | None
    brisque_range: Path | None
    workers: str
    scheduler: str | None
    parallel: int | None

    def __post_init__(self) -> None:
        scalings = [plain(factor) for factor in self.scalings]
        if any(a >= b for a, b in pairwise(scalings)):
            raise ModelError("scalings", scalings, "must be strictly increasing")
        if any(a >= b for a, b in pairwise(self.rates)):
            raise ModelError("bitrates_kbps", list(self.rates), "must be strictly increasing")
        if self.scheduler and self.workers != "dask":
            raise ModelError("scheduler", repr(self.scheduler), "requires workers=dask", "workers")


def read_study(data: Mapping[str, Any]) -> Study:
    """A study from data that its schema has accepted.

    raises  ModelError
    """
    metric, brisque = data["metric"], data["brisque"]
    return Study(
        scalings=tuple(map(exact, data["scalings"])),
        rates=tuple(data["bitrates_kbps"]),
        metrics=tuple(metric) if isinstance(metric, list) else (metric,),
        plan=data["plan"],
        metric_every=data["metric_every"],
        tolerance=data["tolerance"],
        narrowest=data["narrowest"],
        b_full_quality=data["b_full_quality"],
        cpu_cores=data["cpu_cores"],
        screens=tuple(map(exact, data.get("screens", ()))),  # missing in older logs
        fps=tuple(map(exact, data.get("fps", ()))),  # likewise
        pool={name: tuple(members) for name, members in data["pool"].items()},
        masks={name: Path(path) for name, path in data["masks"].items()},
        vmaf_model=data["vmaf_model"],
        brisque_model=_path(brisque["model"]),
        brisque_range=_path(brisque["range"]),
        workers=data["workers"],
        scheduler=data["scheduler"],
        parallel=data["parallel"],
    )


def check_cameras(study: Study, cameras: Sequence[str]) -> None:
    """Check that all cameras that a study names are measured.

    raises  ModelError
    """
    named = [(f"pool.{key}", name) for key, members in study.pool.items() for name in members]
    named += [("masks", name) for name in study.masks]
    for key, name in named:
        if name not in cameras:
            raise ModelError(key, repr(name), f"no such camera is measured{suggest(name, cameras)}")
    members = [name for _, name in named[: len(named) - len(study.masks)]]
    for name in members:
        if members.count(name) > 1:
            raise ModelError("pool", repr(name), "is in the pool twice")


def check_size(study: Study, camera: Camera) -> None:
    """Check that every factor leaves a picture that can be encoded.

    raises  ModelError
    """
    side = min(camera.width, camera.height)
    for factor in study.scalings:
        if side * factor < SMALLEST_SIDE_PX:
            found, least = f"{plain(factor)} of {camera.width}x{camera.height}", SMALLEST_SIDE_PX / side
            rule = f"a side would be under {SMALLEST_SIDE_PX} px, the factor must be at least {least:.3g}"
            raise ModelError("scalings", found, rule)


def stride(study: Study, frames: int, key_interval: int) -> int:
    """Sampling interval of the metric, in frames.

    frames        of the sequence
    key_interval  frames of a refresh wave, with which the samples must not be in phase; 0: unknown

    In short sequences fewer frames are skipped, so that at least 40 are scored if possible.
    """
    if study.plan == "full":
        return 1
    longest = max(1, min(study.metric_every, frames // FEWEST_SCORED))
    return next(step for step in range(longest, 0, -1) if gcd(step, key_interval or 1) == 1)


def _path(text: str | None) -> Path | None:
    return None if text is None else Path(text)
