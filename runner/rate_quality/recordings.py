"""The directory of a recording: one file per camera, which gets its name only when complete, and recording.json."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from runner.core.model import Camera
from runner.errors import ArgumentError, RunError, os_errors_as, reason
from runner.redact import redacted
from runner.settings import Recording
from runner.system.files import put_in_place, unfinished

INDEX = "recording.json"
LEAST_S = 60  # a recording of open length needs space for at least this long
MARGIN_BYTES = 64_000_000  # never filled, plus the raw frames of MARGIN_S
MARGIN_S = 2


def raw_rate(cameras: Iterable[Camera]) -> float:
    """Bytes per second of some cameras' raw frames, I420 of the sources' sizes."""
    return float(sum(c.source_size[0] * c.source_size[1] * c.fps * 3 / 2 for c in cameras))


def margin(cameras: Iterable[Camera]) -> float:
    """Bytes that stay free: a recording ends before the disk is full."""
    return MARGIN_BYTES + MARGIN_S * raw_rate(cameras)


def check_space(directory: Path, cameras: Iterable[Camera], recording: Recording, duration_s: float | None) -> None:
    """Check that there is room for a recording: for its whole length, or for a minute if that is open.

    raises  RunError with the space needed and available
    """
    cameras = list(cameras)
    seconds = LEAST_S if duration_s is None else duration_s
    raw = raw_rate(cameras) * seconds
    needed = raw * recording.of_raw + margin(cameras)
    free = shutil.disk_usage(directory).free
    if free < needed:
        plan = (
            f"{recording.of_raw:g} of {gigabytes(raw)} raw in {seconds:g} s, and {gigabytes(margin(cameras))} kept free"
        )
        raise RunError(f"{directory}: {gigabytes(free)} free, a recording needs {gigabytes(needed)}: {plan}")


def gigabytes(size: float) -> str:
    return f"{size / 1e9:.2f} GB"


def make_directory(path: Path) -> None:
    """raises UserError if the directory cannot be made"""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ArgumentError("output", path, "must be a directory" if path.exists() else reason(error)) from None


def claim_files(directory: Path, cameras: Iterable[str]) -> dict[str, Path]:
    """By camera, the file to write; each is created empty, so that no other recording uses it.

    raises  UserError if something would be overwritten, or nothing can be written
    """
    cameras = list(cameras)
    outputs = [directory / INDEX, *(final(directory, name) for name in cameras)]
    taken = [path.name for path in (*outputs, *(part(directory, name) for name in cameras)) if path.exists()]
    if taken:
        raise ArgumentError("output", directory, f"{', '.join(taken)} already exist; choose another directory")
    claimed: dict[str, Path] = {}
    try:
        for name in cameras:
            part(directory, name).touch(exist_ok=False)
            claimed[name] = part(directory, name)
    except OSError as error:
        remove_empty(claimed.values())
        raise ArgumentError("output", directory, reason(error)) from None
    return claimed


def final(directory: Path, camera: str) -> Path:
    return directory / f"{camera}.mkv"


def part(directory: Path, camera: str) -> Path:
    """The file while it is incomplete."""
    return directory / f".{camera}.mkv.part"


def keep(directory: Path, camera: str) -> Path:
    """Rename a complete file to its final name, once it is flushed to the disk.

    raises  RunError if that name was taken in the meantime, or the disk fails
    """
    incomplete, path = part(directory, camera), final(directory, camera)
    with os_errors_as(lambda why: RunError(f"{incomplete} cannot become {path.name}: {why}")):
        if path.exists():
            raise RunError(f"{path} was created in the meantime; the recording is {incomplete}")
        put_in_place(incomplete, path)
    return path


def remove_empty(paths: Iterable[Path]) -> None:
    """Remove empty files."""
    for path in paths:
        if path.exists() and not path.stat().st_size:
            path.unlink()


def write_index(directory: Path, document: Mapping[str, Any]) -> None:
    """Write recording.json atomically; passwords in addresses are left out.

    raises  RunError
    """
    text = json.dumps(redacted(document), indent=2, ensure_ascii=False)
    path = directory / INDEX
    with (
        os_errors_as(lambda why: RunError(f"{path} cannot be written: {why}; the videos are complete")),
        unfinished(path) as new,
    ):
        new.write_text(text + "\n", encoding="utf-8")
