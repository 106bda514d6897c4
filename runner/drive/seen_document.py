"""What the driver saw, as report.json says it. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, TypedDict

from runner.core.limits import Count, NonNegative, Share
from runner.drive.seen_file import Ages, Optimum, SeenCamera, SeenDrive, Summary


class SeenScores(TypedDict):
    """Scores over time, in units of the metric.

    mean, worst, p5  their mean, the lowest, their 5th percentile
    """

    mean: float
    worst: float
    p5: float


class SeenAge(TypedDict):
    """Age of the picture on the screen, while the camera was shown and sent.

    mean_ms, p95_ms  since its capture: mean, and 95th percentile
    frozen_share     of the time in which none came although one was due
    late_share       of the time in which it was too old when it came
    """

    mean_ms: float
    p95_ms: float
    frozen_share: Share
    late_share: Share


class SeenCameraDocument(TypedDict):
    """What the driver saw of one camera.

    scores   by metric; None: nothing was scored
    age      None: it never was on the screen while it was sent
    moments  at which it was on the screen, twice a second
    against  what pictures were compared with: the scene, or the stream as sent, which hides encoder losses
    optimum  MSSIM by its own model with the best static allocation; None where there is none
    """

    scores: Mapping[str, SeenScores | None]
    age: SeenAge | None
    moments: Count
    against: Literal["scene", "stream"]
    optimum: float | None


class SeenOptimum(TypedDict):
    """The best static allocation, by the cameras' own models, in the view that was longest in force.

    kbps   its total: what the drive sent on the mean, kbit/s
    mssim  mean over the screen
    """

    kbps: NonNegative
    mssim: float


class SeenDocument(TypedDict):
    """Quality of what the driver saw on the screen, as `tod-runner quality DRIVE view=LOG` measured it.

    view     log that states what the screen showed
    screen   by metric, scores of the whole screen: cameras weighted by their area; None: nothing was scored
    optimum  None: not every camera has a model of its own
    cameras  by name
    """

    view: str
    screen: Mapping[str, SeenScores | None]
    optimum: SeenOptimum | None
    cameras: Mapping[str, SeenCameraDocument]


def seen_document(seen: SeenDrive) -> SeenDocument:
    best = seen.optimum
    return {
        "view": seen.view,
        "screen": {metric: _scores(seen.summary(metric)) for metric in seen.metrics},
        "optimum": None if best is None else {"kbps": round(best.kbps, 1), "mssim": round(best.mssim, 5)},
        "cameras": {name: _camera(name, camera, seen.metrics, best) for name, camera in seen.cameras.items()},
    }


def _camera(name: str, camera: SeenCamera, metrics: Mapping[str, str], best: Optimum | None) -> SeenCameraDocument:
    return {
        "scores": {metric: _scores(camera.summary(metric)) for metric in metrics},
        "age": None if camera.age is None else _age(camera.age),
        "moments": len(camera.t),
        "against": "scene" if camera.scene else "stream",
        "optimum": None if best is None or name not in best.cameras else round(best.cameras[name], 5),
    }


def _scores(found: Summary | None) -> SeenScores | None:
    if found is None:
        return None
    return {"mean": round(found.mean, 5), "worst": round(found.worst, 5), "p5": round(found.p5, 5)}


def _age(age: Ages) -> SeenAge:
    return {
        "mean_ms": round(age.mean_ms, 2),
        "p95_ms": round(age.p95_ms, 2),
        "frozen_share": round(age.frozen, 4),
        "late_share": round(age.late, 4),
    }
