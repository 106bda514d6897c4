"""usage: tod-runner simulate [OVERRIDE ...] [links=LINK,...] [predictions=KIND,...] [seeds=1] [windows=6]
                           [duration_s=60] [output=FILE.json] [figure=FILE.png] [log=DIR] [workers=N] [control=true]
                           [encoder_error=0.03] [late_ms=2] [report_jitter_ms=0] [report_loss=0] [bursts=true]
                           [slot_ms=0] [credit_ms=0] [peak=3] [grant_ms=0]

Simulates drives over links, under predictions that are right or wrong, and prints a table of what they show. Cameras,
encoders, link, repair and reports are models; the rules are those of the vehicle, with the modes file in force. Nothing
is encoded and nobody waits: one core simulates a minute with eight cameras in about a second. All cores are used.

links= names the links: synthetic (all that are generated: gauss_0.2_5, gauss_0.5_5, gauss_0.5_1, gauss_0.3_0.3, markov,
step, ramp, outage, saw), left_out (handover, shared: no number of any rule was chosen by them), a CSV file as
link.file, a file of mahimahi with opportunities to send (.up, .pps), or configured: the link of the configuration, and
the runs of its experiment. Of a file at most windows= parts of duration_s are driven. seeds= is their number, or
FIRST-LAST. Everything else about the link is that of link=: link.queue_ms, link.delay_ms, link.delay_file,
link.loss, link.loss_burst, link.policer, link.tcp, link.reverse, link.share. Without link= it has a queue of 300 ms and
15 ms each way.

predictions= are all, or some of right, low_30, low_50, high_30, high_50, noise, late_1, late_2, early_2, absent, mixed
(which changes its character), configured (those of pqos=).

output= has the figures of each drive; figure= draws each drive: total, capacity, prediction and queue. With log= the
drives are logged like real ones, for `report` and `replay`: DIR is the drive, or has one directory for each of several.

encoder_error is the deviation (ln) of an encoder's rate over a second; late_ms by how much a frame is sent later than
the earliest on average, 20 or more on a busy machine; report_loss the share of reports that are lost. slot_ms: packets
are delivered at the ends of slots. bursts=false: an idle link passes nothing at once. credit_ms: what an idle link
saves, to serve peak= times as fast; grant_ms: what the first packet then waits. control=false leaves out what the
control link sends.

  tod-runner simulate fps_max=15                                     all links and predictions, a minute or two
  tod-runner simulate links=saw,markov predictions=right,absent seeds=3 modes=steady
  tod-runner simulate links=uplink.csv predictions=absent link=netns link.share=1 link.loss=0.01 log=drive
  tod-runner simulate experiment=rfc8867                             its runs, with their links and predictions
"""

from __future__ import annotations

import json
import os
import re
import time
from collections.abc import Iterator, Sequence
from math import isfinite
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING

from runner.drive.log import FILES, check_free
from runner.errors import ArgumentError, RunError
from runner.system.files import write_whole
from runner.verbs import Arguments

if TYPE_CHECKING:
    from runner.simulation.runs import Job, Result, Setup

ALL, SYNTHETIC = "all", "synthetic"
SHORTEST_S = 4.0
FORMATS = (".png", ".pdf", ".svg")  # of the figure
Place = tuple[Path, float]  # directory of a drive, and when it began, s since 1970


def run(arguments: Arguments) -> int:
    from runner.simulation.families import FAMILIES, LEFT_OUT
    from runner.simulation.predictions import KINDS
    from runner.simulation.runs import CONFIGURED, check, jobs

    setup = _setup(arguments)
    repeated = CONFIGURED if any(word.startswith("experiment=") for word in arguments.overrides) else ""
    named = _list(arguments, "links", repeated or SYNTHETIC)
    several = {SYNTHETIC: FAMILIES, "left_out": LEFT_OUT}
    links = [link for name in named for link in several.get(name, (name,))]
    chosen = _list(arguments, "predictions", repeated or ALL)
    kinds = [kind for name in chosen for kind in (KINDS if name == ALL else [name])]
    wanted = jobs(setup, links, kinds, _seeds(arguments), _count(arguments, "windows", 6))
    check(setup, wanted)
    figure, places = arguments.path("figure"), _places(arguments, wanted)
    if figure and figure.suffix not in FORMATS:
        raise ArgumentError("figure", figure, f"must end in {', '.join(FORMATS)}")
    workers = _count(arguments, "workers", len(os.sched_getaffinity(0)))
    results = list(_run_all(setup, wanted, places, workers, keep=figure is not None))
    print("\n".join(_table(results)))
    if output := arguments.path("output"):
        lines = [{**one.job._asdict(), "took_s": round(one.took_s, 3), **one.figures} for one in results]
        write_whole(output, json.dumps(lines, indent=1).encode())
    if figure:
        from runner.simulation.picture import draw

        draw(results, figure)
    return 0


