"""Positions of a drive from a bag recorded at the same time, which replace those in its log."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from heapq import merge
from pathlib import Path

from runner.bag import POSITIONS, Bag, Fix
from runner.core.events import PositionReported
from runner.core.model import ModelError
from runner.drive.read import Drive, read_drive, time_span
from runner.errors import ArgumentError, UserError
from runner.system.clocks import SECOND_NS

ARGUMENTS = ("positions", "topic")  # of the command line


@dataclass(frozen=True, slots=True)
class RecordedPositions:
    """The positions of a bag, in time order.

    where  file and topic, for messages
    """

    where: str
    fixes: Sequence[Fix]

    @property
    def span(self) -> str:
        return time_span(self.fixes[0].ns / SECOND_NS, self.fixes[-1].ns / SECOND_NS)

    def since(self, began_s: float) -> Iterator[PositionReported]:
        """The positions as events of a drive that began at `began_s`, s since 1970; earlier ones are left out."""
        for fix in self.fixes:
            t = (fix.ns - round(began_s * SECOND_NS)) / SECOND_NS
            if t >= 0:
                yield PositionReported(t=t, lat=fix.lat, lon=fix.lon)

    def no_overlap(self, drive: str) -> UserError:
        """The error that no position falls into a drive; `drive` describes it with its times."""
        rule = f"no position falls into {drive}; both must have been recorded by the same clock"
        return ArgumentError(ARGUMENTS[0], f"{self.where}: {self.span}", rule)


def reader(values: Mapping[str, str]) -> Callable[[Path], Drive]:
    """The function that reads a command's drives: with the positions that its arguments name, otherwise as logged.

    raises  UserError
    """
    if values.keys().isdisjoint(ARGUMENTS):
        return read_drive
    recorded = given_positions(values)
    return lambda path: with_positions(read_drive(path), recorded)


def given_positions(values: Mapping[str, str]) -> RecordedPositions:
    """The positions that the arguments `positions` and `topic` name.

    raises  UserError
    """
    path, topic = (values.get(key) for key in ARGUMENTS)
    if path is None:
        raise ArgumentError(ARGUMENTS[0], None, "must be given with topic: the bag that has it")
    try:
        with Bag(Path(path)) as bag:
            found = bag.find(POSITIONS, topic, "positions")
            fixes, where = sorted(bag.positions(found)), bag.names(found)
    except ModelError as error:
        key = "topic" if error.key == "topic" and topic is not None else ARGUMENTS[0]
        raise ArgumentError(key, str(error.found), error.rule) from None
    if not fixes:
        raise ArgumentError(ARGUMENTS[0], where, "has no position with a fix")
    return RecordedPositions(where, fixes)


def with_positions(drive: Drive, recorded: RecordedPositions) -> Drive:
    """A drive with the positions of a bag in place of its own.

    raises  UserError if no position falls into it
    """
    name = "vehicle" if "vehicle" in drive.sides else "operator"
    side = drive.sides[name]
    new = [event for event in recorded.since(side.began_s) if event.t <= side.end]
    if not new:
        raise recorded.no_overlap(f"{drive.path}: {side.span}")
    kept = [line for line in side.lines if not isinstance(line, PositionReported)]
    lines = list(merge(kept, new, key=lambda line: line.t))
    return replace(drive, sides={**drive.sides, name: replace(side, lines=lines)})
