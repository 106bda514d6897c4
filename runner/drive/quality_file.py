"""The file that the verb `quality` writes next to a drive's logs: quality of the pictures that the operator saw."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

from runner.errors import UserError
from runner.records import from_json
from runner.schema import read_json

DOCUMENT = "quality.json"


@dataclass(frozen=True, slots=True)
class DeliveredQuality:
    """Delivered quality of one camera.

    t      moments, s since the vehicle's side began
    mssim  at each moment, the displayed picture against the scene
    stale  share of the moments at which an older picture was displayed
    clip   whether the scene was known; otherwise it is the stream as sent
    """

    t: tuple[float, ...]
    mssim: tuple[float, ...]
    stale: float
    clip: bool

    @property
    def mean(self) -> float | None:
        return fmean(self.mssim) if self.mssim else None


def to_json(found: Mapping[str, DeliveredQuality]) -> dict[str, Any]:
    """The document, with the mean of all cameras and the name of the worst one."""
    means = {name: quality.mean for name, quality in found.items() if quality.mean is not None}
    return {
        "metric": "mssim",
        "mean": fmean(means.values()) if means else None,
        "worst": min(means, key=lambda name: means[name], default=None),
        "cameras": {name: {"mean": quality.mean, **asdict(quality)} for name, quality in found.items()},
    }


def read_quality(directory: Path) -> dict[str, DeliveredQuality]:
    """The measured quality of a drive, by camera; empty if none was measured.

    raises  UserError for a file that is not as the verb writes it
    """
    path = directory / DOCUMENT
    try:
        document = read_json(path.read_bytes())
        return {name: _camera(camera) for name, camera in document["cameras"].items()}
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        rule = "must be as `tod-runner quality` writes it: run it again, or delete the file"
        raise UserError(str(path), "", None, rule) from None


def _camera(document: Mapping[str, Any]) -> DeliveredQuality:
    """raises  ValueError"""
    quality = from_json(DeliveredQuality, document)
    if len(quality.t) != len(quality.mssim):
        raise ValueError(f"{len(quality.t)} moments, {len(quality.mssim)} values")
    return quality
