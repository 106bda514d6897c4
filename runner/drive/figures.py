"""The figures of the paper's driving test (section V-B) from real drives, in a column's width, as PNG and PDF.

Several drives share one figure: a row of panels for each, on the same axes.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib as mpl

mpl.use("Agg")  # no screen

import numpy as np
from matplotlib.collections import PathCollection
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.markers import MarkerStyle
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, MaxNLocator, NullFormatter
from matplotlib.transforms import ScaledTranslation

from runner.drive.colours import ACTUAL, ALLOCATED, DAY, LINK, PREDICTED, colours
from runner.drive.series import Line, Panel, Positions, Series, Values, held
from runner.drive.statistics import Statistics, latencies, per_second, to_arrival
from runner.files import write_whole

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from runner.model import Progress

WIDTH_IN = 3.5  # a column of an IEEE paper
FORMATS = ("png", "pdf")
STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 7,
    "axes.labelsize": 7,
    "axes.titlesize": 7,
    "axes.titlelocation": "left",
    "axes.linewidth": 0.6,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e2e6ea",
    "grid.linewidth": 0.5,
    "xtick.labelsize": 6.5,
    "ytick.labelsize": 6.5,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "lines.linewidth": 0.9,
    "legend.fontsize": 6.5,
    "legend.frameon": False,
    "legend.handlelength": 2.0,
    "legend.columnspacing": 1.0,
    "legend.handletextpad": 0.5,
    "legend.borderaxespad": 0.0,
    "text.parse_math": False,  # a drive's name may hold any character
    "pdf.fonttype": 42,  # fonts as text, as journals want them
    "savefig.dpi": 300,
}
LEGEND_IN = 0.38  # under the panel: below the numbers and the label of the time axis
DASHES: tuple[Any, ...] = ("-", (0, (5, 1.2)), (0, (1.4, 0.9)), (0, (5, 1, 1.2, 1)))  # by place in a panel
APART = 0.014  # of the axis, between steps that would lie on one another
MINUTES_FROM_S = 900.0
DECADES = 50.0  # over more than this ratio fewer latencies are numbered
WIDE = 8.0  # latencies that spread over more than this ratio are drawn on a logarithmic axis
SEEN = 0.006  # of the axis: the least width of a freeze that is seen
ARROWS = 7  # that show the direction of the drive
METRICS = {"psnr": "PSNR in dB", "mssim": "MSSIM", "vmaf": "VMAF", "brisque": "BRISQUE (lower is better)"}
FLATTEST = 0.4  # shorter side of a map over the longer
SMALLEST_TRACK_M = 20.0  # around a vehicle that stands

Rows = Sequence[Statistics]


def write_figures(drives: Rows, directory: Path, progress: Progress) -> tuple[list[str], list[str]]:
    """Write every figure that the drives have the data for.

    returns  names of the figures, each written as .png and .pdf; and why others were left out
    raises   RunError where a file cannot be written
    """
    written, left_out = [], []
    for number, (name, draw) in enumerate(FIGURES.items()):
        progress("figures", number / len(FIGURES))
        with mpl.rc_context(STYLE):
            made = draw(drives)
            if isinstance(made, str):
                left_out.append(f"{name}: left out, {made}")
                continue
            for form in FORMATS:
                write_whole(directory / f"{name}.{form}", _rendered(made, form))
        written.append(name)
    progress("figures", 1.0)
    return written, left_out


def _rendered(figure: Figure, form: str) -> bytes:
    buffer = io.BytesIO()
    # Without a date in it the same drive gives the same file.
    figure.savefig(buffer, format=form, metadata={"CreationDate": None} if form == "pdf" else None)
    return buffer.getvalue()


# --- the figures ------------------------------------------------------------------------------------------------------


def bitrate_on_track(drives: Rows) -> Figure | str:
    """Total bitrate by colour on the positions of the vehicle (paper, Fig. 5)."""
    shown = [drive.series for drive in drives if drive.series.positions]
    if not shown:
        return "no positions were logged"
    tracks = [_on_track(drive) for drive in shown]
    known = np.concatenate([kbps for *_, kbps in tracks])
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 1.0)
    height = sum(_height(drive.positions) for drive in shown if drive.positions)
    figure = Figure(figsize=(WIDTH_IN, height), layout="constrained")
    grid = figure.subplots(len(shown), squeeze=False)[:, 0]
    for axes, drive, (east, north, kbps) in zip(grid, shown, tracks, strict=True):
        points = axes.scatter(east, north, c=kbps, s=7, lw=0, cmap=_viridis(), vmin=low, vmax=high, zorder=2)
        _mark_way(axes, drive)
        _dress_map(axes, drive, titled=len(shown) > 1)
        _colour_bar(figure, axes, points, drive)
    return figure


def bitrates(drives: Rows) -> Figure | str:
    """Actual bitrate of each camera (paper, Fig. 6)."""
    if not any(drive.series.measured for drive in drives):
        return "neither what was sent nor what was received was logged"

    def draw(axes: Axes, drive: Statistics, panel: Panel) -> None:
        for name, style in _styles(drive.series, panel):
            line = drive.series.cameras[name].actual
            axes.plot(line.t / _unit(drives)[0], line.y, **style)

    figure, grid = _by_panel(drives, draw, f"{_measured(drives)} bitrate in kbit/s")
    for axes in grid.flat:
        axes.set_ylim(bottom=0)
    return figure


def scaling(drives: Rows) -> Figure:
    """Resolution factor of each camera; steps that coincide are drawn side by side (paper, Fig. 7)."""
    reach = max((max(_factors(drive, panel)) for drive in drives for panel in drive.series.panels), default=1.0)

    def draw(axes: Axes, drive: Statistics, panel: Panel) -> None:
        for place, (name, style) in enumerate(_styles(drive.series, panel)):
            decided = drive.series.cameras[name].decided
            offset = ((len(panel.cameras) - 1) / 2 - place) * APART * reach
            values = np.where(decided.sending, decided.scaling, np.nan) + offset
            t, y = _until(Line(decided.t, values), drive.series.end)
            axes.step(t / _unit(drives)[0], y, where="post", **style)

    figure, grid = _by_panel(drives, draw, "resolution factor")
    for number, column in enumerate(grid.T):
        shown = [panel for drive in drives for panel in drive.series.panels[number : number + 1]]
        marks = sorted({f for drive in drives for panel in shown for f in _factors(drive, panel)})
        column[0].yaxis.set_major_locator(FixedLocator(marks))
        column[0].yaxis.set_major_formatter(FuncFormatter(lambda factor, _: f"{factor:g}"))
        column[0].set_ylim(max(0.0, marks[0] - 0.2 * reach), marks[-1] + 0.1 * reach)
    return figure


def _factors(drive: Statistics, panel: Panel) -> set[float]:
    """Those that the cameras of a panel may use, and those that were in force."""
    described = drive.series.config.get("cameras") or {}
    ladders = [(described.get(name) or {}).get("rate_quality", {}).get("scaling", ()) for name in panel.cameras]
    used = [drive.cameras[name].factors for name in panel.cameras if name in drive.cameras]
    return {float(factor) for each in (*ladders, *used) for factor in each if factor} or {1.0}


def totals(drives: Rows) -> Figure:
    """What was predicted, allocated, and came of it."""
    unit, label = _unit(drives)
    figure, grid = _rows(drives, 1, 1.5, sharey=True)
    for axes, drive in zip(grid[:, 0], drives, strict=True):
        series = drive.series
        if series.link:
            axes.fill_between(
                series.link.t / unit, series.link.kbps, step="post", color=LINK, alpha=0.45, lw=0, label="link's rate"
            )
        for line, text, style in (
            (series.predicted, "predicted", {"color": PREDICTED, "ls": DASHES[1], "zorder": 3}),
            (series.allocated, "allocated", {"color": ALLOCATED, "lw": 1.4}),
        ):
            t, y = _until(line, series.end)
            axes.step(t / unit, y, where="post", label=text, **style)
        if series.measured:
            axes.plot(series.actual.t / unit, series.actual.y, color=ACTUAL, lw=0.7, label=f"{series.measured}")
        axes.set_ylabel("total in kbit/s")
        if len(drives) > 1:
            axes.set_title(series.label)
        axes.set_ylim(bottom=0)
    grid[-1, 0].set_xlabel(label)
    _legend(grid[-1, 0], grid[:, 0], columns=4)
    return figure


def latency(drives: Rows) -> Figure | str:
    """Latency over time with freezes, and how it is distributed."""
    drives = [drive for drive in drives if has_latency(drive)]
    if not drives:
        return "no latency was logged: that takes an operator's log"
    unit, label = _unit(drives)
    heights = [height for drive in drives for height in (1.15, _strip_height(drive))]
    titles = 0.12 * (len(drives) > 1) * len(drives)
    size = (WIDTH_IN, sum(heights) + 1.45 + 0.75 + titles)
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.subplots(len(heights) + 1, height_ratios=[*heights, 1.45])
    seconds = [per_second(drive.series) for drive in drives]
    everything = np.concatenate([np.concatenate([each.median, each.p95]) for each in seconds])
    for number, (drive, each) in enumerate(zip(drives, seconds, strict=True)):
        axes, strip = grid[2 * number], grid[2 * number + 1]
        axes.sharex(grid[0])
        strip.sharex(grid[0])
        axes.sharey(grid[0])
        axes.plot(each.t / unit, each.p95, color=DAY[5], label="95th percentile")
        axes.plot(each.t / unit, each.median, color=ALLOCATED, label="median")
        _latency_axis(axes.set_yscale, axes.set_ylim, axes.yaxis, everything[np.isfinite(everything)])
        axes.set_ylabel("latency in ms")
        axes.tick_params(labelbottom=False)
        axes.set_title(drive.series.label if len(drives) > 1 else "(a) Over time")
        _draw_freezes(strip, drive, unit)
    grid[0].set_xlim(0, max(drive.series.end for drive in drives) / unit)
    grid[0].legend(loc="lower right", bbox_to_anchor=(1, 1.03), ncols=2)
    grid[-2].set_xlabel(label)
    _draw_distribution(grid[-1], drives)
    return figure


def quality(drives: Rows) -> Figure | str:
    """Quality of each camera as its rate-quality model says."""
    metrics = {each.quality.metric for drive in drives for each in drive.cameras.values() if each.quality}
    if not metrics:
        return "no rate-quality models were found, see `tod-runner model --help`; models=DIR names where they are"
    metric = sorted(metrics)[0]
    drives = [drive for drive in drives if has_quality(drive)]

    def draw(axes: Axes, drive: Statistics, panel: Panel) -> None:
        for name, style in _styles(drive.series, panel):
            estimate = drive.cameras[name].quality
            if estimate and estimate.metric == metric:
                axes.plot(estimate.line.t / _unit(drives)[0], estimate.line.y, **style)

    figure, _ = _by_panel(drives, draw, f"estimated {METRICS.get(metric, metric)}", sharey=True)
    return figure


def has_latency(drive: Statistics) -> bool:
    return bool(latencies(drive.series)[1].size)


def has_quality(drive: Statistics) -> bool:
    return any(camera.quality for camera in drive.cameras.values())


FIGURES: dict[str, Callable[[Rows], Figure | str]] = {
    "bitrate_on_track": bitrate_on_track,
    "bitrates": bitrates,
    "scaling": scaling,
    "totals": totals,
    "latency": latency,
    "quality": quality,
}


# --- rows and panels --------------------------------------------------------------------------------------------------


def _rows(drives: Rows, columns: int, height: float, sharey: Any) -> tuple[Figure, Any]:
    """A row for each drive, on the same time axis."""
    figure = Figure(figsize=(WIDTH_IN, height * len(drives) + 0.45), layout="constrained")
    grid = figure.subplots(len(drives), columns, squeeze=False, sharex=True, sharey=sharey)
    grid[0, 0].set_xlim(0, max(drive.series.end for drive in drives) / _unit(drives)[0])
    grid[0, 0].xaxis.set_major_locator(MaxNLocator(4 if columns > 1 else 8, steps=[1, 2, 2.5, 5, 10]))
    return figure, grid


def _by_panel(
    drives: Rows, draw: Callable[[Axes, Statistics, Panel], None], label: str, sharey: Any = "col"
) -> tuple[Figure, Any]:
    """A row for each drive, a column for each panel of cameras, legends below."""
    columns = max(len(drive.series.panels) for drive in drives)
    figure, grid = _rows(drives, columns, 1.55, sharey)
    above: Sequence[Panel] = ()
    for row, drive in zip(grid, drives, strict=True):
        for number, (axes, panel) in enumerate(zip_longest(row, drive.series.panels)):
            if panel is None:
                axes.set_axis_off()
                continue
            draw(axes, drive, panel)
            if drive.series.panels != above:
                axes.set_title(f"({chr(ord('a') + number)}) {panel.title}" if columns > 1 else panel.title)
        above = drive.series.panels
        row[0].set_ylabel(label if len(drives) == 1 else f"{drive.series.label}\n{label}")
    for number in range(columns):
        grid[-1, number].set_xlabel(_unit(drives)[1])
        _legend(grid[-1, number], grid[:, number], columns=2 if columns > 1 else 4)
    return figure, grid


def _styles(drive: Series, panel: Panel) -> Iterable[tuple[str, dict[str, Any]]]:
    """By camera of a panel, how its curve looks: colours are those of the page, dashes tell them apart without."""
    own = colours(drive.cameras)
    for place, name in enumerate(panel.cameras):
        yield name, {"color": own[name], "ls": DASHES[place % len(DASHES)], "label": name}


def _legend(below: Axes, of: Iterable[Axes], columns: int) -> None:
    """One legend under a column of panels, for all that is drawn in it."""
    handles = {label: handle for axes in of for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    down = below.transAxes + ScaledTranslation(0, -LEGEND_IN, below.figure.dpi_scale_trans)
    below.legend(
        handles.values(),
        handles.keys(),
        loc="upper center",
        bbox_to_anchor=(0.5, 0),
        bbox_transform=down,
        ncols=columns,
    )


def _unit(drives: Rows) -> tuple[float, str]:
    """s of the unit of the time axis, and how it is labelled."""
    long = max(drive.series.end for drive in drives) > MINUTES_FROM_S
    return (60.0, "time in min") if long else (1.0, "time in s")


def _until(line: Line, end: float) -> Line:
    """A quantity whose values hold until the next, up to the end of the drive."""
    if not line.t.size or line.t[-1] >= end:
        return line
    return Line(np.append(line.t, end), np.append(line.y, line.y[-1]))


def _measured(drives: Rows) -> str:
    kinds = {drive.series.measured for drive in drives} - {""}
    return kinds.pop() if len(kinds) == 1 else "actual"


# --- the map ----------------------------------------------------------------------------------------------------------


def on_track(drive: Series) -> tuple[Values, Values, Values, Values]:
    """Time, m east, m north and total bitrate, kbit/s: as measured, or as allocated where nothing was."""
    places = drive.positions
    assert places is not None
    t = drive.actual.t if drive.measured else places.t
    t = t[(t >= places.t[0]) & (t <= places.t[-1])]
    kbps = np.interp(t, *drive.actual) if drive.measured else held(drive.allocated, t)
    t, kbps = t[np.isfinite(kbps)], kbps[np.isfinite(kbps)]
    return t, np.interp(t, places.t, places.east), np.interp(t, places.t, places.north), kbps


def _on_track(drive: Series) -> tuple[Values, Values, Values]:
    return on_track(drive)[1:]


def _viridis() -> ListedColormap:
    """Without its lightest end, which is not seen on white."""
    return ListedColormap(mpl.colormaps["viridis"](np.linspace(0, 0.93, 256)))


def _height(places: Positions | None) -> float:
    """Of a map that fills the column's width, in."""
    assert places is not None
    (left, right), (bottom, top) = _limits(places)
    return 2.4 * (top - bottom) / (right - left) + 0.6


