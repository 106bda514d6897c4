"""Charts of drives over time, below one another. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from runner.drive.charts import Axis, Bars, Chart, Curve, Strip
from runner.drive.series import Series
from runner.drive.statistics import DriveStatistics
from runner.drive.time_series import TimeSeries, held

MINUTES_FROM_S = 900.0
KBPS = "%{y:,.0f} kbit/s"

Drives = Sequence[DriveStatistics]
Rows = list[list[Chart]]


def drive_label(drives: Drives, at: int) -> str:
    """The label that distinguishes a drive from others."""
    return drives[at].series.label if len(drives) > 1 else ""


def _unit(drives: Drives) -> tuple[float, str]:
    """Unit of the time axis in s, and its label."""
    long = max(drive.series.end for drive in drives) > MINUTES_FROM_S
    return (60.0, "time in min") if long else (1.0, "time in s")


def over_time(
    drives: Drives,
    at: int,
    title: str,
    y: Axis,
    curves: Iterable[Curve],
    strip: Strip | None = None,
    shades: Iterable[Bars] = (),
    **more: Any,
) -> Chart:
    """A chart of one drive, from curves, bars and shades over s."""
    unit, label = _unit(drives)
    x = Axis(label, 0.0, max(drive.series.end for drive in drives) / unit)
    if strip:
        strip = strip._replace(bars=_scaled(strip.bars, unit))
    curves = tuple(replace(curve, x=curve.x / unit) for curve in curves)
    return Chart(title, x, y, curves, drive=at, unit_s=unit, strip=strip, shades=_scaled(shades, unit), **more)


def _scaled(each: Iterable[Bars], unit: float) -> tuple[Bars, ...]:
    return tuple(bars._replace(spans=tuple((t / unit, s / unit) for t, s in bars.spans)) for bars in each)


def steps(label: str, line: TimeSeries, series: Series, colour: int | str, **more: Any) -> Curve:
    """A step curve, extended to the end of the drive."""
    t, y = line
    if t.size and t[-1] < series.end:
        t, y = np.append(t, series.end), np.append(y, y[-1])
    return Curve(label, t, y, colour, steps=True, **more)


def top(found: Iterable[Iterable[Curve]]) -> float:
    """The largest value of curves of all drives, with some room."""
    tops = [each.around[1] if each.around else each.y for curves in found for each in curves]
    known = np.concatenate([np.zeros(1), *tops])
    return float(np.nanmax(known)) * 1.05 or 1.0


def link_rates(series: Series) -> Iterable[Curve]:
    """The rate of a limited link; of one with lanes their total, and each of them."""
    rates = {lane: TimeSeries(link.t, link.kbps) for lane, link in series.links.items()}
    if rates:
        t = np.unique(np.concatenate([rate.t for rate in rates.values()]))
        total = np.sum([held(rate, t) for rate in rates.values()], axis=0)
        yield steps("link's rate", TimeSeries(t, total), series, "link", filled=True)
    for number, (lane, rate) in enumerate(rates.items()):
        if lane:
            yield steps(f"lane {lane}", rate, series, "text", dash=2 + number, width=0.7)
