"""Whether drives with another value of a number are better than those with the value in force. Pure."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from math import inf, isfinite, nan, sqrt
from statistics import fmean, stdev
from typing import Any, NamedTuple

from runner.simulation.numbers import Trial
from runner.simulation.runs import Result

SETS = ("tuned", "left_out")  # drives over the links for tuning, and over those left out
SHOWN = ("use", "p95", "p99", "frozen")
# What a change is judged by: a difference beyond this one counts, and 1 if more is better, otherwise -1.
JUDGED = {"use": (0.005, 1), "p95": (2.0, -1), "frozen": (0.3, -1)}
ERRORS = 3  # standard errors of a mean over seeds, by which a difference must exceed chance
CRITERION = (
    f"better: on both sets of links use rises by over {JUDGED['use'][0]:g}, p95 falls by over {JUDGED['p95'][0]:g} ms, "
    f"or frozen by over {JUDGED['frozen'][0]:g} points, beyond {ERRORS} standard errors over the seeds; and none of "
    "them is worse by as much on either set"
)


class Difference(NamedTuple):
    """From the value in force to another one, in the unit of a figure.

    difference  over all drives, each compared with the same one under the value in force
    spread      ERRORS standard errors of that, from the means of each seed; inf: fewer than two have the figure
    """

    difference: float
    spread: float


Means = Mapping[str, float]  # by figure
Differences = Mapping[str, Difference]


class Compared(NamedTuple):
    """A value and what it changes, on the links for tuning and on those left out."""

    trial: Trial
    means: tuple[Means, Means]
    differences: tuple[Differences, Differences]

    @property
    def verdict(self) -> str:
        return verdict(*self.differences)

    def to_json(self) -> dict[str, Any]:
        sets = {
            name: {key: {"mean": some[key], **changed[key]._asdict()} for key in SHOWN}
            for name, some, changed in zip(SETS, self.means, self.differences, strict=True)
        }
        return {"override": self.trial.override, "verdict": self.verdict, **sets}


def compared(trial: Trial, in_force: Sequence[Sequence[Result]], other: Sequence[Sequence[Result]]) -> Compared:
    """The same drives under both values, of both sets of links."""
    tuned, left_out = (differences(*pair) for pair in zip(in_force, other, strict=True))
    return Compared(trial, (means(other[0]), means(other[1])), (tuned, left_out))


def means(results: Sequence[Result]) -> dict[str, float]:
    """By figure, over all drives."""
    return {key: _mean([one.figures[key] for one in results]) for key in SHOWN}


def differences(in_force: Sequence[Result], other: Sequence[Result]) -> dict[str, Difference]:
    """By figure; the drives are the same ones in the same order."""
    return {key: _difference(key, in_force, other) for key in SHOWN}


def _difference(key: str, in_force: Sequence[Result], other: Sequence[Result]) -> Difference:
    of_seeds: dict[int, list[float]] = {}
    for before, after in zip(in_force, other, strict=True):
        of_seeds.setdefault(after.job.seed, []).append(after.figures[key] - before.figures[key])
    each = [mean for values in of_seeds.values() if isfinite(mean := _mean(values))]
    return Difference(_mean(each), ERRORS * stdev(each) / sqrt(len(each)) if len(each) > 1 else inf)


def _mean(values: Sequence[float]) -> float:
    known = [value for value in values if isfinite(value)]
    return fmean(known) if known else nan


def verdict(tuned: Differences, left_out: Differences) -> str:
    """In words, by CRITERION.

    tuned, left_out  on the links for tuning, and on those left out
    """
    if not any(change.difference for some in (tuned, left_out) for change in some.values()):
        return "keeps: changes nothing"
    if worse := ", ".join(_worse(tuned, left_out)):
        return f"keeps: worse in {worse}"
    better = [key for key in JUDGED if _is_better(key, tuned[key])]
    if both := [key for key in better if _is_better(key, left_out[key])]:
        return f"better in {', '.join(both)}"
    return f"keeps: better in {', '.join(better)} only where it is tuned" if better else "keeps: no clear difference"


def _worse(tuned: Differences, left_out: Differences) -> Iterator[str]:
    for key, (least, sign) in JUDGED.items():
        where = [-sign * some[key].difference > least for some in (tuned, left_out)]
        if any(where):
            yield key if all(where) else f"{key} ({'tuned' if where[0] else 'left out'})"


def _is_better(key: str, change: Difference) -> bool:
    least, sign = JUDGED[key]
    return sign * change.difference > max(least, change.spread)
