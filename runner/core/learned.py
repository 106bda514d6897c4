"""What is known of predictions of the uplink's capacity: how far their changes, and their level, are right. Pure.

x is the logarithm of the capacity, p that of the prediction. The gain is the regression of changes of x on
changes of p; bias and error are mean and variance of x - p. All are forgotten with MEMORY_S.
"""

from __future__ import annotations

from typing import NamedTuple

from runner.core.history import History, recorded, value_at

MEMORY_S = 10.0  # of the gain, the bias and the error
HORIZON_S = 0.2  # until a change of the total shows in what is measured
PRIOR = 0.05  # weight of "changes of a prediction are right"
WRONG = 0.35  # deviation of a prediction that nobody has checked, ln
KEPT_S = 1.0


class Learned(NamedTuple):
    """ln             the newest prediction; None: there is none
    bias, error    mean of x - ln and variance about it
    sxx, sxy       sums of the regression of the changes of x on those of ln
    past           earlier predictions
    compared_s     for how long predictions have been compared with what came
    """

    ln: float | None = None
    bias: float = 0.0
    error: float = WRONG**2
    sxx: float = PRIOR
    sxy: float = PRIOR
    past: History[float | None] = ()
    compared_s: float = 0.0

    @property
    def is_level_known(self) -> bool:
        """Whether bias and error are those of predictions, more than what they were at first."""
        return self.compared_s >= MEMORY_S

    @property
    def is_gain_known(self) -> bool:
        """Whether changes that were compared weigh more than what was assumed of them."""
        return self.sxx > 2 * PRIOR

    @property
    def gain(self) -> float:
        """Share of a change that comes true, 0 to 1."""
        return min(1.0, max(0.0, self.sxy / self.sxx))

    def starting(self, bias: float, error: float) -> Learned:
        """With what the source of predictions states of them, until they have been compared with what came."""
        return self if self.compared_s else self._replace(bias=bias, error=error * error)

    def followed(self, m: float, v: float, ln: float) -> tuple[float, float]:
        """A belief's mean and variance after the prediction has changed to `ln`: news of a change, and of a level.

        How far it moves is how uncertain it becomes: the next reports decide, or a gain would confirm itself.
        """
        assert self.ln is not None
        change = ln - self.ln
        k = v / (v + self.error)
        moved = m + self.gain * change
        moved += k * (ln + self.bias - moved)
        return moved, (1 - k) * v + (moved - m) ** 2

    def stated(self, t: float, ln: float | None) -> Learned:
        """With the prediction from t on."""
        return self._replace(ln=ln, past=recorded(self.past, t, ln, KEPT_S))

    def judged(self, t: float, dt: float, levels: History[float]) -> Learned:
        """After what was measured until t. levels: the belief's mean over time."""
        before, now = value_at(levels, t - 2 * HORIZON_S), value_at(levels, t)
        p0, p1 = value_at(self.past, t - 2 * HORIZON_S), value_at(self.past, t - HORIZON_S)
        if self.ln is None or before is None or now is None or p0 is None or p1 is None:
            return self
        change, came, share, k = p1 - p0, now - before, dt / HORIZON_S, min(1.0, dt / MEMORY_S)
        sxx = self.sxx + share * change * change - k * (self.sxx - PRIOR)
        sxy = self.sxy + share * change * came - k * (self.sxy - PRIOR)
        seen = value_at(self.past, t - HORIZON_S / 2)  # what is measured now was served about then
        off = now - (p1 if seen is None else seen) - self.bias
        error = self.error + k * (min(1.0, off * off) - self.error)
        compared_s = self.compared_s + dt
        return self._replace(sxx=sxx, sxy=sxy, bias=self.bias + k * off, error=error, compared_s=compared_s)
