"""A rule as a user of tod-runner writes it; frozen: it must run unchanged with every later version."""

from fractions import Fraction

from runner.model import Vehicle
from runner.rules import Draft, Memory, Step, rule
from runner.state import State


@rule(needs=["total"], gives=["total"], reads=["t"])
def night_cap(vehicle: Vehicle, state: State, draft: Draft, memory: Memory, *, cap_kbps: Fraction) -> Step:
    """The total is at most `cap_kbps`."""
    assert draft.total is not None
    if draft.total <= cap_kbps:
        return draft, memory
    return draft.noted(f"total {draft.total} -> {cap_kbps}: night", total=cap_kbps), memory
