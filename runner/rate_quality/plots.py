"""Rate-quality curves as in the paper's Fig. 4 and its appendix: quality over bitrate, one curve for each factor."""

from __future__ import annotations

import io
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib as mpl

mpl.use("Agg")  # works without a display

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from runner.core.model import plain
from runner.rate_quality.artefact import Measured
from runner.rate_quality.curves import Curves, draw_curves, ladder_quality, mean_score
from runner.system.files import write_whole

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SIZE_IN = (7.2, 4.6)
FORMATS = ("png", "pdf")
DROPPED = "#b8b8b8"


def plot(measured: Measured, path: Path) -> list[Path]:
    """Write the curves of a model.

    path    without extension
    returns the files: PNG and PDF
    raises  RunError
    """
    score = mean_score(measured.metric, measured.sign)
    curves = draw_curves(measured.points, score)
    width, height = SIZE_IN
    rows = 2 if measured.rates else 1
    figure = Figure(figsize=(width, rows * height), layout="constrained")
    axes, *others = figure.subplots(rows, squeeze=False)[:, 0]
    colours = _draw_curves(axes, measured, curves)
    _draw_ladder(axes, measured, curves, colours)
    axes.set_ylim(*_limits(measured, curves))
    clips = ", ".join(Path(clip.path).name for clip in measured.clips.values())
    _label_axes(axes, measured, f"{measured.name}   ({clips})")
    for below in others:
        _draw_rates(below, measured)
    for each in (axes, *others):
        each.set_xlim(curves.kbps[0], curves.kbps[-1])
    return [_saved(figure, path, form) for form in FORMATS]


def _draw_curves(axes: Axes, measured: Measured, curves: Curves) -> dict[Fraction, str]:
    """All curves with their points; dropped ones are grey."""
    palette = mpl.colormaps["viridis"](np.linspace(0, 0.88, len(measured.choice.scaling)))
    colours = {f: mpl.colors.to_hex(colour) for f, colour in zip(measured.choice.scaling, palette, strict=True)}
    for factor, quality in curves.quality.items():
        kept = factor in colours
        colour = colours.get(factor, DROPPED)
        shown = np.where(np.isfinite(quality), measured.sign * quality, np.nan)
        label = f"s = {plain(factor)}" if kept else None
        axes.plot(curves.kbps, shown, color=colour, lw=1.6 if kept else 0.9, label=label, zorder=3 if kept else 2)
        own = [point for point in measured.points if point.scaling == factor and point.meets_target]
        means = [float(np.mean(point.scores[measured.metric])) for point in own]
        axes.plot([p.target_kbps for p in own], means, ".", ms=5 if kept else 3, color=colour, zorder=3 if kept else 2)
    dropped = [f"{plain(factor)}" for factor in curves.quality if factor not in colours]
    if dropped:
        axes.plot([], [], color=DROPPED, lw=0.9, label="dropped:\n" + "\n".join(dropped))
    return colours


def _draw_ladder(axes: Axes, measured: Measured, curves: Curves, colours: dict[Fraction, str]) -> None:
    """The ranges of the factors, the crossings with their confidence, and b_full."""
    choice = measured.choice
    taken = measured.sign * ladder_quality(curves, choice.scaling, choice.ladder.bounds)
    axes.plot(curves.kbps, taken, color="black", lw=5, alpha=0.14, solid_capstyle="butt", zorder=1)
    for crossing in choice.crossings:
        axes.axvspan(crossing.low, crossing.high, color=colours[crossing.upper], alpha=0.13, lw=0, zorder=0)
        axes.axvline(crossing.kbps, color=colours[crossing.upper], lw=1, ls="--", zorder=1)
        _mark(axes, crossing.kbps, f"$b_{{min}}$ {crossing.kbps:.0f}", left=False)
    axes.axvline(choice.b_full, color="black", lw=1, ls=":", zorder=1)
    _mark(axes, choice.b_full, f"$b_{{full}}$ {choice.b_full}", left=True)


def _mark(axes: Axes, kbps: float, text: str, *, left: bool) -> None:
    """Label a vertical line."""
    axes.annotate(
        text,
        xy=(kbps, 0.02),
        xycoords=("data", "axes fraction"),
        xytext=(-3 if left else 3, 0),
        textcoords="offset points",
        fontsize=8,
        rotation=90,
        va="bottom",
        ha="right" if left else "left",
    )


def _draw_rates(axes: Axes, measured: Measured) -> None:
    """Quality with fewer pictures a second: of those that are sent, and of what is shown until the next one."""
    palette = mpl.colormaps["plasma"](np.linspace(0, 0.8, len(measured.rates)))
    for (fps, points), colour in zip(measured.rates.items(), palette, strict=True):
        kbps, label = [point.kbps for point in points], f"{float(fps):.3g} Hz"
        axes.plot(kbps, [point.delivered for point in points], ".-", color=colour, label=f"{label}, delivered")
        axes.plot(kbps, [point.held for point in points], ".--", color=colour, label=f"{label}, held")
    _label_axes(axes, measured, "fewer pictures a second at the same bitrate")


def _label_axes(axes: Axes, measured: Measured, title: str) -> None:
    axes.set_title(title, fontsize=10)
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(10, (1, 2, 5)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda kbps, _: f"{kbps:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("target bitrate in kbit/s")
    axes.set_ylabel(measured.labels[measured.metric])
    axes.grid(color="#e6e6e6", lw=0.6)
    axes.set_axisbelow(True)
    axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False)


def _limits(measured: Measured, curves: Curves) -> tuple[float, float]:
    """From the worst of the kept curves to the best of all: a dropped one may leave the plot at the bottom."""
    shown = [curves.quality[factor] for factor in measured.choice.scaling]
    finite = np.concatenate([values[np.isfinite(values)] for values in shown])
    low, high = sorted((measured.sign * float(finite.min()), measured.sign * float(finite.max())))
    margin = 0.04 * (high - low or 1.0)
    return low - margin, high + margin


def _saved(figure: Figure, path: Path, form: str) -> Path:
    file, buffer = path.with_name(f"{path.name}.{form}"), io.BytesIO()
    # Without a date, the same model gives the same file.
    figure.savefig(buffer, format=form, dpi=160, metadata={"CreationDate": None} if form == "pdf" else None)
    write_whole(file, buffer.getvalue())
    return file
