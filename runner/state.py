"""Public: the state that is passed to a rule, see docs/rules.md."""

from runner.core.state import State

__all__ = ["State"]
