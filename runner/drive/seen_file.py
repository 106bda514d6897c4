"""The file that `quality DRIVE view=LOG` writes next to a drive's logs: quality of what the driver saw."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np

from runner.errors import UserError
from runner.records import from_json
from runner.schema import read_json

DOCUMENT = "seen.json"

Scores = tuple[float | None, ...]  # at each moment; None: unknown


@dataclass(frozen=True, slots=True)
class Summary:
    """Scores over time: mean, the lowest, and their 5th percentile."""

    mean: float
    worst: float
    p5: float

    @classmethod
    def of(cls, scores: Sequence[float | None]) -> Summary | None:
        """None: nothing is known."""
        known = [score for score in scores if score is not None]
        return cls(fmean(known), min(known), float(np.percentile(known, 5))) if known else None


@dataclass(frozen=True, slots=True)
class Ages:
    """Age of the picture on the screen, while the camera was shown and sent.

    mean_ms, p95_ms  since its capture
    frozen           share of the time in which none came although one was due, as the page judges it
    late             share of the rest in which the picture was too old when it came
    """

    mean_ms: float
    p95_ms: float
    frozen: float
    late: float


@dataclass(frozen=True, slots=True)
class SeenCamera:
    """What the driver saw of one camera.

    t       moments at which it was on the screen, s since the vehicle's side began
    px      of the screen that it covered then
    scores  by metric, at each moment, the picture on the screen against the scene at its capture; 0: nothing was sent
    age     None: it never was on the screen while it was sent
    scene   whether the scene was known; otherwise it is the stream as sent
    """

    t: tuple[float, ...]
    px: tuple[int, ...]
    scores: Mapping[str, Scores]
    age: Ages | None
    scene: bool

    def summary(self, metric: str) -> Summary | None:
        return Summary.of(self.scores.get(metric, ()))


@dataclass(frozen=True, slots=True)
class Optimum:
    """The best that a static allocation reaches by the cameras' own models, in the view that was longest in force.

    kbps     its total: what the drive sent on the mean
    mssim    mean over the screen
    cameras  by camera, MSSIM
    """

    kbps: float
    mssim: float
    cameras: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class SeenDrive:
    """What the driver saw of a drive.

    view     log that states what the screen showed
    metrics  by name, their identities
    kernel   by which pictures were enlarged
    optimum  None: not every camera has a model of its own
    """

    view: str
    metrics: Mapping[str, str]
    cameras: Mapping[str, SeenCamera]
    optimum: Optimum | None = None
    every_s: float = field(default=0.5, kw_only=True)
    kernel: str = field(default="linear", kw_only=True)

    def screen(self, metric: str) -> tuple[tuple[float, ...], Scores]:
        """Moments, and scores of the whole screen: means of all cameras by px, where all of them are known."""
        parts: dict[float, list[tuple[float | None, int]]] = defaultdict(list)
        for camera in self.cameras.values():
            for t, px, score in zip(camera.t, camera.px, camera.scores.get(metric, ()), strict=False):
                parts[t].append((score, px))
        return tuple(sorted(parts)), tuple(_weighted(parts[t]) for t in sorted(parts))

    def summary(self, metric: str) -> Summary | None:
        return Summary.of(self.screen(metric)[1])


def _weighted(parts: Sequence[tuple[float | None, int]]) -> float | None:
    known = [(score, px) for score, px in parts if score is not None]
    if len(known) < len(parts):
        return None
    return sum(score * px for score, px in known) / sum(px for _, px in known)


def to_json(drive: SeenDrive) -> dict[str, Any]:
    """The document, with summaries."""

    def summaries(of: SeenDrive | SeenCamera) -> dict[str, Any]:
        found = {name: of.summary(name) for name in drive.metrics}
        return {name: None if each is None else asdict(each) for name, each in found.items()}

    cameras = {name: {"summary": summaries(each), **asdict(each)} for name, each in drive.cameras.items()}
    return {"summary": summaries(drive), **asdict(drive), "cameras": cameras}


def read_seen(directory: Path) -> SeenDrive | None:
    """What was measured of a drive; None: nothing.

    raises  UserError for a file that is not as the verb writes it
    """
    path = directory / DOCUMENT
    try:
        found = from_json(SeenDrive, read_json(path.read_bytes()))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        found = None
    if found is None or not all(_is_complete(found, camera) for camera in found.cameras.values()):
        rule = "must be as `tod-runner quality DRIVE view=LOG` writes it: run it again, or delete the file"
        raise UserError(str(path), "", None, rule)
    return found


def _is_complete(drive: SeenDrive, camera: SeenCamera) -> bool:
    lengths = {len(camera.t), len(camera.px), *(len(camera.scores.get(name, ())) for name in drive.metrics)}
    return len(lengths) == 1
