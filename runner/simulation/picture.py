"""Simulated drives as a figure: total, capacity and prediction, and the wait in the queue, over time."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from runner.drive.colours import NAMED
from runner.simulation.drive import Drive
from runner.simulation.runs import Result
from runner.system.files import write_whole

MOST = 24  # drives in one figure
WIDTH, HEIGHT = 12, 2.4  # inches of a row


def draw(results: Sequence[Result], path: Path) -> None:
    """Write the first MOST drives, one below the other; see `write_figure`."""
    kept = [(result, result.drive) for result in results if result.drive][:MOST]
    figure = Figure(figsize=(WIDTH, HEIGHT * len(kept)), layout="constrained")
    for (rates, waits), (result, drive) in zip(figure.subplots(len(kept), 2, squeeze=False), kept, strict=True):
        _draw_rates(rates, drive)
        waits.plot(
            drive.waits[::2], [1000 * wait for wait in drive.waits[1::2]], ".", color=NAMED["late"], markersize=1.5
        )
        rates.set(title=f"{result.job.link_name}, {result.job.prediction}, seed {result.job.seed}", ylabel="kbit/s")
        waits.set(title="wait of each frame in the queue", ylabel="ms")
        for axes in (rates, waits):
            axes.set(xlabel="s", ylim=(0, None), xlim=(0, drive.duration_s))
    write_figure(figure, path)


def write_figure(figure: Figure, path: Path) -> None:
    """The ending of the path names the format."""
    data = io.BytesIO()
    figure.savefig(data, format=path.suffix[1:], dpi=110)
    write_whole(path, data.getvalue())


def _draw_rates(axes: Axes, drive: Drive) -> None:
    axes.step(
        drive.capacity.times,
        drive.capacity.values,
        where="post",
        color=NAMED["actual"],
        linewidth=0.8,
        label="capacity",
    )
    for label, pairs, colour in (
        ("prediction", drive.predictions, NAMED["predicted"]),
        ("total", drive.totals, NAMED["allocated"]),
    ):
        if pairs:
            times, values = [*pairs[::2], drive.duration_s], [*pairs[1::2], pairs[-1]]
            axes.step(times, values, where="post", color=colour, linewidth=1, label=label)
    axes.legend(fontsize=8, ncols=3)
