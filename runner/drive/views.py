"""What an operator's windows showed of the cameras over time, as a log states it."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from runner.core.events import ViewReported, parse
from runner.core.model import Camera
from runner.core.view import Seen, View
from runner.drive.log import FILES
from runner.drive.read import is_log, read_lines, text_lines
from runner.errors import ConfigError, Problem, UserError, os_errors_as
from runner.records.lines import KINDS, Began

SKIPPED = tuple(kind for record, kind in KINDS.items() if record is not Began)  # kinds of lines that state no view


@dataclass(frozen=True, slots=True)
class Views:
    """By time, s since the beginning of the vehicle's log, ascending, the view in force from then on.

    While a view is empty, or before the first one, nothing is known of what was shown.
    """

    path: Path
    t: tuple[float, ...]
    views: tuple[View, ...]

    def at(self, t: float) -> View:
        number = self.number_at(t)
        return self.views[number] if number >= 0 else {}

    def number_at(self, t: float) -> int:
        """Number of the view in force; -1: none yet."""
        return bisect_right(self.t, t) - 1

    def check(self, cameras: Mapping[str, Camera]) -> None:
        """raises  ConfigError if a view shows more than a camera's image"""
        problems = []
        for name, camera in cameras.items():
            seen = [view[name] for view in self.views if name in view]
            if one := next((each for each in seen if not each.lies_in(camera)), None):
                found = f"{one.width}x{one.height} px at {one.x}, {one.y}"
                rule = f"must lie inside the camera's image of {camera.width}x{camera.height} px"
                problems.append(Problem(str(self.path), f"view.{name}", found, rule))
        if problems:
            raise ConfigError(problems)


def seen_of(view: View, camera: Camera) -> Seen:
    """What a stated view shows of a camera; one that it does not name is shown in full, as large as it is."""
    return view.get(camera.name, Seen(0, 0, camera.width, camera.height, camera.width, camera.height))


def read_views(path: Path, warnings: list[str]) -> Views:
    """The views in a log of events, or in that of a drive's vehicle.

    path    the log, or the directory of the drive
    raises  UserError if it cannot be read, or states no view
    """
    file = path / FILES["vehicle"] if path.is_dir() else path
    events = []
    with os_errors_as(partial(UserError, str(file), "", None)), file.open(encoding="utf-8", errors="replace") as lines:
        for _, line in read_lines(text_lines(lines), str(file), warnings, skipped=SKIPPED):
            if not is_log(line) and isinstance(event := parse(line), ViewReported):
                events.append(event)
    if not any(event.view for event in events):
        rule = "states no view (no event view_reported): the page states it to the vehicle while its driver watches"
        raise UserError(str(file), "", None, rule)
    return Views(file, tuple(event.t for event in events), tuple(event.view for event in events))
