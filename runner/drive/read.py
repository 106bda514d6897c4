"""Drives on disk, read back and checked."""

from __future__ import annotations

import json
from bisect import bisect_right
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import partial
from itertools import accumulate, chain
from pathlib import Path
from statistics import median
from typing import Any, TextIO, TypeVar

from msgspec import UNSET

from runner.core.events import Event, parse
from runner.drive.log import FILES, FORMAT
from runner.errors import UserError, os_errors_as
from runner.records import Json, from_json
from runner.records.lines import KINDS, Began, ClockSet, Ended, LinesDropped, LinkSample, Record, line_from_json
from runner.records.operator import Sample
from runner.records.reception import ReceptionReported
from runner.schema import event_problem, log_problem, read_json
from runner.system.clocks import KEPT_S
from runner.system.files import directory_problem

T = TypeVar("T")
DRIVEN = {"vehicle", "operator"}  # sides without which a directory holds no drive
REPORTS = KINDS[ReceptionReported]
# Kinds of lines in a vehicle's log, except events, reception reports and the first line.
OTHER_KINDS = ("decision", "telemetry", "note", "video", "video_shift", "clock_set")
# Kinds that several threads write, perhaps in another order than they read the time: by any amount, if the process was
# stopped in between. Readers put them into order.
OF_SEVERAL_THREADS = {"note", "state", "video", "video_shift", "clock_set", "dropped"}
SET_S = 1.0  # a measured difference of the clocks that changes by more: one was set
MOST_COMPARED = 1000  # measured differences of the clocks from which a side's start is found
LONGEST_GAP_S = 86_400.0  # between two lines of a drive: both sides log several times a second
LONGEST_LINE = 1 << 24  # characters; the longest real line, the configuration, has a thousandth of that


@dataclass(frozen=True)
class Side:
    """The log of one side.

    began        its first line, with the time of its own clock
    began_s      its start, s since 1970 by the vehicle's clock as it was set last; by its own clock if the difference
                 of the two was not measured
    corrections  what has to be added to times of the vehicle's clock before each time at which it was set, s; last 0
    lines        events and records between its first line and the end, in order
    ended        whether it was closed cleanly
    """

    began: Began
    began_s: float
    corrections: tuple[float, ...]
    lines: list[Event | Record]
    ended: bool

    def of(self, kind: type[T]) -> Iterator[T]:
        """Its lines of a kind."""
        return (line for line in self.lines if isinstance(line, kind))

    @property
    def first(self) -> Began:
        """Its first line with the corrected start."""
        return replace(self.began, time=self.began_s)

    @property
    def end(self) -> float:
        """Time of its last line."""
        return self.lines[-1].t if self.lines else 0.0

    @property
    def span(self) -> str:
        """When it was logged, as text."""
        return time_span(self.began_s, self.began_s + self.end)

    def corrected(self, shown_s: float, t: float) -> float:
        """A time by the vehicle's clock as it was near time `t` of this log, by the clock as it is in the end.

        shown_s  s since 1970
        """
        return min((shown_s + by_s for by_s in self.corrections), key=lambda at: abs(at - self.began_s - t))


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

    @property
    def replayed(self) -> tuple[str, ...] | None:
        """Words of the replay that decided it; None: it was driven."""
        leading = self.sides.get("vehicle") or self.sides["operator"]
        return None if leading.began.replayed is UNSET else leading.began.replayed


def time_span(began_s: float, ended_s: float) -> str:
    """A span of time, s since 1970, as text."""
    began, ended = (datetime.fromtimestamp(at, UTC).isoformat(timespec="seconds") for at in (began_s, ended_s))
    return f"{began.removesuffix('+00:00')} to {ended.removesuffix('+00:00')} UTC"


def read_drive(directory: Path) -> Drive:
    """Everything in the directory of a drive.

    raises  UserError with file and line of the first error
    """
    where = str(directory)
    if why := directory_problem(directory):
        raise UserError(where, "", None, why.replace("a directory", "a directory that log= wrote"))
    warnings: list[str] = []
    files = {side: directory / name for side, name in FILES.items()}
    present = {side: path for side, path in files.items() if path.is_file()}
    logged = {side: path for side, path in present.items() if path.stat().st_size}
    if logged.keys() & DRIVEN:  # a side that was killed before it began leaves an empty file
        empty = [path for side, path in present.items() if side not in logged]
        warnings += [f"{path}: is empty: nothing was logged" for path in empty]
        present = logged
    sides = {side: _side(side, path, warnings) for side, path in present.items()}
    _check_one_vehicle(where, sides)
    if not sides.keys() & DRIVEN:
        raise UserError(where, "", None, f"contains no drive log: neither {FILES['vehicle']} nor {FILES['operator']}")
    if sides.keys() >= DRIVEN:
        sides["operator"] = _by_clock_of(sides["vehicle"], sides["operator"])
    return Drive(directory, sides, warnings)


def read_link(directory: Path) -> list[LinkSample]:
    """What the limited link of a drive logged: at each change of its rate, and ten times a second.

    raises  UserError with file and line of the first error, or if the drive had no limited link, or one of lanes
    """
    path = directory / FILES["link"]
    samples = list(_side("link", path, []).of(LinkSample)) if path.is_file() else []
    if not samples:
        rule = f"has no rates in {FILES['link']}: must be a drive over a limited link, which link= sets"
        raise UserError(str(directory), "", None, rule)
    if any(sample.lane for sample in samples):
        raise UserError(str(directory), "", None, "has lanes: must be a drive over a link without them")
    return samples