def _limits(places: Positions) -> tuple[tuple[float, float], tuple[float, float]]:
    """Of the map, m east and north: room around the track, and no side too short for the colour bar."""
    spans = [float(np.ptp(each)) for each in (places.east, places.north)]
    least = max(FLATTEST * max(spans), SMALLEST_TRACK_M)
    room = 0.06 * max(*spans, SMALLEST_TRACK_M)
    found = []
    for values, span in zip((places.east, places.north), spans, strict=True):
        middle, half = float(values.min() + values.max()) / 2, max(span, least) / 2 + room
        found.append((middle - half, middle + half))
    return found[0], found[1]


def _mark_way(axes: Axes, drive: Series) -> None:
    """Where the drive begins, where it ends, and arrows along it."""
    places = drive.positions
    assert places is not None
    x, y = places.east, places.north
    way = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    for share in np.arange(1, ARROWS + 1) / (ARROWS + 1) if way[-1] > SMALLEST_TRACK_M else ():
        at = int(np.searchsorted(way, share * way[-1]))
        before = int(np.searchsorted(way, share * way[-1] - 0.01 * way[-1]))
        angle = np.degrees(np.arctan2(y[at] - y[before], x[at] - x[before]))
        arrow = MarkerStyle(">").rotated(deg=float(angle))
        axes.plot(x[at], y[at], marker=arrow, ms=5, mfc="white", mec="black", mew=0.6, zorder=4)
    ends = (("start", 0, "o"), ("end", -1, "s"))
    axes.plot(x, y, color=LINK, lw=1.2, zorder=1)  # also where no bitrate is known
    for text, at, marker in ends:
        axes.plot(x[at], y[at], marker=marker, ms=5.5, mfc="white", mec="black", mew=1.0, zorder=5, ls="", label=text)


