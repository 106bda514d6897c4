"""Where a camera is: on the vehicle, and on the operator's page."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import islice


@dataclass(frozen=True, slots=True)
class Pose:
    """Where a camera is mounted on the vehicle, in the axes of ROS REP 103: x forward, y left, z up.

    The origin is on the ground below the rear axle. Metres and degrees; yaw turns left,
    pitch tilts the view down, roll tilts it clockwise.
    """

    x_m: float
    y_m: float
    z_m: float
    yaw_deg: float
    pitch_deg: float = 0.0
    roll_deg: float = 0.0


@dataclass(frozen=True, slots=True)
class Place:
    """Tile on the operator's page, counted from the top left, and how many rows and columns it covers."""

    row: int
    column: int
    row_span: int = 1
    column_span: int = 1

    def overlaps(self, other: Place) -> bool:
        """Whether both cover the same row of the same column."""
        rows = self.row < other.row + other.row_span and other.row < self.row + self.row_span
        columns = self.column < other.column + other.column_span and other.column < self.column + self.column_span
        return rows and columns


def overlapping(places: Mapping[str, Place]) -> Iterator[tuple[str, str, str]]:
    """Cameras whose tile overlaps an earlier camera's, each with the rule that it breaks, and that camera."""
    for count, (name, place) in enumerate(places.items()):
        overlapped = next((other for other, its in islice(places.items(), count) if place.overlaps(its)), None)
        if overlapped is not None:
            yield name, f"overlaps the place of camera {overlapped}", overlapped
