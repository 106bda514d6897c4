"""The figure of what the driver saw: each camera, the whole screen, and the best static allocation. Pure."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from runner.drive.charts import Axis, Curve
from runner.drive.over_time import Drives, Rows, drive_label, over_time
from runner.drive.seen_file import SeenDrive
from runner.drive.series import Series
from runner.drive.time_series import FloatSeries

METRIC = "mssim"
ROOM = 0.05  # of the range, above and below


def seen(drives: Drives) -> Rows | None:
    """A chart for each drive of which it was measured; None: of none."""
    found = {at: tuple(_curves(drive.seen, drive.series)) for at, drive in enumerate(drives) if drive.seen}
    values = np.concatenate([np.empty(0), *(curve.y for curves in found.values() for curve in curves)])
    known = values[np.isfinite(values)]
    if not known.size:
        return None
    low, high = float(known.min()), float(known.max())
    y = Axis("MSSIM on the screen", low - ROOM * (high - low or 1.0), high + ROOM * (high - low or 1.0))
    return [
        [over_time(drives, at, drive_label(drives, at), y, curves, hover="%{y:.4~g}")] for at, curves in found.items()
    ]


def _curves(found: SeenDrive, series: Series) -> Iterator[Curve]:
    for number, name in enumerate(series.cameras):
        camera = found.cameras.get(name)
        if camera and camera.t:
            yield Curve(name, np.array(camera.t), _values(camera.scores[METRIC]), number, number, width=0.8)
    t, scores = found.screen(METRIC)
    if t:
        yield Curve("whole screen", np.array(t), _values(scores), "text", width=1.6)
    if found.optimum and t:
        ends = np.array([t[0], t[-1]])
        yield Curve("best static allocation", ends, np.full(2, found.optimum.mssim), "predicted", dash=1)


def _values(scores: Sequence[float | None]) -> FloatSeries:
    return np.array([np.nan if score is None else score for score in scores], dtype=float)
