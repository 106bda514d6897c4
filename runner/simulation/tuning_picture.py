"""Values of numbers as a figure: use against the wait in the queue, on the links for tuning and on those left out."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle, groupby
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from runner.drive.colours import DAY, NAMED
from runner.simulation.comparison import JUDGED, Compared, Means
from runner.simulation.picture import write_figure

TITLES = ("links for tuning", "links left out")
SIZE = (12, 5.5)  # inches
LEAST = 3  # times the box: half the length of the axes, at least
ROW = 0.22  # inches of a number in the legend


def draw(in_force: Sequence[Means], values: Sequence[Compared], path: Path) -> None:
    """A line for each number through the values in force and those tried, in their order."""
    by_number = [list(some) for _, some in groupby(values, lambda one: one.trial.number)]
    figure = Figure(figsize=(SIZE[0], SIZE[1] + ROW * len(by_number)), layout="constrained")
    for which, axes in enumerate(figure.subplots(1, 2)):
        for some, colour, marker in zip(by_number, cycle(DAY), cycle("osD^vP"), strict=False):
            _draw_number(axes, in_force[which], some, which, colour, marker)
        _draw_in_force(axes, *_point(in_force[which]))
        axes.set(title=TITLES[which], xlabel="p95 of the wait in the queue, ms", ylabel="use")
        axes.grid(alpha=0.3)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", fontsize=8, ncols=2)
    write_figure(figure, path)


def _draw_in_force(axes: Axes, p95: float, use: float) -> None:
    """With a box in which differences do not count; the axes are so long that smaller ones look small."""
    wide, high = JUDGED["p95"][0], JUDGED["use"][0]
    corner = (p95 - wide, use - high)
    axes.add_patch(Rectangle(corner, 2 * wide, 2 * high, color=NAMED["link"], alpha=0.4, label="does not count"))
    axes.plot(p95, use, "*", color=NAMED["actual"], markersize=15, label="in force (better: up and left)", zorder=3)
    axes.plot(*zip(*((p95 + side * LEAST * wide, use + side * LEAST * high) for side in (-1, 1)), strict=True), " ")
    axes.margins(0.1)


def _draw_number(axes: Axes, in_force: Means, values: Sequence[Compared], which: int, colour: str, marker: str) -> None:
    number = values[0].trial.number
    points = [(one.trial.value, _point(one.means[which])) for one in values]
    if number.value is not None:
        points.append((number.value, _point(in_force)))
    points.sort()
    axes.plot(*zip(*(at for _, at in points), strict=True), marker=marker, color=colour, label=number.name)
    for value, at in points:
        if value != number.value:
            axes.annotate(f"{value:g}", at, xytext=(5, 5), textcoords="offset points", fontsize=8, color=colour)


def _point(means: Means) -> tuple[float, float]:
    return means["p95"], means["use"]
