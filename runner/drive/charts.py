"""Neutral descriptions of charts, which print and page both draw. A figure is rows of them. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from runner.drive.time_series import FloatSeries


class Axis(NamedTuple):
    """marks: the labelled values; none leaves the choice to the renderer."""

    title: str
    low: float
    high: float
    marks: tuple[float, ...] = ()
    log: bool = False
    percent: bool = False


@dataclass(frozen=True, slots=True)
class Curve:
    """A quantity, in the units of the axes.

    colour     index of a camera in the palette, or the name of a colour of the style sheet
    dash       index of the dash pattern, which distinguishes curves without colour
    around     lowest and highest of the cameras whose mean is the curve
    steps      each value is in force until the next
    filled     down to 0, without a line
    points     without a line
    reasons    for each value, shown on hover
    """

    label: str
    x: FloatSeries
    y: FloatSeries
    colour: int | str
    dash: int = 0
    width: float = 1.0
    around: tuple[FloatSeries, FloatSeries] | None = None
    steps: bool = False
    filled: bool = False
    points: bool = False
    reasons: tuple[str, ...] = ()


class Bars(NamedTuple):
    """Spans of time of one camera or uplink: (start, duration), s."""

    label: str
    colour: int
    spans: tuple[tuple[float, float], ...]


class Strip(NamedTuple):
    """Rows of bars below a chart, on its time axis; and the text shown if there are none."""

    bars: tuple[Bars, ...]
    none: str


class MapTrack(NamedTuple):
    """Positions, m, a quantity at some of them, and arrows (m, m, degrees from east to north) along the track."""

    way: tuple[FloatSeries, FloatSeries]
    t: FloatSeries
    east: FloatSeries
    north: FloatSeries
    values: FloatSeries
    low: float
    high: float
    title: str
    arrows: tuple[tuple[float, float, float], ...]


@dataclass(frozen=True, slots=True)
class Chart:
    """One pair of axes.

    drive   its index among the drives, None for a chart of all of them, or one that is not over time
    unit_s  unit of a time axis, s
    shades  spans that are shaded over the whole height
    hover   plotly's format of a value
    """

    title: str
    x: Axis
    y: Axis
    curves: tuple[Curve, ...] = ()
    drive: int | None = 0
    part: int = 0
    unit_s: float = 1.0
    strip: Strip | None = None
    shades: tuple[Bars, ...] = ()
    track: MapTrack | None = None
    hover: str = ""


class Figure(NamedTuple):
    """rows: charts side by side."""

    name: str
    heading: str
    rows: tuple[tuple[Chart, ...], ...]
