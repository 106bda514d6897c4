"""Finds the rate-quality models of a drive's cameras."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from runner.drive.statistics import Model, rate_curves
from runner.errors import ArgumentError, UserError
from runner.system.files import directory_problem


def find_models(
    config: Mapping[str, Any], directory: Path | None, bases: Sequence[Path]
) -> tuple[dict[str, Model], list[str]]:
    """The available models.

    config     of the drive; a camera may name its model as `rate_quality.model`
    directory  where models are looked up by the name of their camera, or by the name in the configuration; or None
    bases      directories where a model named by the configuration is looked up, first match wins
    returns    models by camera, and a line about the cameras without one
    raises     UserError if the directory does not exist, or a file is not a model
    """
    if directory is not None and (why := directory_problem(directory)):
        raise ArgumentError("models", directory, why)
    found: dict[str, Model] = {}
    cameras = config.get("cameras") or {}
    for name, camera in cameras.items():
        path = next((path for path in _candidates(name, camera, directory, bases) if path.is_file()), None)
        if path:
            found[name] = _read(path)
    missing = [name for name in cameras if name not in found]
    if not missing:
        return found, []
    which = "no camera" if not found else f"all but {', '.join(missing)}"
    verb = "has a rate-quality model" if not found else "have one"
    how = "create them with `tod-runner model vehicle=NAME sequence=DIR output=MODELS`, pass them with models=MODELS"
    return found, [f"estimated quality: {which} {verb}; {how}"]


def _candidates(name: str, camera: Mapping[str, Any], directory: Path | None, bases: Sequence[Path]) -> Iterator[Path]:
    named = (camera.get("rate_quality") or {}).get("model")
    if directory is not None:
        yield directory / f"{name}.model.json"
        if named:
            yield directory / Path(named).name
    if named:
        yield from (base / named for base in bases)


def _read(path: Path) -> Model:
    from runner.rate_quality.artefact import read_model

    model = rate_curves(read_model(path))
    if not model.curves:
        raise UserError(str(path), "points", None, f"has no point with the metric {model.metric}")
    return model
