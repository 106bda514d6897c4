"""The course of the synthetic drive, and how the vehicle follows it.

The course is one lap of an endless street, each lap shifted by `period_m` in x: that closes the loop
without the full turn of a ring road, where every camera would pan most of the time and a forward one would see nearly
as much motion as one that looks sideways.
Axes as in ROS REP 103: x along the street, y left, z up; d is the offset left of the centre line. Metres, radians.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

Array = np.ndarray[Any, Any]

SPEED_MPS = 12.0
LONGEST_LAP_S = 13.0  # a longer drive repeats the lap: textures stay small and sharp
LANE_D = -1.2  # the vehicle drives on the right
TIGHTEST_M = 14.0  # bend radius of the centre line; above WALL_D, or the inner wall would fold


@dataclass(frozen=True)
class Course:
    """One lap of the centre line, sampled at equal arc lengths; the first sample of the next lap ends it.

    Two straights at +A and -A to the x axis with a bend between: psi(s) = A tanh(2.2 sin(2 pi s / L)) / tanh(2.2)
    """

    laps: int
    length_m: float
    s: Array
    x: Array
    y: Array
    psi: Array
    log2_columns: int  # of the ground's texture; that of the walls has twice as many

    @property
    def period_m(self) -> float:
        return float(self.x[-1])

    def at(self, share: float) -> tuple[float, float, float]:
        """Position and heading of the vehicle after a share of the drive, in [0, 1]."""
        s = share * self.laps % 1 * self.length_m
        x, y, psi = (float(np.interp(s, self.s, values)) for values in (self.x, self.y, self.psi))
        return x - LANE_D * math.sin(psi), y + LANE_D * math.cos(psi), psi

    def steering(self, share: float, wheelbase_m: float) -> float:
        """Angle of the front wheels there, to the left: the rear axle follows the lane (bicycle model without slip)."""
        bend = float(np.interp(share * self.laps % 1 * self.length_m, self.s, np.gradient(self.psi, self.s)))
        return math.atan(wheelbase_m * bend / (1 - LANE_D * bend))

    def beside(self, d: float) -> tuple[Array, Array]:
        """The line at offset d."""
        return self.x - d * np.sin(self.psi), self.y + d * np.cos(self.psi)


def plan_course(seconds: float) -> Course:
    """The course of a drive of this length at 12 m/s."""
    laps = math.ceil(seconds / LONGEST_LAP_S)
    length = SPEED_MPS * seconds / laps
    s = np.linspace(0, length, 4097)
    steepest = 2.2 / math.tanh(2.2) * 2 * math.pi / length
    swing = min(0.3, 1 / (TIGHTEST_M * steepest))
    psi = swing * np.tanh(2.2 * np.sin(2 * math.pi * s / length)) / math.tanh(2.2)

    def integral(slope: Array) -> Array:
        return np.concatenate([[0.0], np.cumsum((slope[1:] + slope[:-1]) / 2 * np.diff(s))])

    return Course(laps, length, s, integral(np.cos(psi)), integral(np.sin(psi)), psi, 13 if length > 80 else 12)
