"""The terminal's tables of a report."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from runner.drive.checks import ClaimCheck
from runner.drive.statistics import DriveStatistics
from runner.drive.tables import VERDICTS, camera_rows, drive_rows, seen_rows, uplink_rows

WIDE = 1000  # columns assumed for a pipe or a file: no table is wider, so nothing is cut off


def show(
    drives: Sequence[DriveStatistics], checks: Mapping[str, Sequence[ClaimCheck]], left_out: Sequence[str]
) -> None:
    """The cameras of each drive, the drives compared, claims, and notes."""
    console = Console(width=None if sys.stdout.isatty() else WIDE)
    for drive in drives:
        console.print(_table(drive.series.label, *camera_rows(drive)))
        if drive.uplinks:
            console.print(_table(f"{drive.series.label}: uplinks", *uplink_rows(drive)))
        if drive.seen:
            console.print(_table(f"{drive.series.label}: on the screen", *seen_rows(drive.seen)))
        for note in (*drive.series.warnings, *drive.notes):
            console.print(f"{drive.series.label}: {note}", markup=False, highlight=False)
    if len(drives) > 1:
        console.print(_table("all drives", *drive_rows(drives)))
    for label, held in checks.items():
        rows = [(check.claim, check.outcome, VERDICTS[check.holds]) for check in held]
        console.print(_table(f"{label}: claims of the paper and results", ("claim", "result", "holds"), rows))
    for note in left_out:
        console.print(note, markup=False, highlight=False)


def _table(title: str, headings: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    table = Table(title=Text(title), title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    for number, heading in enumerate(headings):
        table.add_column(heading, justify="right" if number else "left", no_wrap=True, overflow="fold")
    for row in rows:
        table.add_row(*map(Text, row))
    return table
