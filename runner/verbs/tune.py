"""usage: tod-runner tune [OVERRIDE ...] [vary=NUMBER...] [links=LINK,...] [left_out=LINK,...] [predictions=KIND,...]
                       [seeds=3] [windows=6] [duration_s=60] [since_s=3] [output=FILE.json] [figure=FILE.png]
                       [workers=N] ...

Tries other values of the numbers of a modes file by simulation: each value drives over the same links, under the same
predictions and with the same seeds as the values in force. The table has a row for each value, with its override, what
it changes on the links for tuning and, as a check, on links that are left out of it, and whether it is better on both.
The modes file is never written.

vary= names numbers as MODE.RULE.NUMBER, with values, each tried alone: automatic.follow_link.start=[0.25,0.5,1] or
=range(1,4). Without values a number is halved and doubled; MODE or MODE.RULE stands for all its numbers. Several are
separated by blanks. Without vary= each number that the modes file states for the mode in force (mode=) is halved and
doubled, where the rule takes it. RULE is the name in the modes file.

left_out= are the links of the check (left_out: handover and shared), none of them in links=. Their seeds begin at 100.
seeds= must be 2 or more: a difference has to exceed what they spread.

Everything else is as in simulate (tod-runner simulate --help): links=, which may also name files and drives,
predictions=, windows=, duration_s=, since_s= (0 for numbers of the start), and what describes encoders, link and
reports. output= has the table and the figures of each drive; figure= draws use against the wait in the queue.

  tod-runner tune fps_max=15 vary='automatic.follow_link.start=[0.25,0.5,1]' predictions=right,noise,absent since_s=0
  tod-runner tune fps_max=15 links=uplinks/a.csv,DRIVE left_out=uplinks/b.csv predictions=absent
  tod-runner tune modes=steady vary='automatic.hold_upscaling automatic.follow_link.reserve_kbps=0,200' figure=f.png
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from runner.errors import ArgumentError
from runner.system.files import write_whole
from runner.verbs import Arguments, simulated
from runner.verbs.screen import say
from runner.verbs.simulated import row

if TYPE_CHECKING:
    from runner.simulation.comparison import Compared, Means
    from runner.simulation.numbers import Trial
    from runner.simulation.runs import Common, Job, Result

Sets = tuple[list["Job"], list["Job"]]  # drives over the links for tuning, and over those left out


def run(arguments: Arguments) -> int:
    from runner.simulation.comparison import CRITERION, compared, means
    from runner.simulation.runs import check

    common = simulated.common(arguments)
    figure, workers, sets = simulated.figure(arguments), simulated.workers(arguments), _sets(arguments, common)
    drives = [*sets[0], *sets[1]]
    check(common, drives)
    tried = _trials(arguments, common, drives)
    say(f"{len(tried)} value{'s' if len(tried) > 1 else ''} and those in force, on {len(drives)} drives each")
    wanted = [*drives, *(job._replace(words=(*job.words, trial.override)) for trial in tried for job in drives)]
    results = list(simulated.run_all(common, wanted, [None] * len(wanted), workers, keep=False))
    base, *others = (_of_sets(results[at : at + len(drives)], sets) for at in range(0, len(results), len(drives)))
    in_force = [means(some) for some in base]
    values = [compared(trial, base, other) for trial, other in zip(tried, others, strict=True)]
    print("\n".join([*_table(in_force, values), "", CRITERION]))
    if output := arguments.path("output"):
        write_whole(output, json.dumps(_json(in_force, values, results), indent=1).encode())
    if figure:
        from runner.simulation.tuning_picture import draw

        draw(in_force, values, figure)
    return 0


def _sets(arguments: Arguments, common: Common) -> Sets:
    """raises ArgumentError, ConfigError"""
    from runner.simulation.families import LEFT_OUT, LEFT_OUT_SEED
    from runner.simulation.runs import jobs

    tuned, left_out = simulated.links(arguments), simulated.links(arguments, "left_out", "left_out")
    if both := [link for link in tuned if link in (*LEFT_OUT, *left_out)]:
        raise ArgumentError("links", ", ".join(both), "left out: a number that is chosen there cannot be checked there")
    seeds = simulated.seeds(arguments, "3")
    if len(seeds) < 2:
        raise ArgumentError("seeds", str(len(seeds)), "must be 2 or more: a difference has to exceed what they spread")
    kinds, windows = simulated.predictions(arguments), simulated.windows(arguments)
    fresh = range(LEFT_OUT_SEED, LEFT_OUT_SEED + len(seeds))
    return jobs(common, tuned, kinds, seeds, windows), jobs(common, left_out, kinds, fresh, windows)


def _trials(arguments: Arguments, common: Common, drives: Sequence[Job]) -> list[Trial]:
    """raises ArgumentError, ConfigError"""
    from runner.simulation.numbers import trials
    from runner.simulation.runs import rules_in_force

    vary = arguments.values.get("vary")
    tried, skipped = trials(vary, *rules_in_force(common, drives))
    if not tried:
        raise ArgumentError("vary", vary, "; ".join(skipped) or "gives no value but those in force")
    for what in skipped:
        say(what)
    return tried


def _of_sets(results: Sequence[Result], sets: Sets) -> tuple[Sequence[Result], Sequence[Result]]:
    return results[: len(sets[0])], results[len(sets[0]) :]


def _table(in_force: Sequence[Means], values: Sequence[Compared]) -> Iterator[str]:
    """A row for each value: means over the drives, and by how much they differ from those in force."""
    from runner.simulation.comparison import SHOWN
    from runner.simulation.figures import FIGURES

    columns = [FIGURES[key][0] for key in SHOWN]
    yield row("override", *columns, *(f"left out: {column}" for column in columns), "verdict")
    yield row(*["---"] * (2 * len(columns) + 2))
    yield row("in force", *(_number(key, some[key]) for some in in_force for key in SHOWN), "")
    for one in values:
        both = zip(one.means, one.differences, strict=True)
        cells = (
            f"{_number(key, some[key])} {_number(key, changes[key].difference, '+z')}"
            for some, changes in both
            for key in SHOWN
        )
        yield row(one.trial.override, *cells, one.verdict)


def _number(key: str, value: float, sign: str = "") -> str:
    """With a digit more than a single drive deserves, since differences are small."""
    from runner.simulation.figures import FIGURES

    return f"{value:{sign}.{FIGURES[key][1] + 1}f}"


def _json(in_force: Sequence[Means], values: Sequence[Compared], results: Sequence[Result]) -> dict[str, Any]:
    from runner.simulation.comparison import SETS

    return {
        "in_force": dict(zip(SETS, in_force, strict=True)),
        "values": [one.to_json() for one in values],
        "drives": [one.to_json() for one in results],
    }
