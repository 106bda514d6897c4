"""What predictions were worth in a drive: what was predicted against what the link could carry. Pure."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from runner.core.learned import MEMORY_S
from runner.drive.capacity import carried
from runner.drive.series import Series
from runner.drive.time_series import Flags, FloatSeries, held

EVERY_S = 0.1
CHANGE_S = 0.4  # over which changes are compared
CHANGE, CHANGES = 0.1, 5  # ln: a change that is more than noise, and how many must have been seen to tell a delay
MOST_S = 5.0  # the longest delay that is looked for
IN_TIME_S = 0.25  # what is believed is some 0.1 to 0.2 s late itself
ALIKE, LESS = 0.5, 0.05  # correlation of changes with those predicted: least, and by how much less is as good


class Compared(NamedTuple):
    """Prediction and capacity of the link, kbit/s, at regular times, s; both nan where either is unknown."""

    t: FloatSeries
    predicted: FloatSeries
    carried: FloatSeries

    @property
    def off(self) -> FloatSeries:
        """ln(carried / predicted)."""
        return _ln(self.carried) - _ln(self.predicted)


class Worth(NamedTuple):
    """bias, error  mean of ln(carried / predicted), and the deviation from it
    late_s       by how much changes were predicted too late, below 0: too early; None: it cannot be told
    """

    bias: float
    error: float
    late_s: float | None

    @property
    def words(self) -> str:
        share = np.exp(-self.bias) - 1
        level = f"{abs(share):.0%} too {'high' if share > 0 else 'low'}"
        return f"{level} ± {self.error:.0%}{self._late_words}"

    @property
    def _late_words(self) -> str:
        if self.late_s is None:
            return ""
        if abs(self.late_s) < IN_TIME_S:
            return ", in time"
        return f", {abs(self.late_s):.1f} s {'late' if self.late_s > 0 else 'early'}"


def compared(drive: Series) -> Compared | None:
    """None: nothing was predicted, or believed of the link, for long enough."""
    if not drive.believed or not drive.predicted.t.size:
        return None
    t = np.arange(0.0, drive.end, EVERY_S)
    predicted, came = held(drive.predicted, t), carried(drive, t)
    known = np.isfinite(predicted) & np.isfinite(came)
    found = Compared(t, *(np.where(known, line, np.nan) for line in (predicted, came)))
    return found if known.sum() * EVERY_S >= MEMORY_S else None


def worth(found: Compared) -> Worth:
    """Over the whole drive."""
    known = found.off[np.isfinite(found.off)]
    return Worth(float(known.mean()), float(known.std()), _late_s(_ln(found.predicted), _ln(found.carried)))


def _ln(kbps: FloatSeries) -> FloatSeries:
    return np.log(np.maximum(kbps, 1.0))


def _late_s(predicted: FloatSeries, came: FloatSeries) -> float | None:
    """The delay at which changes of both, ln, are most alike; of several that are as good, the shortest."""
    apart = round(CHANGE_S / EVERY_S)
    p, x = (line[apart:] - line[:-apart] for line in (predicted, came))
    if min(_number(np.abs(change) > CHANGE) for change in (p, x)) < CHANGES:
        return None
    most = round(MOST_S / EVERY_S)
    alike = {n * EVERY_S: _correlation(p, x, n) for n in range(-most, most + 1)}
    best = max(alike.values())
    return min((late for late, r in alike.items() if r >= best - LESS), key=abs) if best >= ALIKE else None


def _number(flags: Flags) -> int:
    """How often a condition begins."""
    return int((np.diff(flags.astype(int), prepend=0) > 0).sum())


def _correlation(predicted: FloatSeries, came: FloatSeries, later: int) -> float:
    """Of changes that came with those predicted so many samples later; 0 if only few of them are known."""
    p, x = (predicted[later:], came[: len(came) - later]) if later >= 0 else (predicted[:later], came[-later:])
    known = np.isfinite(p) & np.isfinite(x)
    if 2 * known.sum() < np.isfinite(came).sum():
        return 0.0
    p, x = p[known], x[known]
    power = float((p * p).sum() * (x * x).sum())
    return float((p * x).sum()) / power**0.5 if power else 0.0
