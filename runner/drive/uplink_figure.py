"""The figure of several uplinks: what each was allowed, what arrived over it, and its queue. Pure."""

from __future__ import annotations

from collections.abc import Iterable

from runner.drive.charts import Axis, Bars, Chart, Curve
from runner.drive.over_time import KBPS, Drives, Rows, drive_label, over_time, steps, top
from runner.drive.series import Series
from runner.drive.time_series import TimeSeries

STALLED = "shaded: nothing arrives"


def uplinks(drives: Drives) -> Rows | None:
    """Two charts below one another for each drive of a vehicle with several; None: there is none."""
    found = {at: drive.series for at, drive in enumerate(drives) if drive.series.uplinks}
    rates = {at: tuple(_rates(series)) for at, series in found.items()}
    queues = {at: tuple(_queues(series)) for at, series in found.items()}
    rows: Rows = []
    for at in found:
        rows.append([_chart(drives, at, Axis("kbit/s", 0.0, top(rates.values())), rates[at], KBPS)])
        rows.append([_chart(drives, at, Axis("queue in ms", 0.0, top(queues.values())), queues[at], "%{y:.0f} ms")])
    return rows or None


def _chart(drives: Drives, at: int, y: Axis, curves: Iterable[Curve], hover: str) -> Chart:
    series = drives[at].series
    shades = [Bars(name, number, each.stalls) for number, (name, each) in enumerate(series.uplinks.items())]
    title = ", ".join(filter(None, (drive_label(drives, at), STALLED if any(each.spans for each in shades) else "")))
    return over_time(drives, at, title, y, curves, shades=shades, hover=hover)


def _rates(series: Series) -> Iterable[Curve]:
    """By uplink, allowed and received; and the rates of the lanes of a limited link, 0 while they are cut."""
    for number, (lane, link) in enumerate(series.links.items()):
        if lane:
            yield steps(f"lane {lane}", TimeSeries(link.t, link.kbps), series, "text", dash=2 + number, width=0.7)
    for number, (name, each) in enumerate(series.uplinks.items()):
        yield steps(f"{name} allowed", each.allowed, series, number, dash=1)
        yield Curve(f"{name} received", *each.received, number, width=0.8)


def _queues(series: Series) -> Iterable[Curve]:
    return (
        Curve(f"{name} queue", *each.queue_ms, number, width=0.8)
        for number, (name, each) in enumerate(series.uplinks.items())
    )
