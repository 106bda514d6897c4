"""The ROS package with the launch files: its command lines are valid, and it installs all of its files."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path
from xml.etree import ElementTree

import pytest

from runner.configuration.config import configuration
from runner.verbs import VERBS

CHECKOUT = Path(__file__).resolve().parents[1]
PACKAGE = CHECKOUT / "deploy/ros2/tod_runner_launch"
LAUNCH = sorted((PACKAGE / "launch").glob("*.xml"))


def commands(file):
    """The command lines of a launch file, with vehicle=delivery_robot and the defaults of all other arguments."""
    root = ElementTree.parse(file).getroot()
    values = {one.get("name"): one.get("default", "delivery_robot") for one in root.iter("arg")}
    return [
        shlex.split(re.sub(r"\$\(var (\w+)\)", lambda found: values[found[1]], one.get("cmd")))
        for one in root.iter("executable")
    ]


@pytest.mark.parametrize("file", LAUNCH, ids=lambda file: file.name)
def test_command_lines_of_launch_files_are_valid(file):
    started = commands(file)
    assert [line[0] for line in started] == ["tod-runner", "tod-runner"]
    names = set()
    for _, verb, *words in started:
        assert verb in VERBS
        topics = [f"cameras.{name}.topic=/{name}" for name in ("front", "rear", "mast")]
        ros = configuration([*words, *topics], runnable=False).setup().ros
        names.add((ros.node, ros.pictures))
        assert ros.python == "python3"
    assert len(names) == 2  # nodes of different names


def test_the_package_is_of_this_version():
    root = ElementTree.parse(PACKAGE / "package.xml").getroot()
    project = tomllib.loads((CHECKOUT / "pyproject.toml").read_text())["project"]
    assert root.findtext("version") == project["version"]
    assert root.findtext("license") == project["license"]["text"]


def test_it_installs_all_of_its_files(tmp_path):
    command = [sys.executable, "setup.py", "-q", "build", "-b", str(tmp_path / "build"), "install_data", "-d"]
    subprocess.run([*command, str(tmp_path / "to")], cwd=PACKAGE, check=True, capture_output=True, timeout=60)
    found = {str(path.relative_to(tmp_path / "to/share")) for path in (tmp_path / "to").rglob("*") if path.is_file()}
    assert found == {
        "ament_index/resource_index/packages/tod_runner_launch",
        "tod_runner_launch/package.xml",
        *(f"tod_runner_launch/launch/{file.name}" for file in LAUNCH),
    }
