"""usage: tod-runner quality DRIVE [DRIVE ...]

Measures the quality of what the operator saw: twice a second, the displayed picture is compared with the scene that the
camera saw at that time (MSSIM of luma at the camera's full size). Freezes, delay and damage lower the score. Needs
drives with log.video=true on both sides. With a rendered source (synthetic) the scene is the clip's picture; otherwise
it is the stream as sent, and losses in the encoder are not included.

Writes the score at each of these times to DRIVE/quality.json, which `report` shows.

  tod-runner demo log=monday log.video=true duration_s=60
  tod-runner quality monday
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from runner.errors import UserError
from runner.system import signals
from runner.verbs import Arguments
from runner.verbs.screen import progress_bar, streaming

if TYPE_CHECKING:
    from runner.drive.quality_file import DeliveredQuality
    from runner.drive.read import Drive

SIDES = ("vehicle", "operator")
SEEN = "view={} scores what was seen"


def run(arguments: Arguments) -> int:
    for word in arguments.words:
        _measure_drive(Path(word))
    return 0


def _measure_drive(path: Path) -> None:
    from runner.drive.delivered import cropped_by_view, measure
    from runner.drive.quality_file import DOCUMENT, to_json
    from runner.drive.read import read_drive
    from runner.drive.videos import Videos
    from runner.rate_quality.artefact import dumps
    from runner.system.files import write_whole

    drive = read_drive(path)
    for warning in drive.warnings:
        print(warning, file=sys.stderr)
    cameras, clips = _cameras(drive)
    apply = streaming()
    with progress_bar() as progress:

        def on_progress(share: float) -> None:
            signals.check()
            progress(str(path), share)

        videos = Videos(path, apply.read_video, apply.decode_video)
        found = measure(drive, videos, cameras, clips, on_progress, _warn)
    cropped = ", ".join(cropped_by_view(drive))
    if not found:
        raise UserError(str(path), "", None, "no camera's video was kept on both sides: drive with log.video=true")
    if cropped and not any(quality.mssim for quality in found.values()):
        rule = f"only what the driver saw was sent of {cropped}, and whole pictures are needed: {SEEN.format(path)}"
        raise UserError(str(path), "", None, rule)
    if not any(quality.mssim for quality in found.values()):
        rule = "no capture times were logged, so nothing can be compared"
        raise UserError(str(path), "", None, rule)
    if clips and len({quality.clip for quality in found.values()}) > 1:
        _warn(f"{path}: the clips of some cameras are missing: these are compared with the stream as sent")
    if cropped:
        _warn(f"{path}: pictures cropped to what the driver saw are left out ({cropped}): {SEEN.format(path)}")
    write_whole(path / DOCUMENT, dumps(to_json(found)))
    _show(path, found)


def _warn(what: str) -> None:
    print(what, file=sys.stderr)


def _cameras(drive: Drive) -> tuple[Mapping[str, Any], Mapping[str, Path]]:
    """The cameras of a drive, and the clips that their sources played."""
    from runner.configuration.config import configuration
    from runner.plans import compile_plans

    missing = [side for side in SIDES if side not in drive.sides]
    if missing:
        raise UserError(str(drive.path), "", None, f"no log of the {' and the '.join(missing)}: both sides are needed")
    began = drive.sides["vehicle"].began
    setup = configuration([], base=(dict(began.config), f"{drive.path}: config"), runnable=False).setup()
    clips = {  # only rendered ones have the shape of the camera's picture; others are cropped by their source
        plan.camera.name: Path(str(plan.source[0].properties["location"]))
        for plan in compile_plans(setup)
        if plan.loops and plan.camera.source.render
    }
    return setup.vehicle.cameras, {name: clip for name, clip in clips.items() if clip.is_file()}


def _show(path: Path, found: Mapping[str, DeliveredQuality]) -> None:
    from statistics import fmean

    from rich import box
    from rich.console import Console
    from rich.table import Table

    table = Table(title=str(path), title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    for number, heading in enumerate(("camera", "MSSIM", "lowest", "moments", "older picture", "against")):
        table.add_column(heading, justify="right" if 0 < number < 5 else "left")
    for name, quality in found.items():
        scores = quality.mssim
        figures = (f"{quality.mean:.4f}", f"{min(scores):.4f}") if scores else ("–", "–")
        against = "the scene" if quality.clip else "the stream as sent"
        table.add_row(name, *figures, str(len(scores)), f"{100 * quality.stale:.1f} %", against)
    means = [quality.mean for quality in found.values() if quality.mean is not None]
    Console().print(table)
    if means:
        print(f"mean {fmean(means):.4f}, worst camera {min(means):.4f}")
