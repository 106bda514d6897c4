"""The figures of the paper's driving test (section V-B), each defined once for print and page. Pure.

Drives can be compared by eye: each has its row of charts, on the same axes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np

from runner.drive.camera_series import CameraSeries
from runner.drive.charts import Axis, Bars, Chart, Curve, Figure, MapTrack, Strip
from runner.drive.latency import SECOND_S, latencies, per_second, to_arrival
from runner.drive.over_time import KBPS, Drives, Rows, drive_label, link_rates, over_time, steps, top
from runner.drive.panels import Panel
from runner.drive.predictions import EVERY_S, Compared, compared
from runner.drive.seen_figure import seen
from runner.drive.series import Positions, Series
from runner.drive.statistics import DriveStatistics
from runner.drive.time_series import FloatSeries, TimeSeries, held
from runner.drive.uplink_figure import uplinks

STEP_OFFSET = 0.014  # of the largest factor, between steps that would overlap
WIDE = 8.0  # latencies that spread over more than this ratio get a logarithmic axis
DECADES = 50.0  # above this ratio fewer values are labelled
QUANTILES = np.concatenate([np.linspace(0, 0.95, 96), np.linspace(0.951, 1, 50)])
ARROWS = 7  # that show the direction of the drive
FLATTEST = 0.4  # shorter side of a map over the longer
SMALLEST_TRACK_M = 20.0  # around a stationary vehicle
METRICS = {"psnr": "PSNR in dB", "mssim": "MSSIM", "vmaf": "VMAF", "brisque": "BRISQUE (lower is better)"}


def figures(drives: Drives) -> tuple[list[Figure], list[str]]:
    """Every figure for which the drives have data, and why others were left out, except those of what they lack."""
    made, left_out = [], []
    for name, (heading, define) in FIGURES.items():
        rows = define(drives)
        if rows is None:
            continue
        if isinstance(rows, str):
            left_out.append(f"{name}: left out, {rows}")
        else:
            made.append(Figure(name, heading, tuple(tuple(row) for row in rows)))
    return made, left_out


# --- the figures ------------------------------------------------------------------------------------------------------


def bitrate_on_track(drives: Drives) -> Rows | str:
    """Total bitrate by colour on the positions of the vehicle (paper, Fig. 5)."""
    tracks = {at: on_track(drive.series) for at, drive in enumerate(drives) if drive.series.positions}
    if not tracks:
        return "no positions were logged"
    known = np.concatenate([kbps for _, kbps in tracks.values()])
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 1.0)

    def chart(at: int, t: FloatSeries, kbps: FloatSeries) -> Chart:
        title = f"total {drives[at].series.measured or 'allocated'} in kbit/s"
        return _on_map(drives, at, TimeSeries(t, kbps), (low, high), title, "%{marker.color:,.0f} kbit/s")

    return [[chart(at, t, kbps)] for at, (t, kbps) in tracks.items()]


def totals(drives: Drives) -> Rows:
    """Predicted, allocated and actual total."""

    def curves(series: Series) -> Iterable[Curve]:
        yield from link_rates(series)
        yield steps("allocated", series.allocated, series, "allocated", width=1.6)
        yield steps("predicted", series.predicted, series, "predicted", dash=1)
        if series.measured:
            yield Curve(series.measured, *series.actual, "actual", width=0.8)

    found = [tuple(curves(drive.series)) for drive in drives]
    y = Axis("total in kbit/s", 0.0, top(found))
    return [[over_time(drives, at, drive_label(drives, at), y, each, hover=KBPS)] for at, each in enumerate(found)]


def predictions(drives: Drives) -> Rows | str:
    """What was predicted against what the link carried; the same over time, with what was learned of it; by place."""
    found = {at: both for at, drive in enumerate(drives) if (both := compared(drive.series))}
    if not found:
        return "no prediction could be compared with what the link carries, which takes 10 s and the rule follow_link"
    every = np.concatenate([np.exp(-both.off[np.isfinite(both.off)]) for both in found.values()])
    most = max(float(np.nanmax(np.fmax(both.predicted, both.carried))) for both in found.values())
    limits = float(np.percentile(every, 5)), float(np.percentile(every, 95))
    rows: Rows = []
    for at, both in found.items():
        rows.append([_calibration(drives, at, both, 1.05 * most)])
        rows += [[_errors(drives, at, both, limits)], [_learned(drives, at)]]
        known = np.isfinite(both.off)
        if drives[at].series.positions:
            percent = TimeSeries(both.t[known], 100 * np.exp(-both.off[known]))
            colours = (100 * limits[0], 100 * limits[1])
            rows.append([_on_map(drives, at, percent, colours, RATIO + " in %", "predicted: %{marker.color:.0f} %")])
    return rows


RATIO = "predicted / carried"


def _calibration(drives: Drives, at: int, both: Compared, most: float) -> Chart:
    """A point for each second, and the line on which predictions are right."""
    each = np.isfinite(both.off)
    each[np.arange(each.size) % round(SECOND_S / EVERY_S) > 0] = False
    ends = np.array([0.0, most])
    curves = (
        Curve("predicted = carried", ends, ends, "text", dash=1),
        Curve("each second", both.predicted[each], both.carried[each], "allocated", points=True),
    )
    x, y = Axis("predicted in kbit/s", 0.0, most), Axis("carried in kbit/s", 0.0, most)
    return Chart(drive_label(drives, at), x, y, curves, drive=None, hover=f"{KBPS} carried, %{{x:,.0f}} predicted:")


def _errors(drives: Drives, at: int, both: Compared, limits: tuple[float, float]) -> Chart:
    """How far predictions were off, and what was believed of it, over time."""
    believed = drives[at].series.believed
    assert believed is not None
    low, mean, high = (np.exp(-believed.bias + n * believed.error) for n in (-1, 0, 1))
    curves = (
        Curve("learned: mean and deviation", believed.t, mean, "predicted", around=(low, high)),
        Curve(RATIO, both.t, np.exp(-both.off), "text", width=0.8),
    )
    low_end, high_end = min(0.5, 0.9 * limits[0]), max(2.0, 1.1 * limits[1])
    marks = tuple(mark for mark in (0.1, 0.25, 0.5, 1.0, 2.0, 4.0, 10.0) if low_end <= mark <= high_end)
    y = Axis(RATIO, low_end, high_end, marks, log=True, percent=True)
    return over_time(drives, at, drive_label(drives, at), y, curves, hover="%{y:.0%}")


def _learned(drives: Drives, at: int) -> Chart:
    """How far changes of predictions came true, and what was kept free for errors, over time."""
    series = drives[at].series
    believed = series.believed
    assert believed is not None
    curves = (
        steps("share of changes that come true", TimeSeries(believed.t, believed.gain), series, "allocated"),
        steps("kept free", TimeSeries(believed.t, 1 - np.exp(-believed.margin)), series, "late", dash=1),
    )
    y = Axis("share", 0.0, 1.05, (0.0, 0.25, 0.5, 0.75, 1.0), percent=True)
    return over_time(drives, at, drive_label(drives, at), y, curves, hover="%{y:.0%}")


def bitrates(drives: Drives) -> Rows:
    """Actual bitrate of each camera (paper, Fig. 6); what was allocated if that is all that is known of a drive."""
    kinds = {drive.series.measured for drive in drives}
    actual = "" not in kinds

    def curves(drive: DriveStatistics, panel: Panel) -> Iterable[Curve]:
        for dash, names in enumerate(coinciding(drive.series, panel, _allocated)):
            if actual:
                lines = [drive.series.cameras[name].actual for name in names]
                yield _mean(_named(names, panel, ": mean and range"), lines, _place(drive, names), dash)
            else:
                line = drive.series.cameras[names[0]].allocated
                yield steps(_named(names, panel), line, drive.series, _place(drive, names), dash=dash)

    kind = "allocated" if not actual else kinds.pop() if len(kinds) == 1 else "actual"
    return _by_panel(drives, curves, lambda _, found: Axis(f"{kind} bitrate in kbit/s", 0.0, top(found)), KBPS)


def scaling(drives: Drives) -> Rows:
    """Resolution factor of each camera; steps that coincide are drawn side by side (paper, Fig. 7)."""
    factors = [{f for panel in d.series.panels for f in _factors(d, panel)} for d in drives]
    reach = max(max(each, default=1.0) for each in factors)

    def curves(drive: DriveStatistics, panel: Panel) -> Iterable[Curve]:
        groups = coinciding(drive.series, panel, _factor)
        used = [set(_factor(drive.series.cameras[names[0]])[1].tolist()) for names in groups]
        meet = any(a & b for a, b in combinations(used, 2))
        for dash, names in enumerate(groups):
            camera = drive.series.cameras[names[0]]
            offset = ((len(groups) - 1) / 2 - dash) * STEP_OFFSET * reach * meet
            label = _named(names, panel) + (f" (offset {offset:+.3f})" if offset else "")
            curve = steps(label, TimeSeries(*_factor(camera)), drive.series, _place(drive, names), dash=dash)
            reasons = tuple(_step_reasons(names, camera, drive.series.end))
            yield replace(curve, y=curve.y + offset, reasons=reasons)

    def axis(part: int, _: Sequence[Sequence[Curve]]) -> Axis:
        panels = [(drive, panel) for drive in drives for panel in drive.series.panels[part : part + 1]]
        marks = tuple(sorted({f for drive, panel in panels for f in _factors(drive, panel)}))
        return Axis("resolution factor", max(0.0, marks[0] - 0.2 * reach), marks[-1] + 0.1 * reach, marks)

    return _by_panel(drives, curves, axis, "")


def latency(drives: Drives) -> Rows | str:
    """Latency over time with freezes, and its distribution."""
    seconds = {at: per_second(drive.series) for at, drive in enumerate(drives) if latencies(drive.series)[1].size}
    if not seconds:
        return "no latency was logged: an operator's log is needed"
    everything = np.concatenate([np.concatenate([each.median, each.p95]) for each in seconds.values()])
    y = _spread("latency in ms", everything[np.isfinite(everything)])
    rows: Rows = []
    for at, each in seconds.items():
        curves = (Curve("95th percentile", each.t, each.p95, "late"), Curve("median", each.t, each.median, "allocated"))
        title = drive_label(drives, at) or "each second" + (", all cameras" if len(drives[at].cameras) > 1 else "")
        rows.append([over_time(drives, at, title, y, curves, _freezes(drives[at]), hover="%{y:.0f} ms")])
    return [*rows, [_distribution(drives, list(seconds))]]


def quality(drives: Drives) -> Rows | str:
    """Quality of each camera by its rate-quality model."""
    metrics = sorted({each.quality.metric for drive in drives for each in drive.cameras.values() if each.quality})
    if not metrics:
        return "no rate-quality models were found"

    def curves(drive: DriveStatistics, panel: Panel) -> Iterable[Curve]:
        for dash, name in enumerate(panel.cameras):
            estimate = drive.cameras[name].quality
            if estimate and estimate.metric == metrics[0]:
                yield Curve(name, *estimate.line, _place(drive, (name,)), dash)

    axis = _quality_axis(f"estimated {METRICS.get(metrics[0], metrics[0])}")
    return _by_panel(drives, curves, axis, "%{y:.4~g}", shared=True)


def delivered(drives: Drives) -> Rows | str:
    """Measured quality of the pictures that the operator saw."""
    if not any(camera.delivered for drive in drives for camera in drive.cameras.values()):
        return (
            "quality of delivered pictures was not measured: drive with log.video=true, then `tod-runner quality DRIVE`"
        )

    def curves(drive: DriveStatistics, panel: Panel) -> Iterable[Curve]:
        for dash, name in enumerate(panel.cameras):
            found = drive.cameras[name].delivered
            if found:
                yield Curve(name, np.array(found.t), np.array(found.mssim), _place(drive, (name,)), dash)

    return _by_panel(drives, curves, _quality_axis("MSSIM delivered"), "%{y:.4~g}", shared=True)


def _quality_axis(title: str) -> Callable[[int, Sequence[Sequence[Curve]]], Axis]:
    """An axis that the values fill."""

    def axis(_: int, found: Sequence[Sequence[Curve]]) -> Axis:
        values = np.concatenate([np.empty(0), *(curve.y for each in found for curve in each)])
        known = values[np.isfinite(values)]
        low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 1.0)
        room = 0.05 * (high - low or 1.0)
        return Axis(title, low - room, high + room)

    return axis


# Heading and definition by name, in the order of the page.
FIGURES: dict[str, tuple[str, Callable[[Drives], Rows | str | None]]] = {
    "bitrate_on_track": ("Total bitrate on the track", bitrate_on_track),
    "totals": ("Predicted, allocated and actual total", totals),
    "uplinks": ("Uplinks over time", uplinks),
    "predictions": ("What predictions were worth", predictions),
    "bitrates": ("Camera bitrates over time", bitrates),
    "scaling": ("Resolution factors over time", scaling),
    "latency": ("Latency and freezes", latency),
    "quality": ("Estimated quality over time", quality),
    "delivered": ("Measured quality of delivered pictures", delivered),
    "seen": ("Measured quality on the screen", seen),
}


# --- cameras and panels -----------------------------------------------------------------------------------------------


def coinciding(
    drive: Series, panel: Panel, key: Callable[[CameraSeries], tuple[FloatSeries, FloatSeries]]
) -> list[tuple[str, ...]]:
    """The cameras of a panel in groups whose quantity is the same at all times."""
    groups: dict[tuple[bytes, bytes], list[str]] = {}
    for name in panel.cameras:
        t, values = key(drive.cameras[name])
        groups.setdefault((t.tobytes(), values.tobytes()), []).append(name)
    return [tuple(names) for names in groups.values()]


def _allocated(camera: CameraSeries) -> tuple[FloatSeries, FloatSeries]:
    return camera.allocated


def _factor(camera: CameraSeries) -> tuple[FloatSeries, FloatSeries]:
    return camera.decided.t, np.where(camera.decided.sending, camera.decided.scaling, np.nan)


def _named(names: Sequence[str], panel: Panel, more: str = "") -> str:
    if len(names) == 1:
        return names[0]
    return (f"all {len(names)} cameras" if len(names) == len(panel.cameras) else ", ".join(names)) + more


def _place(drive: DriveStatistics, names: Sequence[str]) -> int:
    return list(drive.series.cameras).index(names[0])


def _mean(label: str, lines: Sequence[TimeSeries], colour: int, dash: int) -> Curve:
    """Mean of lines at the times of the first, with the lowest and the highest."""
    if len(lines) == 1 or not lines[0].t.size:
        return Curve(label, *lines[0], colour, dash)
    t = lines[0].t
    values = np.array([np.interp(t, *line) if line.t.size else np.full(t.shape, np.nan) for line in lines])
    return Curve(label, t, values.mean(axis=0), colour, dash, around=(values.min(axis=0), values.max(axis=0)))


def _factors(drive: DriveStatistics, panel: Panel) -> set[float]:
    """Factors that the cameras of a panel may use, and those that were in force."""
    described = drive.series.config.get("cameras") or {}
    ladders = [(described.get(name) or {}).get("rate_quality", {}).get("scaling", ()) for name in panel.cameras]
    used = [drive.cameras[name].factors for name in panel.cameras if name in drive.cameras]
    return {float(factor) for each in (*ladders, *used) for factor in each if factor} or {1.0}


def _step_reasons(names: Sequence[str], camera: CameraSeries, end: float) -> Iterable[str]:
    """For each step of a factor, the time, the factor and the reason."""
    decided = camera.decided
    reasons = [
        f"{', '.join(names)} from {t:.1f} s: {'off' if np.isnan(factor) else f'{factor:g}'}\n{reason}"
        for t, factor, reason in zip(*_factor(camera), decided.reason, strict=True)
    ]
    return reasons + reasons[-1:] if reasons and decided.t[-1] < end else reasons


def _by_panel(
    drives: Drives,
    curves: Callable[[DriveStatistics, Panel], Iterable[Curve]],
    axis: Callable[[int, Sequence[Sequence[Curve]]], Axis],
    hover: str,
    *,
    shared: bool = False,
) -> Rows:
    """A row for each drive, a chart for each panel of cameras; charts below one another share an axis, or all do."""
    found = {
        (at, part): tuple(curves(drive, panel))
        for at, drive in enumerate(drives)
        for part, panel in enumerate(drive.series.panels)
    }
    rows: Rows = [[] for _ in drives]
    for (at, part), each in found.items():
        y = axis(part, [those for (_, other), those in found.items() if shared or other == part])
        title = ": ".join(filter(None, (drive_label(drives, at), drives[at].series.panels[part].title)))
        rows[at].append(over_time(drives, at, title, y, each, part=part, hover=hover))
    return rows


# --- latency ----------------------------------------------------------------------------------------------------------


def _spread(title: str, shown: FloatSeries) -> Axis:
    """An axis for some latencies: logarithmic if they spread widely and all are above 0."""
    low, high = float(np.min(shown)), float(np.max(shown))
    if low <= 0 or high / low <= WIDE:
        return Axis(title, min(0.0, low), high * 1.05)
    digits = (1, 3) if high > DECADES * low else (1, 2, 5)
    marks = (digit * 10.0**power for power in range(-1, 6) for digit in digits)
    return Axis(title, low * 0.95, high * 1.05, tuple(each for each in marks if low <= each <= high), log=True)


def _freezes(drive: DriveStatistics) -> Strip:
    """A row for each camera that froze."""
    frozen = [(place, camera) for place, camera in enumerate(drive.cameras.values()) if camera.freezes]
    bars = (Bars(camera.name, place, tuple(camera.freezes or ())) for place, camera in frozen)
    none = "arrivals were not logged: freezes are not known" if drive.freezes is None else "no freezes"
    return Strip(tuple(bars), none)


def _distribution(drives: Drives, known: Sequence[int]) -> Chart:
    """Cumulative share of frames over latency: of each camera, or of each drive if there are several."""
    title, curves = "distribution", []
    if len(drives) == 1:
        series = drives[0].series
        each = [(name, latencies(series, name)[1], place) for place, name in enumerate(series.cameras)]
        curves = [_shares(name, values, place) for name, values, place in each if values.size]
        if len(curves) > 1:
            curves.append(_shares("all cameras", latencies(series)[1], "text", dash=1, width=1.6))
    else:
        title = "distribution, all cameras"
        for number, at in enumerate(known):
            series = drives[at].series
            curves.append(_shares(series.label, latencies(series)[1], number, dash=number, width=1.4))
    arrived = any(to_arrival(drives[at].series) for at in known)
    everything = np.concatenate([curve.x[:-1] for curve in curves])  # the last thousandth would compress all others
    x = _spread(f"latency from capture to {'arrival' if arrived else 'decode'} in ms", everything)
    y = Axis("share of frames", 0.0, 1.01, (0.0, 0.25, 0.5, 0.75, 0.95), percent=True)
    return Chart(title, x, y, tuple(curves), drive=None, part=1, hover="%{x:.0f} ms or less: %{y:.1%} of the frames")


def _shares(label: str, values: FloatSeries, colour: int | str, **more: Any) -> Curve:
    return Curve(label, np.quantile(values, QUANTILES), QUANTILES, colour, **more)


# --- the map ----------------------------------------------------------------------------------------------------------


def _on_map(drives: Drives, at: int, line: TimeSeries, limits: tuple[float, float], title: str, hover: str) -> Chart:
    """A quantity by colour on the positions of the vehicle. title: of the colours, which cover the limits."""
    places = drives[at].series.positions
    assert places is not None
    xlim, ylim = _limits(places)
    way = (places.east, places.north)
    east, north = (np.interp(line.t, places.t, each) for each in way)
    track = MapTrack(way, line.t, east, north, line.y, *limits, title, tuple(_arrows(*way)))
    x, y = Axis("m east of the start", *xlim), Axis("m north", *ylim)
    return Chart(drive_label(drives, at), x, y, drive=at, track=track, hover=hover)


def on_track(drive: Series) -> TimeSeries:
    """Total bitrate while positions are known, kbit/s: as measured, or as allocated if nothing was."""
    places = drive.positions
    assert places is not None
    t = drive.actual.t if drive.measured else places.t
    t = t[(t >= places.t[0]) & (t <= places.t[-1])]
    kbps = np.interp(t, *drive.actual) if drive.measured else held(drive.allocated, t)
    return TimeSeries(t[np.isfinite(kbps)], kbps[np.isfinite(kbps)])


def _limits(places: Positions) -> tuple[tuple[float, float], tuple[float, float]]:
    """Limits of the map, m east and north: room around the track, and no side too short for the colour bar."""
    spans = [float(np.ptp(each)) for each in (places.east, places.north)]
    least = max(FLATTEST * max(spans), SMALLEST_TRACK_M)
    room = 0.06 * max(*spans, SMALLEST_TRACK_M)
    found = []
    for values, span in zip((places.east, places.north), spans, strict=True):
        middle, half = float(np.min(values) + np.max(values)) / 2, max(span, least) / 2 + room
        found.append((middle - half, middle + half))
    return found[0], found[1]


def _arrows(x: FloatSeries, y: FloatSeries) -> Iterable[tuple[float, float, float]]:
    """Arrows along the track, at even distances."""
    way = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    for share in np.arange(1, ARROWS + 1) / (ARROWS + 1) if way[-1] > SMALLEST_TRACK_M else ():
        at = int(np.searchsorted(way, share * way[-1]))
        before = int(np.searchsorted(way, share * way[-1] - 0.01 * way[-1]))
        yield float(x[at]), float(y[at]), float(np.degrees(np.arctan2(y[at] - y[before], x[at] - x[before])))
