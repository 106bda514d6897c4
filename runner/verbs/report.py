"""usage: tod-runner report DRIVE [DRIVE ...] output=DIR [models=DIR] [positions=BAG [topic=NAME]] [conf=DIR]

Draws the figures of the paper's driving test from logged drives (log= of vehicle, operator and demo): a DRIVE is a
directory with drive.jsonl, operator.jsonl or both. Several drives are compared, on the same axes.

Writes DIR/index.html, one self-contained page that needs no network; each figure as .png and .pdf at column width;
and DIR/report.json with all statistics (schemas/report.schema.json), for CI.

models= is a directory with CAMERA.model.json files, as `tod-runner model` writes them, from which quality is estimated.
Without it, the models named by the drive's configuration are used if they are in conf/cameras/. Quality that the verb
quality has measured on the pictures of a drive is shown, too, and what the driver saw of it (view=), beside the best
that a static allocation of the same bits could have reached.

positions= is a ROS bag with the vehicle's positions during the drives (sensor_msgs/NavSatFix), which replace those in
their logs; topic= is needed if it has several such topics.

  tod-runner demo log=drive duration_s=100; tod-runner report drive output=report
  tod-runner report drives/adaptive drives/static output=compared models=models
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from textwrap import shorten
from typing import TYPE_CHECKING

from runner.configuration.files import conf_directories
from runner.errors import ArgumentError
from runner.system.extras import require
from runner.system.files import directory_problem, write_whole
from runner.verbs import Arguments
from runner.verbs.screen import progress_bar

if TYPE_CHECKING:
    from runner.drive.read import Drive
    from runner.drive.statistics import DriveStatistics

PAGE, DOCUMENT = "index.html", "report.json"
MARK = '<meta name="generator" content="tod-runner report">'  # in each page, see runner/drive/static/report.html
WORDS_SHOWN = 60  # characters of what a replay changed, in a label
MARK_WITHIN = 1000  # characters from the start of a page


def run(arguments: Arguments) -> int:
    paths, output = _paths(arguments)
    from runner.drive.positions import reader

    bases = [base / "cameras" for base in conf_directories(arguments.conf)]
    page = report(paths, output, arguments.path("models"), bases, reader(arguments.values))
    print(page)
    return 0


def report(
    paths: Sequence[Path],
    output: Path,
    models: Path | None = None,
    bases: Sequence[Path] = (),
    read: Callable[[Path], Drive] | None = None,
) -> Path:
    """Read, measure, draw and write; print the tables. The claims of a drive's experiment are checked.

    read     reads a drive; None: reads it as logged
    returns  the page
    raises   UserError for a drive or model that cannot be read, RunError for a file that cannot be written
    """
    from runner.drive import document
    from runner.drive.claims import claims
    from runner.drive.figures import figures
    from runner.drive.html import page
    from runner.drive.print import write_figures
    from runner.rate_quality.artefact import dumps
    from runner.verbs.report_table import show

    with progress_bar() as progress:
        drives = _measured(paths, models, bases, read, lambda share: progress("drives", share))
        checks_by_label = {drive.series.label: checks for drive in drives if (checks := claims(drive.series))}
        made, left_out = figures(drives)
        write_figures(made, output, progress)
        summary = document.to_json(drives, checks_by_label, [figure.name for figure in made], left_out)
        write_whole(output / DOCUMENT, dumps(summary))
        index = output / PAGE
        write_whole(index, page(drives, checks_by_label, made, left_out).encode())
    show(drives, checks_by_label, left_out)
    return index


def check_report(output: Path, models: Path | None) -> None:
    """Check that a report can be made once there are drives.

    raises  UserError if the directories are not usable, RunError if a library is missing
    """
    above = next((path for path in (output, *output.parents) if path.exists()), Path())
    if not above.is_dir():
        raise ArgumentError("output", output, f"must be a directory, but {above} is a file")
    if (output / PAGE).exists() and not _is_report(output / PAGE):
        rule = "exists and was not written by tod-runner report; choose another directory"
        raise ArgumentError("output", output / PAGE, rule)
    if models and (why := directory_problem(models)):
        raise ArgumentError("models", models, why)
    require("report")


def _is_report(page: Path) -> bool:
    if not page.is_file():
        return False
    with page.open(encoding="utf-8", errors="replace") as file:
        return MARK in file.read(MARK_WITHIN)


def _paths(arguments: Arguments) -> tuple[list[Path], Path]:
    output = arguments.given_path("output", "the directory to write the report to")
    check_report(output, arguments.path("models"))
    return [Path(word) for word in arguments.words], output


def _measured(
    paths: Sequence[Path],
    models: Path | None,
    bases: Sequence[Path],
    read: Callable[[Path], Drive] | None,
    on_progress: Callable[[float], None],
) -> list[DriveStatistics]:
    from dataclasses import replace

    from runner.drive.models import find_models
    from runner.drive.quality_file import read_quality
    from runner.drive.read import read_drive
    from runner.drive.seen_file import read_seen
    from runner.drive.series import series
    from runner.drive.statistics import statistics

    drives: list[Drive] = []
    for number, path in enumerate(paths):
        on_progress(number / len(paths))
        drives.append((read or read_drive)(path))
    found = []
    for drive, label in zip(drives, labels(drives), strict=True):
        over_time = series(drive, label)
        curves, notes = find_models(over_time.config, models, [*bases, drive.path, Path.cwd()])
        measured = statistics(over_time, curves, read_quality(drive.path), read_seen(drive.path))
        found.append(replace(measured, notes=(*measured.notes, *notes)))
    on_progress(1.0)
    return found


def labels(drives: Sequence[Drive]) -> list[str]:
    """Short names that distinguish drives: the directory's, with more of its path if two have the same name.

    That of a replay states what it changed.
    """
    paths = [drive.path.resolve() for drive in drives]
    found: list[str] = []
    for number, (drive, path) in enumerate(zip(drives, paths, strict=True)):
        others = [other for other in paths if other != path]
        depth = 1
        while depth < len(path.parts) - 1 and any(other.parts[-depth:] == path.parts[-depth:] for other in others):
            depth += 1
        again = paths[:number].count(path)
        name = "/".join(path.parts[-depth:]) + (f" ({again + 1})" if again else "")
        words = shorten(" ".join(drive.replayed or ()) or "unchanged", WORDS_SHOWN, placeholder=" ...")
        found.append(name if drive.replayed is None else f"{name} (replay: {words})")
    return found