def _setup(arguments: Arguments) -> Setup:
    from runner.simulation.drive import Conditions
    from runner.simulation.encoder import EncoderModel
    from runner.simulation.runs import Scheduler, Setup

    def number(key: str, default: float = 0.0) -> float:
        value = arguments.number(key)
        return default if value is None else value

    duration_s = arguments.number("duration_s")
    if duration_s is not None and duration_s < SHORTEST_S:
        raise ArgumentError(
            "duration_s", f"{duration_s:g}", f"must be at least {SHORTEST_S:g}: the first 3 s do not count"
        )
    if (lost := number("report_loss")) > 1:
        raise ArgumentError("report_loss", f"{lost:g}", "must be a share from 0 to 1")
    credit_ms, grant_ms = number("credit_ms"), number("grant_ms")
    return Setup(
        tuple(arguments.overrides),
        arguments.conf,
        duration_s,
        Conditions(
            EncoderModel(error=number("encoder_error", EncoderModel.error)),
            number("late_ms", 1000 * Conditions.late_s) / 1000,
            number("report_jitter_ms") / 1000,
            lost,
            arguments.choice("control") == "true",
        ),
        number("slot_ms"),
        arguments.choice("bursts") == "true",
        Scheduler(number("peak", 3), credit_ms, grant_ms) if credit_ms or grant_ms else None,
    )


def _list(arguments: Arguments, key: str, default: str) -> list[str]:
    return [word for word in arguments.values.get(key, default).split(",") if word]


def _count(arguments: Arguments, key: str, default: int) -> int:
    text = arguments.values.get(key, str(default))
    if not text.isdecimal() or not int(text):
        raise ArgumentError(key, repr(text), "must be a whole number of 1 or more")
    return int(text)


def _seeds(arguments: Arguments) -> range:
    text = arguments.values.get("seeds", "1")
    found = re.fullmatch(r"(?:(\d+)-)?(\d+)", text, re.ASCII)
    first, last = (int(found[1] or 1), int(found[2])) if found else (1, 0)
    if not 1 <= first <= last:
        raise ArgumentError("seeds", repr(text), "must be their number, or the first and the last: 3 or 100-102")
    return range(first, last + 1)


def _places(arguments: Arguments, wanted: Sequence[Job]) -> list[Place | None]:
    """Where each drive is logged, if it is.

    raises  UserError if a directory holds a drive
    """
    directory, began = arguments.path("log"), float(int(time.time()))
    if directory is None:
        return [None] * len(wanted)
    places = [directory / job.name if len(wanted) > 1 else directory for job in wanted]
    for place in places:
        for side in FILES:
            check_free(place, side)
    return [(place, began) for place in places]


def _run_all(
    setup: Setup, wanted: Sequence[Job], places: Sequence[Place | None], workers: int, *, keep: bool
) -> Iterator[Result]:
    """All drives, in order, on several cores; shows the progress.

    raises  RunError if a worker process dies
    """
    from concurrent.futures import BrokenExecutor

    from runner.simulation.runs import run_job
    from runner.system.spawned import process_pool
    from runner.verbs.screen import progress_bar

    each = list(zip(wanted, places, strict=True))
    with progress_bar() as progress:
        if min(workers, len(each)) == 1:
            for number, (job, place) in enumerate(each):
                progress("simulated", number / len(each))
                yield run_job(setup, job, keep, place)
        else:
            try:
                with process_pool(min(workers, len(each))) as pool:
                    running = [pool.submit(run_job, setup, job, keep, place) for job, place in each]
                    for number, one in enumerate(running):
                        progress("simulated", number / len(each))
                        yield one.result()
            except BrokenExecutor:
                raise RunError("a worker process ended without a result: it may have run out of memory") from None
        progress("simulated", 1.0)


def _table(results: Sequence[Result]) -> Iterator[str]:
    """A row for each link and prediction, means over windows and seeds."""
    from runner.simulation.figures import FIGURES

    groups: dict[tuple[str, str], list[Result]] = {}
    for result in results:
        groups.setdefault((result.job.link_name, result.job.prediction), []).append(result)
    shown = [key for key in FIGURES if key != "tcp" or any(one.figures["tcp"] for one in results)]
    yield _row("link", "prediction", "drives", *(FIGURES[key][0] for key in shown))
    yield _row(*["---"] * (len(shown) + 3))
    for (link, kind), some in groups.items():
        means = (_mean([one.figures[key] for one in some], FIGURES[key][1]) for key in shown)
        yield _row(link, kind, str(len(some)), *means)


def _mean(values: Sequence[float], digits: int) -> str:
    known = [value for value in values if isfinite(value)]
    return f"{fmean(known):.{digits}f}" if known else "-"


def _row(*cells: str) -> str:
    return f"| {' | '.join(cells)} |"
