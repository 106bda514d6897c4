"""The figures at the column width of a paper, as PNG and PDF."""

from __future__ import annotations

import io
from collections.abc import Iterable, Sequence
from itertools import count, product, zip_longest
from math import ceil
from pathlib import Path
from string import ascii_lowercase
from textwrap import fill
from typing import TYPE_CHECKING, Any

import matplotlib as mpl

mpl.use("Agg")  # works without a display

import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure as Sheet
from matplotlib.lines import Line2D
from matplotlib.markers import MarkerStyle
from matplotlib.patches import Patch
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullLocator
from matplotlib.transforms import ScaledTranslation

from runner.drive.charts import Axis, Chart, Curve, Figure, MapTrack, Strip
from runner.drive.colours import DAY, NAMED
from runner.system.files import write_whole

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

    from runner.core.model import Progress

WIDTH_IN = 3.5  # a column of an IEEE paper
FORMATS = ("png", "pdf")
MOST_PX = 65_000  # of an image's height: matplotlib draws fewer than 2^16
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
    "text.parse_math": False,  # a drive's name may contain any character
    "pdf.fonttype": 42,  # fonts as text, as journals require
    "savefig.dpi": 300,
}
CHART_IN, LINE_IN = 1.15, 0.115  # height of a chart without its labels, and of a line of text
LEGEND_IN = 0.38  # under the panel: below the numbers and label of the axis
DASHES: tuple[Any, ...] = ("-", (0, (5, 1.2)), (0, (1.4, 0.9)), (0, (5, 1, 1.2, 1)))
SHADE = 0.16  # opacity
MIN_VISIBLE = 0.006  # of the axis: the smallest visible width of a freeze
LINE_CHARACTERS = 70  # that fit into a legend line of column width


def write_figures(figures: Sequence[Figure], directory: Path, progress: Progress) -> None:
    """Write each figure as .png and .pdf.

    raises  RunError if a file cannot be written
    """
    for number, figure in enumerate(figures):
        progress("figures", number / len(figures))
        sheet = draw_sheet(figure)
        for form in FORMATS:
            write_whole(directory / f"{figure.name}.{form}", _rendered(sheet, form))
            sheet.set_layout_engine("none")  # already laid out for the first format
    progress("figures", 1.0)


@mpl.rc_context(STYLE)
def _rendered(sheet: Sheet, form: str) -> bytes:
    buffer = io.BytesIO()
    # Without a date, the same drive gives the same file.
    metadata = {"CreationDate": None} if form == "pdf" else None
    dpi = min(mpl.rcParams["savefig.dpi"], MOST_PX / sheet.get_figheight())
    sheet.savefig(buffer, format=form, metadata=metadata, dpi=dpi)
    return buffer.getvalue()


@mpl.rc_context(STYLE)
def draw_sheet(figure: Figure) -> Sheet:
    """Rows of charts on a sheet; those with the same x axis and legend show both once, below the last."""
    rows, columns = figure.rows, max(map(len, figure.rows))
    last = [below is None or _below(row) != _below(below) for row, below in zip_longest(rows, rows[1:])]
    strips = [_strip_height(row[0].strip) if row[0].strip else 0.0 for row in rows]
    heights = [_height(row[0]) for row in rows]
    texts = [0.35 + end * (0.15 + LINE_IN * _lines(row, columns)) for row, end in zip(rows, last, strict=True)]
    sheet = Sheet(figsize=(WIDTH_IN, sum(heights) + sum(strips) + sum(texts)), layout="constrained")
    ratios = [each for pair in zip(heights, strips, strict=True) for each in pair if each]
    grid = iter(sheet.subplots(len(ratios), columns, squeeze=False, height_ratios=ratios))
    letter = ("".join(letters) for length in count(1) for letters in product(ascii_lowercase, repeat=length))
    for row, end, strip in zip(rows, last, strips, strict=True):
        above = next(grid)
        below = next(grid) if strip else above
        for column, (axes, bottom, chart) in enumerate(zip_longest(above, below, row)):
            if chart is None:
                axes.set_axis_off()
                continue
            name = f"({next(letter)}) " if sum(map(len, rows)) > 1 else ""
            axes.set_title(name + chart.title)
            _draw(axes, chart)
            if chart.strip:
                _draw_strip(bottom, chart.strip, chart.x)
                axes.tick_params(labelbottom=False)
            axes.set_ylabel(chart.y.title if column == 0 else "")
            bottom.set_xlabel(chart.x.title if end else "")
            if end and chart.curves:
                _legend(bottom, chart.curves, columns)
    return sheet


def _below(row: Sequence[Chart]) -> object:
    """Axis and legends below a row of charts."""
    legends = [[(curve.label, curve.colour, curve.dash) for curve in chart.curves] for chart in row]
    return [chart.x for chart in row if chart.curves] or row, legends


def _height(chart: Chart) -> float:
    if chart.track is None:
        return CHART_IN
    return 2.4 * (chart.y.high - chart.y.low) / (chart.x.high - chart.x.low)  # for a map that fills the width


def _draw(axes: Axes, chart: Chart) -> None:
    for shade in chart.shades:
        for t, seconds in shade.spans:
            axes.axvspan(t, t + seconds, color=_colour(shade.colour), alpha=SHADE, lw=0)
    for curve in chart.curves:
        _draw_curve(axes, curve)
    if chart.track:
        _draw_track(axes, chart.track)
    _scale(axes.xaxis, chart.x, 5)
    _scale(axes.yaxis, chart.y, 5)


