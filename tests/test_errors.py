"""Errors of processes of their own."""

from __future__ import annotations

import pickle

import pytest

from runner.errors import ConfigError, Problem, RunError, UserError

MISTAKE = Problem("a.yaml", "b", "'c'", "must be d")


@pytest.mark.parametrize(
    "error", [UserError("a", "b", "'c'", "must be d"), ConfigError([MISTAKE]), RunError("no disk")]
)
def test_an_error_keeps_its_text_and_kind(error: Exception) -> None:
    received = pickle.loads(pickle.dumps(error))
    assert (type(received), str(received)) == (type(error), str(error))


def test_problems_are_kept() -> None:
    assert pickle.loads(pickle.dumps(ConfigError([MISTAKE]))).problems == [MISTAKE]
