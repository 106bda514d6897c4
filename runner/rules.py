"""Public: what your own rules import, see docs/rules.md."""

from runner.core.decision import Draft
from runner.core.rules import Memory, Step, rule

__all__ = ["Draft", "Memory", "Step", "rule"]
