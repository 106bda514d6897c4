"""usage: tod-runner map DRIVE [DRIVE ...] output=FILE.csv [percentile=10] [cell_m=10]

A bandwidth map from drives, for pqos=map: per square of the ground, a percentile of what came through, in kbit/s of
video. Only samples in which the link was really the limit count: over the second before, packets were lost, or half of
the frames came 50 ms later than the fastest of the drive. Everything else says how much was sent, not what the link
carries. The operator's log is needed (demo and operator with log=DIR).

  tod-runner map drives/monday drives/tuesday output=maps/route.csv
  tod-runner map drive output=route.csv percentile=5 cell_m=25
  tod-runner demo pqos.file=route.csv
"""

from __future__ import annotations

from pathlib import Path

from runner.drive.capacity import Cell, cells, limited_samples
from runner.drive.read import read_drive
from runner.drive.series import series
from runner.errors import RunError, UserError
from runner.files import whole_file
from runner.verbs import Arguments


def run(arguments: Arguments) -> int:
    if not arguments.words:
        raise UserError("command line", "", None, "must name a drive: a directory that log= wrote")
    output = arguments.path("output")
    if output is None:
        raise UserError("command line", "output", None, "must be given, the map's file")
    percentile, cell_m = arguments.number("percentile"), arguments.number("cell_m")
    percentile, cell_m = 10.0 if percentile is None else percentile, 10.0 if cell_m is None else cell_m
    if percentile > 100:
        raise UserError("command line", "percentile", f"{percentile:g}", "must be at most 100")
    if cell_m < 1:
        raise UserError("command line", "cell_m", f"{cell_m:g}", "must be at least 1")
    samples, seen = [], 0
    for word in arguments.words:
        drive = series(read_drive(Path(word)))
        samples += limited_samples(drive)
        seen += len(drive.actual.t)
    if not samples:
        rule = "nothing was lost and nothing late: what came says what was sent, not what the link carries"
        raise RunError(f"no map: in none of {seen} samples was the link the limit; {rule}")
    squares = cells(samples, percentile, cell_m)
    _write(output, squares)
    print(
        f"{output}: {len(squares)} squares of {cell_m:g} m from {len(samples)} of {seen} samples, the others had room"
    )
    return 0


def _write(path: Path, squares: list[Cell]) -> None:
    rows = (f"{cell.lon:.6f},{cell.lat:.6f},{cell.kbps:.0f},{cell.samples}\n" for cell in squares)
    with whole_file(path) as file:
        file.writelines(["lon,lat,kbps,samples\n", *rows])
