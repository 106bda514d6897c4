"""Commands that set the bitrate of cameras: called seldom, with the newest value, killed when late."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from rig import until
from runner.core.graph_settings import KnobCommand
from runner.system.camera_control import CameraControls


class Camera:
    """A camera whose command is a shell script, with what is reported of it."""

    def __init__(self, directory: Path, every_s: float = 0.2, within_s: float = 5.0) -> None:
        self.script, self.log, self.reports = directory / "set-bitrate", directory / "log", list[str]()
        self.says('echo "$1" >> "$(dirname "$0")/log"')
        command = KnobCommand((str(self.script), "{kbps}", "{bps}"), every_s, within_s)
        self.controls = CameraControls({"rear": command}, lambda: None, lambda _, what: self.reports.append(what))

    def says(self, script: str) -> None:
        new = self.script.with_suffix(".new")
        new.write_text(f"#!/bin/sh\n{script}\n")
        new.chmod(0o755)
        new.replace(self.script)

    def ask(self, kbps: int) -> None:
        self.controls.turn({"rear": {"bitrate": kbps}})

    @property
    def set_to(self) -> list[str]:
        return self.log.read_text().split() if self.log.exists() else []

    @property
    def accepted(self) -> object:
        return self.controls.applied("rear", {"bitrate": 1, "sending": True}).get("bitrate")


@pytest.fixture
def camera(tmp_path: Path) -> Iterator[Camera]:
    made = Camera(tmp_path)
    yield made
    made.controls.stop()


def test_the_newest_of_many_values_is_set(camera: Camera) -> None:
    assert camera.accepted is None
    for kbps in range(100, 1000):
        camera.ask(kbps)
    until(lambda: camera.accepted == 999)
    assert camera.set_to[-1] == "999"
    assert len(camera.set_to) <= 3
    assert camera.reports == []


def test_calls_keep_their_distance(tmp_path: Path) -> None:
    camera = Camera(tmp_path, every_s=1.0)
    camera.says('date +%s.%N >> "$(dirname "$0")/log"')
    for kbps in (100, 200, 300):
        camera.ask(kbps)
        until(lambda: camera.accepted == kbps)  # noqa: B023
    camera.controls.stop()
    times = [float(t) for t in camera.set_to]
    assert times[-1] - times[0] > 1.2  # of two seconds: a call may begin late


def test_a_failure_is_said_once_in_one_line_and_tried_again(camera: Camera) -> None:
    camera.says("echo 401; echo Unauthorized >&2; exit 22")
    camera.ask(500)
    why = f"its bitrate cannot be set: {camera.script}: status 22: 401 Unauthorized; trying again"
    until(lambda: camera.reports == [why])
    camera.ask(600)
    time.sleep(0.5)
    assert (camera.reports, camera.accepted) == ([why], None)
    camera.says("exit 0")
    until(lambda: camera.accepted == 600)
    until(lambda: camera.reports == [why, "its bitrate can be set again"])


def test_a_call_that_hangs_is_killed_with_all_that_it_started(tmp_path: Path) -> None:
    camera = Camera(tmp_path, within_s=0.5)
    camera.says('sleep 1000 & echo $! > "$(dirname "$0")/log"; wait')
    camera.ask(500)
    until(lambda: camera.reports)
    assert camera.reports == [f"its bitrate cannot be set: {camera.script}: no answer within 0.5 s; trying again"]
    child = int(camera.set_to[0])
    until(lambda: not runs(child))
    camera.controls.stop()


def runs(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_a_program_that_is_missing_is_said(tmp_path: Path) -> None:
    camera = Camera(tmp_path)
    camera.script.unlink()
    camera.ask(500)
    until(lambda: camera.reports)
    assert camera.reports[0].endswith("set-bitrate: no such program, or it may not be run; trying again")
    camera.controls.stop()


def test_it_ends_during_a_call(tmp_path: Path) -> None:
    camera = Camera(tmp_path, within_s=60)
    camera.says('echo $$ > "$(dirname "$0")/log"; exec sleep 1000')
    camera.ask(500)
    until(lambda: camera.set_to)
    camera.controls.stop()
    until(lambda: not runs(int(camera.set_to[0])))
    assert camera.reports == []


def test_it_ends_with_the_vehicle_however_that_ends(tmp_path: Path) -> None:
    pids = tmp_path / "pid"
    program = f"""
import time
from runner.core.graph_settings import KnobCommand
from runner.system.camera_control import CameraControls
command = KnobCommand(("/bin/sh", "-c", "echo $$ > {pids}; exec sleep 1000", "{{kbps}}"), 1, 60)
CameraControls({{"rear": command}}, lambda: None, lambda *_: None).turn({{"rear": {{"bitrate": 1}}}})
time.sleep(1000)
"""
    with subprocess.Popen([sys.executable, "-c", program], env={**os.environ, "PYTHONPATH": str(ROOT)}) as vehicle:
        until(lambda: pids.exists() and pids.read_text().strip())
        vehicle.kill()
    until(lambda: not runs(int(pids.read_text())))


ROOT = Path(__file__).resolve().parents[1]
