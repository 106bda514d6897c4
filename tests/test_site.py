"""The site file: what belongs to a machine, between the files of the configuration and the overrides."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers import Command, UserConf

from runner.configuration.config import configuration
from runner.configuration.files import site_file
from runner.errors import UserError

ROBOT = """\
# what this robot is
vehicle: delivery_robot
source: v4l2
keys: keys/robot
media: {host: 10.0.0.2}
control: {host: 10.0.0.1, port: 8883}
uplinks: {a: {interface: wwan0}, b: {interface: wwan1}}
cameras:
  front: {device: /dev/v4l/by-id/front}
"""


@pytest.fixture
def site(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """The site file of this test's user, who has none yet."""
    monkeypatch.delenv("TOD_SITE")
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    path = tmp_path / "config" / "tod-runner" / "site.yaml"
    path.parent.mkdir(parents=True)
    return path


def listed(tod: Command, *words: str) -> str:
    result = tod("print", *words, "format=yaml")
    assert result.status == 0, result.err
    return result.out


def test_its_values_stand_between_files_and_overrides(site: Path, tod: Command) -> None:
    site.write_text(ROBOT)
    text = listed(tod, "media.host=10.9.9.9", "cameras.rear.device=/dev/video3", "cameras.mast.device=/dev/video4")
    assert f"  host: 10.0.0.1  # {site}" in text
    assert "  host: 10.9.9.9  # command line: media.host=10.9.9.9" in text
    assert f"    device: /dev/v4l/by-id/front  # {site}" in text
    assert "name: delivery_robot  # conf/vehicle/delivery_robot.yaml" in text
    assert f"uplinks: {{a: {{interface: wwan0}}, b: {{interface: wwan1}}}}  # {site}" in text
    assert "element: v4l2src" in text


def test_an_override_replaces_its_choices(site: Path, tod: Command) -> None:
    site.write_text("vehicle: delivery_robot\nsource: v4l2\n")
    text = listed(tod, "vehicle=tum_q7", "source=test")
    assert "name: tum_q7" in text
    assert "v4l2src" not in text


def test_paths_are_relative_to_it(site: Path, tod: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/alice")
    site.write_text("keys: keys/robot\ncontrol: {foreign: true, credentials: ~/login, ca: /etc/ca.pem}\n")
    text = listed(tod)
    assert f"keys: {site.parent}/keys/robot  # {site}" in text
    assert f"  credentials: /home/alice/login  # {site}" in text
    assert "  ca: /etc/ca.pem" in text


@pytest.mark.parametrize(
    "text, problems",
    [
        ("media: {hots: 10.0.0.2}\n", ["media.hots: unknown key, did you mean host?"]),
        ("media: {port: '80'}\n", ["media.port: '80': must be a whole number"]),
        ("fps_max: 10\n", ["fps_max: does not belong to a machine: state it in the vehicle's file, or as an override"]),
        (
            "cameras: {front_left: {fps: 10}}\nmodes: {}\n",
            [
                f"{key}: does not belong to a machine: state it in the vehicle's file, or as an override"
                for key in ("modes", "cameras.front_left.fps")
            ],
        ),
        ("vehicle: tum_q8\n", ["vehicle: tum_q8: no such file in conf/vehicle/, did you mean tum_q7?"]),
        ("cameras: {front: {device: /dev/video0}}\n", ["cameras.front: the vehicle tum_q7 has no such camera"]),
        ("cameras: {front_lft: {device: /dev/video0}}\n", ["cameras.front_lft: the vehicle tum_q7 has no such camera"]),
        ("- a\n", ['["a"]: must be a mapping']),
        ("media: [\n", ["line 2: expected the node content"]),
    ],
)
def test_problems_name_the_file(text: str, problems: list[str], site: Path, tod: Command) -> None:
    site.write_text(text)
    found = tod("print").problems
    assert len(found) == len(problems)
    assert all(one.startswith(f"{site}: {rule}") for one, rule in zip(found, problems, strict=True)), found


def test_problems_of_words_and_file_come_together(site: Path, tod: Command) -> None:
    site.write_text("media: {prot: 1}\nvehicle: tum_q7\n")
    found = tod("print", "modes=safer").problems
    assert [line.partition(": ")[0] for line in found] == ["command line", str(site)]


def test_a_rule_about_two_values_names_both(site: Path, tod: Command) -> None:
    site.write_text("media: {port: 1884}\n")
    (found,) = tod("print").problems
    assert str(site) in found and "conf/config.yaml: control.port: 1884" in found


@pytest.mark.parametrize("verb", ["demo", "validate", "simulate", "tune", "replay", "model"])
def test_verbs_about_no_machine_ignore_it(verb: str) -> None:
    from runner.verbs import VERBS

    assert not VERBS[verb].sited


def test_a_file_of_comments_states_nothing(site: Path, tod: Command) -> None:
    without = listed(tod)
    site.write_text("# nothing yet\n")
    assert listed(tod) == without


def test_which_file_it_is(site: Path, tmp_path: Path) -> None:
    environment = {"XDG_CONFIG_HOME": str(tmp_path / "config")}
    assert site_file(environment) is None
    site.write_text("")
    assert site_file(environment) == site
    assert site_file(environment | {"TOD_SITE": ""}) is None
    other = tmp_path / "other.yaml"
    with pytest.raises(UserError, match="TOD_SITE"):
        site_file(environment | {"TOD_SITE": str(other)})
    other.write_text("")
    assert site_file(environment | {"TOD_SITE": str(other)}) == other


def test_doctor_names_it(site: Path, tod: Command) -> None:
    site.write_text("media: {port: 18554}\n")
    assert f"site file {site}" in tod("doctor", "vehicle").out
    assert "site file" not in tod("doctor", "demo").out


def test_a_vehicle_simulates_no_drive_unless_asked_to(conf: UserConf) -> None:
    def kind(*words: str, user: Path | None = None) -> object:
        return configuration(words, user, instead={"pqos": "live"}).document["pqos"]["kind"]

    assert kind() == "live"
    assert kind("pqos=map") == "map"
    assert kind("experiment=driving_test") == "map"
    conf.write("config.yaml", (Path("conf/config.yaml")).read_text().replace("pqos: map", "pqos: constant"))
    assert kind(user=conf.path) == "constant"
    assert configuration().document["pqos"]["kind"] == "map"
