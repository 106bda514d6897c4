"""Public: what a rule of your own imports, see docs/rules.md."""

from runner.core.decision import Draft
from runner.core.rules import Memory, Step, rule

__all__ = ["Draft", "Memory", "Step", "rule"]
