"""The output of a measurement: the model file, the camera YAML that links to it, and how to read them back."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from fractions import Fraction
from importlib.metadata import version
from pathlib import Path
from statistics import fmean
from typing import Any

from runner.core.model import Camera, plain
from runner.errors import UserError, reason
from runner.rate_quality.cache import digest
from runner.rate_quality.choice import Choice
from runner.rate_quality.curves import Crossing, Ladder, Point
from runner.rate_quality.sequence import Sequence as Clip

FORMAT_VERSION = 1
SCHEMA = "rate_quality"
MARK = "Measured by `tod-runner model`"  # in each camera YAML written by this module


@dataclass(frozen=True, slots=True)
class Measured:
    """Everything known about one model.

    name      of the model and its files
    camera    as it is mounted, or the first one of a pool
    clips     by camera, the clip measured on
    masks     by camera, digest of its mask
    encoder   the encoder's fragment of the live graph as text, and versions of the software that ran it
    metrics   by name, identity
    labels    by name, label of an axis
    plan      full or adaptive
    stride    every stride-th frame was scored
    notes     about the sequences
    """

    name: str
    camera: Camera
    clips: Mapping[str, Clip]
    masks: Mapping[str, str]
    encoder: Mapping[str, Any]
    metrics: Mapping[str, str]
    labels: Mapping[str, str]
    metric: str
    sign: int
    good: float
    plan: str
    stride: int
    points: Sequence[Point]
    choice: Choice
    notes: Sequence[str]

    @property
    def warnings(self) -> list[str]:
        return [*self.notes, *self.choice.warnings]


def to_json(measured: Measured) -> dict[str, Any]:
    """The model file, see schemas/rate_quality.schema.json."""
    choice = measured.choice
    sequences = {name: _clip_to_json(clip) for name, clip in measured.clips.items()}
    return {
        "version": FORMAT_VERSION,
        "tod_runner": version("tod-runner"),
        "name": measured.name,
        "content": digest(
            ["".join(map(str, clip.identity)) for clip in measured.clips.values()], measured.encoder, measured.masks
        ),
        "sequences": sequences,
        "masks": dict(measured.masks),
        "encoder": dict(measured.encoder),
        "metric": measured.metric,
        "metrics": dict(measured.metrics),
        "plan": measured.plan,
        "metric_every": measured.stride,
        "points": [_point_to_json(p) for p in sorted(measured.points, key=lambda p: (p.scaling, p.target_kbps))],
        "scaling": [plain(factor) for factor in choice.scaling],
        "b_min_kbps": list(choice.b_min),
        "b_full_kbps": choice.b_full,
        "b_full_quality": measured.good,
        "crossings": [_crossing_to_json(crossing) for crossing in choice.crossings],
        "regret": [_ladder_to_json(ladder) for ladder in choice.table],
        "dropped": [{"scaling": plain(factor), "reason": reason} for factor, reason in choice.dropped.items()],
        "cores": [{"scaling": plain(factor), "cores": round(share, 4)} for factor, share in choice.cores.items()],
        "warnings": measured.warnings,
    }


def to_yaml(measured: Measured) -> str:
    """A camera's file for conf/cameras/."""
    camera, choice = measured.camera, measured.choice
    lines = [
        "# yaml-language-server: $schema=../../schemas/camera.schema.json",
        f"# {MARK} on {', '.join(Path(clip.path).name for clip in measured.clips.values())},"
        f" plan {measured.plan}, by {measured.metric}.",
        *(f"# {warning}" for warning in measured.warnings),
        f"width_px: {camera.width}",
        f"height_px: {camera.height}",
        f"fps: {plain(camera.fps)}",
        f"lens: {camera.lens}",
        f"fov_deg: {camera.fov_deg:g}",
    ]
    if camera.native:
        width, height = camera.native
        left, top = camera.in_source.x, camera.in_source.y
        lines.append(f"native: {{width_px: {width}, height_px: {height}, left_px: {left}, top_px: {top}}}")
    lines += [
        "rate_quality:",
        f"  scaling:    {[plain(factor) for factor in choice.scaling]}",
        f"  b_min_kbps: {list(choice.b_min)}",
        f"  b_full_kbps: {choice.b_full}",
        f"  model: {measured.name}.model.json   # the curves, beside this file",
    ]
    return "\n".join(lines) + "\n"


def read_model(path: Path) -> dict[str, Any]:
    """A model file.

    raises  UserError with its first problem
    """
    from runner import schema

    def wrong(rule: str, where: str = "", found: str | None = None) -> UserError:
        return UserError(str(path), where, found, rule)

    try:
        document = schema.read_json(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise wrong(reason(error)) from None
    except ValueError as error:
        raise wrong(f"is not a model file: {error}") from None
    if isinstance(document, dict) and document.get("version", FORMAT_VERSION) != FORMAT_VERSION:
        raise wrong(f"is of version {document['version']}, this tod-runner reads {FORMAT_VERSION}")
    found = schema.findings(document, SCHEMA)
    if found:
        raise wrong(found[0].rule, schema.dotted(found[0].path), found[0].found)
    return dict(document)


def dumps(document: Mapping[str, Any]) -> bytes:
    """JSON for human readers: one point per line."""
    parts = []
    for key, value in document.items():
        rows = isinstance(value, list) and value and isinstance(value[0], dict)
        text = "[\n" + ",\n".join(f"    {json.dumps(row)}" for row in value) + "\n  ]" if rows else json.dumps(value)
        parts.append(f"  {json.dumps(key)}: {text}")
    return ("{\n" + ",\n".join(parts) + "\n}\n").encode()


def _clip_to_json(clip: Clip) -> dict[str, Any]:
    properties = {key: value for key, value in asdict(clip).items() if key != "path" and value not in ("", None)}
    rounded = {key: round(value, 3) for key, value in properties.items() if key.startswith(("si", "ti"))}
    return {"file": Path(clip.path).name, **properties, "fps": plain(Fraction(clip.fps)), **rounded}


def _point_to_json(point: Point) -> dict[str, Any]:
    scores = {name: round(fmean(values), 6) for name, values in point.scores.items()}
    return {
        "scaling": plain(point.scaling),
        "target_kbps": point.target_kbps,
        "actual_kbps": round(point.actual_kbps, 2),
        "second_kbps": round(point.second_kbps, 2),
        "encode_ms": round(point.encode_ms, 4),
        **scores,
    }


def _crossing_to_json(crossing: Crossing) -> dict[str, Any]:
    rates = {key: round(getattr(crossing, key), 1) for key in ("kbps", "low", "high")}
    return {"lower": plain(crossing.lower), "upper": plain(crossing.upper), **rates}


def _ladder_to_json(ladder: Ladder) -> dict[str, Any]:
    return {
        "scaling": [plain(factor) for factor in ladder.scaling],
        "b_min_kbps": [0, *(round(bound, 1) for bound in ladder.bounds)],
        "regret_max": ladder.regret_max,
        "regret_mean": ladder.regret_mean,
    }
