"""Shared by the verbs that simulate drives: which ones, with which settings, and running them on several cores."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from runner.errors import ArgumentError, RunError
from runner.verbs import Arguments

if TYPE_CHECKING:
    from runner.simulation.runs import Common, Job, Result

ALL, SYNTHETIC = "all", "synthetic"
SHORTEST_S = 1.0  # that counts
MOST_SEEDS = 1000  # each is a drive for every link and prediction
FORMATS = (".png", ".pdf", ".svg")  # of the figure
Place = tuple[Path, float]  # directory of a drive, and when it began, s since 1970


def common(arguments: Arguments) -> Common:
    """What all drives have in common."""
    from runner.simulation.drive import Conditions
    from runner.simulation.encoder import EncoderModel
    from runner.simulation.runs import DURATION_S, Common, Scheduler

    def number(key: str, default: float = 0.0) -> float:
        value = arguments.number(key)
        return default if value is None else value

    duration_s, since_s = arguments.number("duration_s"), number("since_s", Common.since_s)
    if (shown_s := DURATION_S if duration_s is None else duration_s) < since_s + SHORTEST_S:
        rule = f"must be at least {since_s + SHORTEST_S:g}: the first {since_s:g} s do not count"
        raise ArgumentError("duration_s", f"{shown_s:g}", rule)
    if (lost := number("report_loss")) > 1:
        raise ArgumentError("report_loss", f"{lost:g}", "must be a share from 0 to 1")
    credit_ms, grant_ms = number("credit_ms"), number("grant_ms")
    return Common(
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
        since_s,
    )


def links(arguments: Arguments, key: str = "links", default: str = "") -> list[str]:
    """The families, files and drives that an argument names; by default the links of the experiment, or synthetic."""
    from runner.simulation.families import FAMILIES, LEFT_OUT

    several = {SYNTHETIC: FAMILIES, "left_out": LEFT_OUT}
    named = _list(arguments, key, default or _repeated(arguments) or SYNTHETIC)
    return [link for name in named for link in several.get(name, (name,))]


def predictions(arguments: Arguments) -> list[str]:
    """The kinds of predictions= by name."""
    from runner.simulation.predictions import KINDS

    chosen = _list(arguments, "predictions", _repeated(arguments) or ALL)
    return [kind for name in chosen for kind in (KINDS if name == ALL else [name])]


def _repeated(arguments: Arguments) -> str:
    """The link and the predictions of an experiment; "": there is none."""
    from runner.simulation.runs import CONFIGURED

    return CONFIGURED if any(word.startswith("experiment=") for word in arguments.overrides) else ""


def seeds(arguments: Arguments, default: str = "1") -> range:
    text = arguments.values.get("seeds", default)
    found = re.fullmatch(r"(?:(\d{1,9})-)?(\d{1,9})", text, re.ASCII)
    first, last = (int(found[1] or 1), int(found[2])) if found else (1, 0)
    if not 1 <= first <= last:
        raise ArgumentError("seeds", repr(text), "must be their number, or the first and the last: 3 or 100-102")
    if last - first >= MOST_SEEDS:
        raise ArgumentError("seeds", repr(text), f"must be {MOST_SEEDS} at most")
    return range(first, last + 1)


def windows(arguments: Arguments) -> int:
    """How many of each file, at most."""
    return _count(arguments, "windows", 6)


def workers(arguments: Arguments) -> int:
    return _count(arguments, "workers", len(os.sched_getaffinity(0)))


def _count(arguments: Arguments, key: str, default: int) -> int:
    text = arguments.values.get(key, str(default))
    if not text.isdecimal() or not int(text):
        raise ArgumentError(key, repr(text), "must be a whole number of 1 or more")
    return int(text)


def _list(arguments: Arguments, key: str, default: str) -> list[str]:
    found = [word for word in arguments.values.get(key, default).split(",") if word]
    if not found:
        raise ArgumentError(key, repr(arguments.values[key]), "must have one name at least")
    return found


def figure(arguments: Arguments) -> Path | None:
    """Where a figure is drawn, if it is."""
    path = arguments.path("figure")
    if path and path.suffix not in FORMATS:
        raise ArgumentError("figure", path, f"must end in {', '.join(FORMATS)}")
    return path


def run_all(
    common: Common, wanted: Sequence[Job], places: Sequence[Place | None], workers: int, *, keep: bool
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
                yield run_job(common, job, keep, place)
        else:
            try:
                with process_pool(min(workers, len(each))) as pool:
                    running = [pool.submit(run_job, common, job, keep, place) for job, place in each]
                    for number, one in enumerate(running):
                        progress("simulated", number / len(each))
                        yield one.result()
            except BrokenExecutor:
                raise RunError("a worker process ended without a result: it may have run out of memory") from None
        progress("simulated", 1.0)


def row(*cells: str) -> str:
    """Of a table in Markdown."""
    return f"| {' | '.join(cells)} |"
