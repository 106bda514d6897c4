"""The statistics of drives as JSON, see schemas/report.schema.json. Pure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from typing import Any

import numpy as np

from runner.drive.checks import ClaimCheck
from runner.drive.series import LinkSeries, Series
from runner.drive.statistics import CameraStatistics, DriveStatistics, Latency

FORMAT_VERSION = 1


def to_json(
    drives: Sequence[DriveStatistics],
    checks: Mapping[str, Sequence[ClaimCheck]],
    figures: Sequence[str],
    left_out: Sequence[str],
) -> dict[str, Any]:
    """The document.

    checks  by label of a drive
    """
    return {
        "version": FORMAT_VERSION,
        "tod_runner": version("tod-runner"),
        "figures": list(figures),
        "left_out": list(left_out),
        "drives": [_drive(drive, checks.get(drive.series.label, ())) for drive in drives],
    }


def when(drive: Series) -> str:
    """When a drive began: ISO 8601, UTC."""
    return datetime.fromtimestamp(drive.began, UTC).isoformat(timespec="seconds").replace("+00:00", "Z")


def number(value: float | None, digits: int = 4) -> float | None:
    """Rounded; None if unknown."""
    return None if value is None or not math.isfinite(value) else round(float(value), digits)


def rules(drive: Series) -> dict[str, list[str]]:
    """By mode, the names of its rules."""
    return {mode: list(entries) for mode, entries in (drive.config.get("modes") or {}).items()}


def _drive(drive: DriveStatistics, checks: Sequence[ClaimCheck]) -> dict[str, Any]:
    series = drive.series
    return {
        "label": series.label,
        "path": series.path,
        "replayed": None if series.replayed is None else list(series.replayed),
        "vehicle": series.vehicle,
        "began": when(series),
        "duration_s": number(series.end, 3),
        "ended": dict(series.ended),
        "versions": {side: dict(each) for side, each in series.versions.items()},
        "modes": [{"from_s": number(t, 3), "mode": mode} for t, mode in series.modes],
        "rules": rules(series),
        "measured": series.measured or None,
        "kbps": number(drive.kbps, 1),
        "allocated_kbps": number(drive.allocated, 1),
        "share": number(drive.share),
        "predicted_min_kbps": number(drive.predicted_min, 1),
        "predicted_max_kbps": number(drive.predicted_max, 1),
        "predictions": drive.predictions
        and {key: number(value, 3) for key, value in drive.predictions._asdict().items()},
        "latency_arrival_ms": _latency(drive.arrival),
        "latency_decode_ms": _latency(drive.decode),
        "freezes": drive.freezes,
        "frozen_s": number(drive.frozen_s, 3),
        "lost": drive.lost,
        "damaged_share": number(drive.damaged),
        "rebuilt": drive.rebuilt,
        "refused": series.refused,
        "link": _link(series.link) if series.link else None,
        "quality": {
            "metric": drive.metric,
            "mean": number(drive.quality, 5),
            "moving": number(drive.moving, 5),
            "frozen_share": number(drive.frozen),
        }
        if drive.metric
        else None,
        "delivered": None
        if math.isnan(drive.delivered)
        else {"metric": "mssim", "mean": number(drive.delivered, 5), "worst": number(drive.delivered_worst, 5)},
        "warnings": list(series.warnings),
        "notes": list(drive.notes),
        "checks": [check._asdict() for check in checks],
        "cameras": [_camera(camera) for camera in drive.cameras.values()],
    }


def _latency(latency: Latency) -> dict[str, float | None] | None:
    if math.isnan(latency.median):
        return None
    return {key: number(value, 2) for key, value in latency._asdict().items()}


def _link(link: LinkSeries) -> dict[str, Any]:
    return {
        "min_kbps": number(float(link.kbps.min()), 1),
        "max_kbps": number(float(link.kbps.max()), 1),
        "queue_p95_ms": number(float(np.percentile(link.queue_ms, 95)), 2),
        "dropped": int(link.dropped[-1]),
    }


def _camera(camera: CameraStatistics) -> dict[str, Any]:
    freezes, quality, delivered = camera.freezes, camera.quality, camera.delivered
    return {
        "name": camera.name,
        "frames": camera.frames,
        "hz": number(camera.hz, 2),
        "sending_s": number(camera.sending_s, 3),
        "kbps": number(camera.kbps, 1),
        "allocated_kbps": number(camera.allocated, 1),
        "share": number(camera.share),
        "factors": [{"scaling": number(f), "share": number(share)} for f, share in camera.factors.items()],
        "sizes": [{"width": w, "height": h, "share": number(share)} for (w, h), share in camera.sizes.items()],
        "latency_arrival_ms": _latency(camera.arrival),
        "latency_decode_ms": _latency(camera.decode),
        "freezes": None
        if freezes is None
        else {
            "count": len(freezes),
            "total_s": number(sum(f.seconds for f in freezes), 3),
            "longest_s": number(max((f.seconds for f in freezes), default=0.0), 3),
            "each": [{"t": number(f.t, 3), "seconds": number(f.seconds, 3)} for f in freezes],
        },
        "lost": camera.lost,
        "damaged_share": number(camera.damaged),
        "rebuilt": camera.rebuilt,
        "quality": quality
        and {
            "metric": quality.metric,
            "mean": number(quality.mean, 5),
            "moving": number(quality.moving, 5),
            "frozen_share": number(camera.frozen),
            "clamped": number(quality.clamped),
        },
        "delivered": delivered
        and {
            "metric": "mssim",
            "mean": number(delivered.mean, 5),
            "lowest": number(min(delivered.mssim, default=None), 5),
            "moments": len(delivered.mssim),
            "stale_share": number(delivered.stale),
            "against": "scene" if delivered.clip else "stream",
        },
    }
