"""Public: the state that a rule is given, see docs/rules.md."""

from runner.core.state import State

__all__ = ["State"]