def _check_one_vehicle(where: str, sides: Mapping[str, Side]) -> None:
    names = {side: sides[side].began.config.get("name") for side in sorted(DRIVEN & sides.keys(), reverse=True)}
    if len(set(names.values()) - {None}) > 1:
        logs = " and ".join(f"{FILES[side]} of {name}" for side, name in names.items())
        raise UserError(where, "", None, f"holds the logs of two vehicles, {logs}; each needs a directory of its own")


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
    in_order = sorted(records[:-1] if ended else records, key=lambda line: line.t)
    found = _by_last_clock(Side(began, began.time, (0.0,), in_order, ended))
    if dropped := sum(line.lines for line in found.of(LinesDropped)):
        warnings.append(f"{path}: {dropped} lines were dropped, since the disk was too slow")
    for was in found.of(ClockSet):
        warnings.append(f"{path}: the clock was set by {was.by_s:+.6g} s at {was.t:.1f} s; earlier times are corrected")
    return found


# --- clocks -----------------------------------------------------------------------------------------------------------


def _by_last_clock(side: Side) -> Side:
    """A side with its start by the vehicle's clock as its own log knows it, in the end."""
    ahead_s = _ahead_s(side)
    if ahead_s:
        return replace(side, began_s=side.began.time + ahead_s[-1], corrections=_corrections(ahead_s))
    corrections = _corrections([0.0, *accumulate(line.by_s for line in side.of(ClockSet))])
    return replace(side, began_s=side.began.time + corrections[0], corrections=corrections)


def _by_clock_of(vehicle: Side, operator: Side) -> Side:
    """The operator's side with its start by the vehicle's clock in the end, which may have been set after its end.

    Each correction yields another start. In the right one, the difference of the clocks changes when the vehicle's log
    says that its clock was set.
    """
    measured = list(chain.from_iterable(_measured(operator)))
    if not measured:
        return replace(operator, corrections=vehicle.corrections)
    compared = measured[:: 1 + len(measured) // MOST_COMPARED]
    set_at = [vehicle.began_s + line.t for line in vehicle.of(ClockSet)][: len(vehicle.corrections) - 1]

    def off_s(began_s: float) -> float:
        """By how much the measured differences contradict a start."""
        corrected = (ahead_s + vehicle.corrections[bisect_right(set_at, began_s + t)] for t, ahead_s in compared)
        return round(sum(abs(operator.began.time + by_s - began_s) for by_s in corrected), 3)

    first_s = operator.began.time + _ahead_s(operator)[0]
    began_s = min((first_s + by_s for by_s in vehicle.corrections), key=off_s)
    return replace(operator, began_s=began_s, corrections=vehicle.corrections)


def _corrections(ahead_s: Sequence[float]) -> tuple[float, ...]:
    return tuple(ahead_s[-1] - each for each in ahead_s)


def _ahead_s(side: Side) -> list[float]:
    """How far the vehicle's clock was ahead of this side's own if that had never been set, s.

    One value for each setting of the vehicle's clock; none if the difference was not measured.
    """
    # The clocks drift, and `t` does not follow one that is slewed.
    return [median(ahead_s for t, ahead_s in each if t - each[0][0] <= KEPT_S) for each in _measured(side)]


def _measured(side: Side) -> list[list[tuple[float, float]]]:
    """By setting of the vehicle's clock, time and difference as measured, s; none is empty."""
    found: list[list[tuple[float, float]]] = []
    own_s = 0.0
    for line in side.lines:
        if isinstance(line, ClockSet):
            own_s += line.by_s
        elif isinstance(line, Sample) and line.clock_bound_ms is not None:
            measured = (line.t, (line.clock_ahead_ms or 0.0) / 1000 + own_s)
            if not found or abs(found[-1][-1][1] - measured[1]) > SET_S:
                found.append([])
            found[-1].append(measured)
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

    raises  UserError with the number of the first line that is invalid or out of order
    """
    drive, order = False, _Order()
    for number, text in enumerate(lines, 1):
        if len(text) > LONGEST_LINE:
            raise UserError(f"{name}: line {number}", "", None, f"must be at most {LONGEST_LINE} characters long")
        line, problem = read_line(text)
        if is_log(line):
            drive = True
            if line["log"] in skipped:
                continue
            problem = problem or log_problem(line)
        problem = problem or order.problem(line)
        if problem and drive and not text.endswith("\n"):
            warnings.append(f"{name}: line {number} is truncated and was skipped")
            return
        if problem:
            raise UserError(f"{name}: line {number}", "", None, problem)
        yield number, line


class _Order:
    """Checks that lines are those of one drive, in the order of time."""

    def __init__(self) -> None:
        self._before: Json | None = None
        self._last: dict[str, float] = {}  # by kind
        self._latest = 0.0

    def problem(self, line: Json) -> str | None:
        """What is wrong with the next line, which satisfies its schema."""
        before, self._before = self._before, line
        kind, t = line["log"] if is_log(line) else "event", line["t"]
        if kind == "began" and before:
            return "a second drive begins here; each needs a directory of its own"
        if before and before.get("log") == "ended":
            return "the drive ended with the line before; each drive needs a directory of its own"
        if kind not in OF_SEVERAL_THREADS and t < self._last.get(kind, 0.0):
            return f"t: {t}: must not decrease; the {kind} before was at {self._last[kind]}"
        if self._last.get("began") is not None and t > self._latest + LONGEST_GAP_S:
            return f"t: {t}: must be at most a day after the line before, at {self._latest}"
        self._last[kind], self._latest = t, max(self._latest, t)
        return None


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