def _dress_map(axes: Axes, drive: Series, *, titled: bool) -> None:
    axes.set_aspect("equal")
    assert drive.positions is not None
    xlim, ylim = _limits(drive.positions)
    axes.set(xlim=xlim, ylim=ylim)
    axes.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10]))
    axes.yaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
    axes.set_xlabel("m east of the start")
    axes.set_ylabel("m north")
    if titled:
        axes.set_title(drive.label)
    axes.legend(loc="lower right", bbox_to_anchor=(1, 1.01), ncols=2)


def _colour_bar(figure: Figure, axes: Axes, points: PathCollection, drive: Series) -> None:
    # Inside the axes' own box, which the equal aspect shrinks.
    bar = figure.colorbar(points, cax=axes.inset_axes((1.02, 0, 0.035, 1)))
    bar.set_label(f"total {drive.measured or 'allocated'} in kbit/s")
    bar.outline.set_linewidth(0.5)


# --- latency ----------------------------------------------------------------------------------------------------------


def _latency_axis(set_scale: Callable[[str], None], set_limits: Callable[..., Any], axis: Any, shown: Values) -> None:
    """An axis that holds some latencies: logarithmic where they spread and none is below 0."""
    low, high = float(shown.min()), float(shown.max())
    if low > 0 and high / low > WIDE:
        set_scale("log")
        set_limits(low * 0.95, high * 1.05)
        axis.set_major_locator(LogLocator(10, (1, 3) if high > DECADES * low else (1, 2, 5)))
        axis.set_minor_formatter(NullFormatter())
    else:
        set_limits(min(0.0, low), high * 1.05)
    axis.set_major_formatter(FuncFormatter(lambda ms, _: f"{ms:g}"))


