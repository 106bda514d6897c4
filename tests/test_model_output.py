"""Where `model` may write: a directory without files of the user's that it would replace."""

from __future__ import annotations

from pathlib import Path

import pytest

from runner.errors import UserError
from runner.rate_quality.artefact import MARK
from runner.rate_quality.measure import _check_output


@pytest.mark.parametrize("end", [".png", ".pdf", ".model.json", ".yaml"])
def test_a_file_of_the_users_own_is_not_overwritten(tmp_path: Path, end: str) -> None:
    own = tmp_path / f"front{end}"
    own.write_text("mine")
    with pytest.raises(UserError, match="exists and was not written by tod-runner model; choose another directory"):
        _check_output(tmp_path, ["front"], [])


def test_a_model_is_measured_again(tmp_path: Path) -> None:
    (tmp_path / "front.yaml").write_text(f"# {MARK} on front.mkv\n")
    (tmp_path / "front.png").touch()
    _check_output(tmp_path, ["front"], [])


def test_an_input_is_not_overwritten(tmp_path: Path) -> None:
    mask = tmp_path / "front.png"
    mask.touch()
    (tmp_path / "front.yaml").write_text(f"# {MARK} on front.mkv\n")
    with pytest.raises(UserError, match=f"output: '{mask}': is an input; choose another directory"):
        _check_output(tmp_path, ["front"], [tmp_path / "." / "front.png"])
