"""A mode is an ordered list of named rules; each adds to the draft of a decision, see `registry`."""

from runner.core.rules import steady  # noqa: F401  (registers its rules; so do the modules below)
from runner.core.rules.deciding import RuleFailed, decide, decide_without_link, reads
from runner.core.rules.registry import GIVEN, Memories, Memory, Rule, RuleCall, Step, rule
from runner.core.rules.safe import follow_link

__all__ = [
    "GIVEN",
    "Memories",
    "Memory",
    "Rule",
    "RuleCall",
    "RuleFailed",
    "Step",
    "decide",
    "decide_without_link",
    "follow_link",
    "reads",
    "rule",
]
