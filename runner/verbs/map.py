"""usage: tod-runner map DRIVE [DRIVE ...] output=FILE.csv [uplink=NAME] [percentile=10] [cell_m=10]
                      [positions=BAG [topic=NAME]]

Makes a bandwidth map from drives, for pqos=map: per square of the ground, a percentile of what the link could carry, in
kbit/s of video, and how far that varied: mean (bias) and deviation (error) of ln(capacity / kbps). A vehicle that
drives by such a map knows from its start what the predictions are worth.

Where rules believe something about the link (`follow_link`), the capacity is what they believed, four times a second,
while reports told it to within 20 % and it was less than the cameras can use; the vehicle's log is enough.

In other drives it is the received rate, which needs both logs (log=DIR) and rules that measure the link (modes=safe).
Only samples in which the link was the bottleneck count: over the second before, packets were lost, or half of the
frames of a camera arrived 50 ms later than its fastest; the measured link limited the total; and neither machine was
held up. All others show how much was sent, or how busy a machine was, not what the link can carry.

uplink= is needed of a vehicle with several uplinks, each of which gets a map of its own.

positions= is a ROS bag with the vehicle's positions during the drives (sensor_msgs/NavSatFix), which replace those in
their logs; topic= is needed if it has several such topics.

  tod-runner map drives/monday drives/tuesday output=maps/route.csv
  tod-runner map drive output=route.csv percentile=5 cell_m=25
  tod-runner map drive output=a.csv uplink=a
  tod-runner demo pqos.file=route.csv
"""

from __future__ import annotations

import sys
from pathlib import Path

from runner.drive.capacity import CapacitySample, Cell, capacity_problem, cells, limited_samples, sample_times
from runner.drive.positions import reader
from runner.drive.series import series
from runner.errors import ArgumentError, RunError
from runner.system.files import whole_file
from runner.verbs import Arguments

PERCENTILE, CELL_M = 10.0, 10.0


def run(arguments: Arguments) -> int:
    output, percentile, cell_m = _checked_arguments(arguments)
    uplink = arguments.values.get("uplink", "")
    read = reader(arguments.values)
    samples: list[CapacitySample] = []
    seen, unusable = 0, list[str]()
    for word in arguments.words:
        drive = series(read(Path(word)))
        print("".join(f"{warning}\n" for warning in drive.warnings), end="", file=sys.stderr)
        if why := capacity_problem(drive, uplink):
            unusable.append(f"{word} {why}")
            continue
        samples += limited_samples(drive, uplink)
        seen += len(sample_times(drive, uplink))
    if not samples:
        rule = "less carried than the cameras can use, as the link was measured, and no machine held up"
        reasons = [f"in none of {seen} samples was the link the limit: {rule}"] if seen else []
        raise RunError(f"no map: {'; '.join([*unusable, *reasons])}")
    squares = cells(samples, percentile, cell_m)
    _write(output, squares)
    left_out = f"; left out: {'; '.join(unusable)}" if unusable else ""
    print(f"{output}: {len(squares)} squares of {cell_m:g} m from {len(samples)} of {seen} samples{left_out}")
    return 0


def _checked_arguments(arguments: Arguments) -> tuple[Path, float, float]:
    """Output file, percentile, and side of a square in m."""
    output = arguments.given_path("output", "the map's file")
    percentile, cell_m = arguments.number("percentile"), arguments.number("cell_m")
    percentile, cell_m = PERCENTILE if percentile is None else percentile, CELL_M if cell_m is None else cell_m
    if percentile > 100:
        raise ArgumentError("percentile", f"{percentile:g}", "must be at most 100")
    if cell_m < 1:
        raise ArgumentError("cell_m", f"{cell_m:g}", "must be at least 1")
    return output, percentile, cell_m


def _write(path: Path, squares: list[Cell]) -> None:
    rows = (
        f"{cell.lon:.6f},{cell.lat:.6f},{cell.kbps:.0f},{cell.samples},{cell.bias:.3f},{cell.error:.3f}\n"
        for cell in squares
    )
    with whole_file(path) as file:
        file.writelines(["lon,lat,kbps,samples,bias,error\n", *rows])