def _scale(side: Any, axis: Axis, most: int) -> None:
    which = side.axis_name
    getattr(side.axes, f"set_{which}scale")("log" if axis.log else "linear")
    getattr(side.axes, f"set_{which}lim")(axis.low, axis.high)
    side.set_major_locator(FixedLocator(axis.marks) if axis.marks else MaxNLocator(most, steps=[1, 2, 2.5, 5, 10]))
    side.set_minor_locator(NullLocator())
    side.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.0%}" if axis.percent else f"{value:g}"))


def _style(curve: Curve) -> dict[str, Any]:
    if curve.points:
        return {"color": _colour(curve.colour), "ls": "", "marker": "o", "ms": 2.5, "mew": 0, "alpha": 0.6}
    dashes = DASHES[curve.dash % len(DASHES)]
    return {"color": _colour(curve.colour), "ls": dashes, "lw": 0.9 * curve.width}


def _colour(colour: int | str) -> str:
    return DAY[colour % len(DAY)] if isinstance(colour, int) else NAMED[colour]


def _draw_curve(axes: Axes, curve: Curve) -> None:
    if curve.filled:
        axes.fill_between(curve.x, curve.y, step="post", color=_colour(curve.colour), alpha=0.45, lw=0)
        return
    if curve.around:
        axes.fill_between(curve.x, *curve.around, color=_colour(curve.colour), alpha=0.25, lw=0)
    axes.plot(curve.x, curve.y, drawstyle="steps-post" if curve.steps else "default", **_style(curve))


def _draw_strip(axes: Axes, strip: Strip, x: Axis) -> None:
    """A row for each camera that froze."""
    least = MIN_VISIBLE * (x.high - x.low)
    for row, bars in enumerate(strip.bars):
        shown = [(t, max(s, least)) for t, s in bars.spans]
        axes.broken_barh(shown, (row - 0.4, 0.8), color=_colour(bars.colour), lw=0)
    _scale(axes.xaxis, x, 5)
    axes.set_yticks(range(len(strip.bars)), [bars.label for bars in strip.bars], fontsize=5.5)
    axes.set_ylim(max(len(strip.bars), 1) - 0.5, -0.5)
    axes.tick_params(axis="y", length=0)
    axes.grid(axis="y", visible=False)
    text, x_at, y_at = ("freezes", 1.0, 1.04) if strip.bars else (strip.none, 0.5, 0.5)
    ha, va = ("right", "bottom") if strip.bars else ("center", "center")
    axes.text(x_at, y_at, text, transform=axes.transAxes, ha=ha, va=va, fontsize=6)


def _strip_height(strip: Strip) -> float:
    return 0.1 + 0.11 * max(len(strip.bars), 1)


def _draw_track(axes: Axes, track: MapTrack) -> None:
    """The way, its start and end, arrows along it, and the bitrate by colour."""
    x, y = track.way
    viridis = ListedColormap(mpl.colormaps["viridis"](np.linspace(0, 0.93, 256)))  # its lightest is invisible on white
    style: dict[str, Any] = {"mfc": "white", "mec": "black", "ls": ""}
    axes.plot(x, y, color=NAMED["link"], lw=1.2, zorder=1)  # also where no bitrate is known
    points = axes.scatter(track.east, track.north, c=track.values, s=7, lw=0, cmap=viridis, zorder=2)
    points.set_clim(track.low, track.high)
    for east, north, degrees in track.arrows:
        axes.plot(east, north, marker=MarkerStyle(">").rotated(deg=degrees), ms=5, mew=0.6, zorder=4, **style)
    for text, at, marker in (("start", 0, "o"), ("end", -1, "s")):
        axes.plot(x[at], y[at], marker=marker, ms=5.5, mew=1.0, zorder=5, label=text, **style)
    axes.set_aspect("equal")
    axes.legend(loc="lower right", bbox_to_anchor=(1, 1.01), ncols=2)
    # Inside the axes' own box, which the equal aspect shrinks.
    bar = axes.figure.colorbar(points, cax=axes.inset_axes((1.02, 0, 0.035, 1)))
    bar.set_label(track.title)
    bar.outline.set_linewidth(0.5)


# --- legends ----------------------------------------------------------------------------------------------------------


def _across(labels: Iterable[str], columns: int) -> int:
    """Number of labels that fit side by side."""
    longest = max((len(label) for label in labels), default=1)
    return max(1, min(4, LINE_CHARACTERS // columns // (min(longest, LINE_CHARACTERS // columns) + 5)))


def _lines(row: Sequence[Chart], columns: int) -> int:
    """Lines of text that the legends below a row take, plus a margin."""
    labels = [[_wrapped(curve.label, columns) for curve in chart.curves] for chart in row]
    lines = [sum(label.count("\n") + 1 for label in each) / _across(each, columns) for each in labels if each]
    return ceil(max(lines)) + 2 if lines else 0


def _wrapped(label: str, columns: int) -> str:
    return fill(label, LINE_CHARACTERS // columns - 9)


def _legend(axes: Axes, curves: Iterable[Curve], columns: int) -> None:
    """One legend under a column of charts, for all its curves."""
    handles = [_handle(curve, _wrapped(curve.label, columns)) for curve in curves]
    assert axes.figure is not None
    down = axes.transAxes + ScaledTranslation(0, -LEGEND_IN, axes.figure.dpi_scale_trans)
    across = _across([str(handle.get_label()) for handle in handles], columns)
    place: dict[str, Any] = {"bbox_to_anchor": (0.5, 0), "bbox_transform": down, "ncols": across}
    axes.legend(handles=handles, loc="upper center", **place)


def _handle(curve: Curve, label: str) -> Artist:
    if curve.filled:
        return Patch(color=_colour(curve.colour), alpha=0.45, lw=0, label=label)
    return Line2D([], [], label=label, **_style(curve))
