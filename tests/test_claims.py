"""The paper's claims about its driving test, checked against drives that meet them and drives that do not."""

from __future__ import annotations

from pathlib import Path

import pytest
from drives import write_drive

from runner.configuration.config import configuration
from runner.drive.claims import claims
from runner.drive.read import read_drive
from runner.drive.series import series

pytestmark = pytest.mark.slow  # simulates whole drives

TEST = ("experiment=driving_test",)


def held(path: Path) -> dict[str, bool | None]:
    return {check.claim: check.holds for check in claims(series(read_drive(path)))}


def test_the_driving_test_does_what_the_paper_reports(tmp_path: Path) -> None:
    config = configuration(TEST, runnable=False)
    experiment, link = config.experiment(), config.link()
    assert (experiment.duration_s, experiment.claims, link) == (100, "driving_test", None)
    checks = claims(series(read_drive(write_drive(tmp_path / "drive", seconds=100, overrides=TEST))))
    assert len(checks) == 9
    assert [check.claim for check in checks if not check.holds] == []
    outcomes = {check.claim: check.outcome for check in checks}
    assert outcomes["The total bitrate ranges from 3000 to 8000 kbit/s (predicted)"] == "3030 to 7690 kbit/s"
    dip = "Around {} s lower resolutions are selected for all cameras except front center"
    assert outcomes[dip.format(15)] == "from 10.7 to 18.9 s for 7 cameras, not for front_center"
    assert outcomes[dip.format(55)] == "from 51.2 to 59.4 s for 7 cameras, not for front_center"
    last = "Between 70 and 90 s less is predicted, and no resolution is changed"
    assert outcomes[last].endswith("changes of no camera")


@pytest.mark.parametrize(
    "overrides, broken",
    [
        (["pqos.file=maps/demo_loop.csv", "pqos.position.speed_mps=4"], {"Around 15", "Around 55", "Between 70"}),
        (["cameras.top_left.weight=1.5"], {"The bitrates of the top views", "The top views get less"}),
        (["modes=equal"], {"Front left and right", "The top views get less", "Around 15", "Around 55"}),
    ],
)
def test_another_drive_breaks_the_claims_that_it_should(tmp_path: Path, overrides: list[str], broken: set[str]) -> None:
    """A check that cannot fail proves nothing."""
    found = held(write_drive(tmp_path / "drive", ["vehicle"], seconds=100, overrides=(*TEST, *overrides)))
    failed = {claim for claim, holds in found.items() if holds is False}
    assert {begin for begin in broken if any(claim.startswith(begin) for claim in failed)} == broken
    assert len(failed) < len(found)


def test_short_drives_and_other_vehicles_are_no_driving_test(tmp_path: Path) -> None:
    short = held(write_drive(tmp_path / "short", ["vehicle"], seconds=30, overrides=TEST))
    assert short["The test takes approximately 100 s"] is False
    assert short["Between 70 and 90 s less is predicted, and no resolution is changed"] is None
    assert short["Around 55 s lower resolutions are selected for all cameras except front center"] is None
    blink = held(write_drive(tmp_path / "blink", ["vehicle"], seconds=1, overrides=TEST))
    assert blink == {"The test takes approximately 100 s": False}
    robot = held(write_drive(tmp_path / "robot", seconds=5, overrides=(*TEST, "vehicle=delivery_robot")))
    assert robot == {"The paper's vehicle is driven": False}


def test_a_drive_without_an_experiment_claims_nothing(tmp_path: Path) -> None:
    assert held(write_drive(tmp_path / "drive", seconds=5)) == {}