def _strip_height(drive: Statistics) -> float:
    frozen = sum(bool(camera.freezes) for camera in drive.cameras.values())
    return 0.1 + 0.11 * max(frozen, 1)


def _draw_freezes(axes: Axes, drive: Statistics, unit: float) -> None:
    """A row for each camera that froze."""
    own = colours(drive.cameras)
    frozen = [camera for camera in drive.cameras.values() if camera.freezes]
    least = SEEN * drive.series.end
    for row, camera in enumerate(frozen):
        bars = [(f.t / unit, max(f.seconds, least) / unit) for f in camera.freezes or ()]
        axes.broken_barh(bars, (row - 0.4, 0.8), color=own[camera.name], lw=0)
    axes.set_yticks(range(len(frozen)), [camera.name for camera in frozen], fontsize=5.5)
    axes.set_ylim(max(len(frozen), 1) - 0.5, -0.5)
    axes.tick_params(axis="y", length=0)
    axes.grid(axis="y", visible=False)
    if frozen:
        axes.text(1.0, 1.04, "freezes", transform=axes.transAxes, ha="right", va="bottom", fontsize=6)
        return
    text = "arrivals were not logged" if drive.freezes is None else "no freezes"
    axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center", fontsize=6)


def _draw_distribution(axes: Axes, drives: Rows) -> None:
    """Share of frames that are at most so late: of each camera, or of each drive where there are several."""
    curves: list[tuple[str, Values, dict[str, Any]]] = []
    if len(drives) == 1:
        series = drives[0].series
        own = colours(series.cameras)
        curves = [(name, latencies(series, name)[1], {"color": own[name], "lw": 0.8}) for name in series.cameras]
        curves.append(("all cameras", latencies(series)[1], {"color": "black", "lw": 1.5, "ls": DASHES[1]}))
    else:
        for number, drive in enumerate(drives):
            style = {"color": DAY[number % len(DAY)], "ls": DASHES[number % len(DASHES)], "lw": 1.2}
            curves.append((drive.series.label, latencies(drive.series)[1], style))
    known = [(name, np.sort(values), style) for name, values, style in curves if values.size]
    for name, values, style in known:
        axes.plot(values, np.arange(1, len(values) + 1) / len(values), label=name, **style)
    everything = np.concatenate([values for _, values, _ in known])
    # The last thousandth would squeeze all others.
    _latency_axis(axes.set_xscale, axes.set_xlim, axes.xaxis, np.percentile(everything, (0, 99.9)))
    axes.set_ylim(0, 1.01)
    for share in (0.5, 0.95):
        axes.axhline(share, color="#8b949e", lw=0.5, ls=":", zorder=1)
    axes.set_yticks((0, 0.25, 0.5, 0.75, 0.95), ("0", "25 %", "50 %", "75 %", "95 %"))
    axes.set_ylabel("share of frames")
    arrived = any(to_arrival(drive.series) for drive in drives)
    axes.set_xlabel(f"latency from capture to {'arrival' if arrived else 'decode'} in ms")
    axes.set_title("(b) Distribution" if len(drives) == 1 else "Distribution, all cameras")
    _legend(axes, [axes], columns=3 if len(drives) == 1 else 2)
