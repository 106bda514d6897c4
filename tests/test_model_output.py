"""Where `model` may write: a directory without files of the user's that it would replace."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from runner.configuration.config import configuration
from runner.errors import UserError
from runner.rate_quality.artefact import MARK
from runner.rate_quality.measure import measure


def measured(output: Path, **study: Any) -> None:
    """Measure a model of a clip that is missing, which is noticed after what this tests."""
    config = configuration(["vehicle=delivery_robot"], runnable=False)
    clips = {"front": [output / "front.mkv"]}
    next(measure(config.vehicle(), replace(config.study(), **study), clips, output, lambda *_: None, print))


@pytest.mark.parametrize("end", [".png", ".pdf", ".model.json", ".yaml"])
def test_a_file_of_the_users_own_is_not_overwritten(tmp_path: Path, end: str) -> None:
    own = tmp_path / f"front{end}"
    own.write_text("mine")
    with pytest.raises(UserError, match="exists and was not written by tod-runner model; choose another directory"):
        measured(tmp_path)


def test_a_model_is_measured_again(tmp_path: Path) -> None:
    (tmp_path / "front.yaml").write_text(f"# {MARK} on front.mkv\n")
    (tmp_path / "front.png").touch()
    with pytest.raises(UserError, match=r"front\.mkv"):
        measured(tmp_path)


def test_an_input_is_not_overwritten(tmp_path: Path) -> None:
    mask = tmp_path / "front.png"
    mask.touch()
    (tmp_path / "front.yaml").write_text(f"# {MARK} on front.mkv\n")
    with pytest.raises(UserError, match=f"output: '{mask}': is an input; choose another directory"):
        measured(tmp_path, masks={"front": tmp_path / "." / "front.png"})
