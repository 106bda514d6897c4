"""A rule of your own: `pip install ./rules`, then name it in modes/NAME.yaml; see docs/rules.md of tod-runner."""

from fractions import Fraction

from runner.model import Vehicle
from runner.rules import Draft, Memory, Step, rule
from runner.state import State


@rule(needs=["total"], gives=["total"], reads=["t"])
def total_cap(vehicle: Vehicle, state: State, draft: Draft, memory: Memory, *, cap_kbps: Fraction) -> Step:
    """The total is at most `cap_kbps`."""
    if draft.total is None or draft.total <= cap_kbps:
        return draft, memory
    return draft.noted(f"total {draft.total} -> {cap_kbps}: cap", total=cap_kbps), memory
