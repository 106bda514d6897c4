"""How the total follows the link: a cut, a rise and a wrong prediction, simulated. The figure of docs/rules.md.

python bench/follow_link.py docs/images/follow_link.png
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from runner.drive.colours import NAMED
from runner.simulation.drive import Drive
from runner.simulation.picture import write_figure
from runner.simulation.runs import Common, Job, run_job

SETUP = Common(("fps_max=15", "modes=safe"), None, duration_s=35)


class Part(NamedTuple):
    """Of a simulated drive, from one time to another, s."""

    title: str
    link: str
    prediction: str
    begin: float
    end: float


PARTS = (
    Part("the link falls, no prediction", "step", "absent", 29, 34),
    Part("it rises, no prediction", "step", "absent", 19, 24),
    Part("predictions are noise", "step", "noise", 0, 19.9),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("picture", type=Path)
    figure = Figure(figsize=(13, 4.6), layout="constrained")
    columns = figure.subplots(2, len(PARTS), height_ratios=(2, 1), sharex="col", sharey="row").T
    for part, (rates, waits) in zip(PARTS, columns, strict=True):
        drive = run_job(SETUP, Job(part.link, 0, part.prediction, 1, SETUP.duration_s), keep=True).drive
        assert drive is not None
        rates.set(title=part.title, xlim=(part.begin, part.end), ylim=(0, 6500))
        draw_rates(rates, drive)
        waits.plot(drive.waits[::2], [1000 * wait for wait in drive.waits[1::2]], ".", color=NAMED["late"], ms=3)
        waits.set(xlabel="s", ylim=(0, 150))
    columns[0][0].set_ylabel("kbit/s")
    columns[0][1].set_ylabel("wait in the\nqueue, ms")
    columns[-1][0].legend(fontsize=9, loc="upper right")
    write_figure(figure, parser.parse_args().picture)


def draw_rates(axes: Axes, drive: Drive) -> None:
    """What was predicted, what the link carried, and what the cameras might send."""
    for label, times, values, colour in (
        ("predicted", drive.predictions[::2], drive.predictions[1::2], NAMED["predicted"]),
        ("the link carries", drive.capacity.times, drive.capacity.values, NAMED["actual"]),
        ("total", drive.totals[::2], drive.totals[1::2], NAMED["allocated"]),
    ):
        if len(times):
            axes.step([*times, drive.duration_s], [*values, values[-1]], where="post", color=colour, label=label)


if __name__ == "__main__":
    main()
