"""Drives on disk, read back and checked."""

from __future__ import annotations

import json
from collections.abc import Container, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from statistics import median
from typing import Any, TextIO, TypeVar

from runner.core.events import Event, parse
from runner.drive.log import FILES, FORMAT
from runner.errors import UserError, os_errors_as
from runner.records import (
    KINDS,
    Began,
    Ended,
    Json,
    LinesDropped,
    ReceptionReported,
    Record,
    Sample,
    from_json,
    line_from_json,
)
from runner.schema import event_problem, log_problem, read_json
from runner.system.clocks import KEPT_S

T = TypeVar("T")
DRIVEN = {"vehicle", "operator"}  # sides without which a directory holds no drive
REPORTS = KINDS[ReceptionReported]
# Kinds of lines in a vehicle's log, except events, reception reports and the first line.
OTHER_KINDS = ("decision", "telemetry", "note", "video", "video_shift", "ended")
LONGEST_LINE = 1 << 24  # characters; the longest real line, the configuration, has a thousandth of that


@dataclass(frozen=True)
class Side:
    """The log of one side.

    lines  events and records between its first line and the end, in order
    ended  whether it was closed cleanly
    """

    began: Began
    lines: list[Event | Record]
    ended: bool

    def of(self, kind: type[T]) -> Iterator[T]:
        """Its lines of a kind."""
        return (line for line in self.lines if isinstance(line, kind))

    @cached_property
    def began_s(self) -> float:
        """Its start, s since 1970 by the vehicle's clock; by its own if the clock difference was not measured."""
        measured = [(s.t, s.clock_ahead_ms or 0.0) for s in self.of(Sample) if s.clock_bound_ms is not None]
        # `t` does not follow a clock that is set later.
        ahead_ms = [ahead_ms for t, ahead_ms in measured if t - measured[0][0] <= KEPT_S]
        return self.began.time + (median(ahead_ms) / 1000 if ahead_ms else 0.0)


@dataclass(frozen=True)
class Drive:
    """A directory that `log=` wrote.

    sides     by name: vehicle, operator, link; a drive may lack any of them
    warnings  caveats for the user
    """

    path: Path
    sides: Mapping[str, Side]
    warnings: list[str] = field(default_factory=list)

    @property
    def name(self) -> str:
        return self.path.resolve().name


def read_drive(directory: Path) -> Drive:
    """Everything in the directory of a drive.

    raises  UserError with file and line of the first error
    """
    where = str(directory)
    if not directory.is_dir():
        rule = "must be a directory that log= wrote" if directory.exists() else "no such directory"
        raise UserError(where, "", None, rule)
    warnings: list[str] = []
    files = {side: directory / name for side, name in FILES.items()}
    present = {side: path for side, path in files.items() if path.is_file()}
    logged = {side: path for side, path in present.items() if path.stat().st_size}
    if logged.keys() & DRIVEN:  # a side that was killed before it began leaves an empty file
        empty = [path for side, path in present.items() if side not in logged]
        warnings += [f"{path}: is empty: nothing was logged" for path in empty]
        present = logged
    sides = {side: _side(side, path, warnings) for side, path in present.items()}
    if not sides.keys() & DRIVEN:
        raise UserError(where, "", None, f"contains no drive log: neither {FILES['vehicle']} nor {FILES['operator']}")
    return Drive(directory, sides, warnings)


def _side(side: str, path: Path, warnings: list[str]) -> Side:
    with os_errors_as(partial(UserError, str(path), "", None)), path.open(encoding="utf-8", errors="replace") as file:
        lines = [line for _, line in read_lines(text_lines(file), str(path), warnings)]
    began = check_began(lines[0] if lines else None, str(path))
    if began.side != side:
        raise UserError(f"{path}: line 1", "side", repr(began.side), f"must be {side}")
    records = [line_from_json(line) if is_log(line) else parse(line) for line in lines[1:]]
    ended = bool(records) and isinstance(records[-1], Ended)
    if not ended:
        warnings.append(f"{path}: was not closed; the process was killed or is still running")
    found = Side(began, records[:-1] if ended else records, ended)
    if dropped := sum(line.lines for line in found.of(LinesDropped)):
        warnings.append(f"{path}: {dropped} lines were dropped, since the disk was too slow")
    return found


def check_began(line: Json | None, name: str) -> Began:
    """The first line of a drive's file.

    raises  UserError if it is something else
    """
    if line is None:
        raise UserError(name, "", None, "is empty: nothing was logged")
    if line.get("log") != "began":
        raise UserError(
            f"{name}: line 1", "", None, "not the first line of a drive log: must be a file that log= wrote"
        )
    if line["format"] != FORMAT:
        raise UserError(f"{name}: line 1", "format", str(line["format"]), f"this version reads format {FORMAT}")
    return from_json(Began, line)


def text_lines(file: TextIO) -> Iterator[str]:
    """The lines of a file; overlong ones are cut, so that a file without line ends is not loaded into memory."""
    return iter(partial(file.readline, LONGEST_LINE + 1), "")


def read_lines(
    lines: Iterable[str], name: str, warnings: list[str], *, skipped: Container[str] = ()
) -> Iterator[tuple[int, Json]]:
    """The lines of a drive's file with their numbers, each checked against its schema.

    skipped  kinds of log lines that are neither checked nor yielded

    An incomplete last line of a drive, left by a killed process, is skipped with a warning.

    raises  UserError with the number of the first invalid line
    """
    drive = False
    for number, text in enumerate(lines, 1):
        if len(text) > LONGEST_LINE:
            raise UserError(f"{name}: line {number}", "", None, f"must be at most {LONGEST_LINE} characters long")
        line, problem = read_line(text)
        if is_log(line):
            drive = True
            if line["log"] in skipped:
                continue
            problem = problem or log_problem(line)
        if problem and drive and not text.endswith("\n"):
            warnings.append(f"{name}: line {number} is truncated and was skipped")
            return
        if problem:
            raise UserError(f"{name}: line {number}", "", None, problem)
        yield number, line


def read_line(text: str) -> tuple[Json, str | None]:
    """The JSON of a line, and its problem as JSON or as an event; None if it is valid."""
    try:
        line = read_json(text.rstrip())
    except json.JSONDecodeError as error:
        return {}, f"not JSON: {error.msg} (column {error.pos + 1})"
    except ValueError as error:
        return {}, f"not JSON: {error}"
    return line, None if is_log(line) else event_problem(line)


def is_log(line: Any) -> bool:
    """Whether a line is a record of a side rather than an event."""
    return isinstance(line, dict) and "log" in line and "event" not in line
