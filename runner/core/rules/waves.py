"""How often x264's refresh waves begin, by what the uplink loses."""

from __future__ import annotations

from fractions import Fraction
from math import ceil, floor
from typing import NamedTuple

from runner.core.decision import Draft
from runner.core.graph_settings import NEVER_S
from runner.core.model import Vehicle, exact, least_float, plain
from runner.core.rules.registry import Memory, Step, rule
from runner.core.state import State

STEP_S = Fraction(1, 2)  # of the time between two waves


class _Lost(NamedTuple):
    """The greatest loss lately, and when it was last as great, s."""

    share: float
    at: float


@rule(gives=["wave_s"], reads=["link", "links", "t"])
def waves_by_loss(
    vehicle: Vehicle,
    state: State,
    draft: Draft,
    memory: Memory,
    *,
    loss: Fraction = Fraction(1, 100),
    calm_s: Fraction = Fraction(10),
) -> Step:
    """Without loss, refresh waves are as rare as a graph allows, with loss as frequent as its key interval states.

    Waves cost bits: 6 to 8 % every 1.5 s. What is lost is first sent again, and a picture that stays damaged is
    repaired on request; the waves heal what nobody reports. While nobody measures the link, they are frequent.

    loss    share of the packets from which on waves are most frequent; they are rarer with less
    calm_s  for which a loss counts
    Memory: `_Lost`, the worst of all uplinks.
    """
    links = list(state.links.values()) if vehicle.uplinks else [state.link] if state.link else []
    if not links:
        return draft.replaced(wave_s=_intervals(vehicle, Fraction(1))), memory
    now = max(link.loss for link in links)
    past: _Lost = memory.get("lost", _Lost(0.0, state.t))
    if now >= past.share or state.t - past.at >= least_float(calm_s):
        past = _Lost(now, state.t)
        memory = {"lost": past}
    share = min(Fraction(1), exact(round(past.share, 4)) / loss) if loss else Fraction(int(past.share > 0))
    intervals = _intervals(vehicle, share)
    lost = f"{100 * past.share:.2g} % of the packets lost"
    words = ", ".join(f"{plain(each)} s" for each in sorted(set(intervals.values())) if each < NEVER_S)
    note = f"refresh waves every {words}: {lost}" if words else f"no refresh waves: {lost}"
    return draft.noted(note, wave_s=intervals) if intervals else draft.replaced(wave_s=intervals), memory


def _intervals(vehicle: Vehicle, share: Fraction) -> dict[str, Fraction]:
    """Time between two waves by camera whose graph asks for each; share: 1 for the shortest, 0 for the longest."""
    found = {}
    for name, camera in vehicle.cameras.items():
        if shortest := camera.graph.settings.shortest_wave_s:
            found[name] = _interval(exact(shortest), camera.graph.settings.key_interval_s, share)
    return found


def _interval(least: Fraction, longest: float | None, share: Fraction) -> Fraction:
    """longest: None: there may be no waves; then the number of waves goes with the loss, not the time between them."""
    if longest is None:
        return max(least, STEP_S * floor(least / share / STEP_S)) if share else exact(NEVER_S)
    return max(least, exact(longest) - STEP_S * ceil(share * (exact(longest) - least) / STEP_S))
