"""Which drives of `drives=DIR` stay, whatever happens while others are removed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from runner.drive.keeping import keeping_room, make_room
from runner.drive.log import PROTECTED, Log
from runner.settings import LogSettings

NOW = 1_800_000_000.0
DAY = 86_400.0
KB = 1e-6  # of 10^9 bytes


def drive(parent: Path, hour: int, kb: int = 1, age_days: float = 0.0) -> Path:
    """A drive that began at an hour and ended some days before NOW."""
    path = parent / f"2026-11-30T{hour:02}-00-00Z"
    (path / "video").mkdir(parents=True)
    (path / "drive.jsonl").write_bytes(b"x" * 500 * kb)
    (path / "video" / "front.mkv").write_bytes(b"x" * 500 * kb)
    at = NOW - age_days * DAY - 100 + hour
    for file in (path / "drive.jsonl", path / "video" / "front.mkv"):
        os.utime(file, (at, at))
    return path


def names(parent: Path) -> list[str]:
    return sorted(path.name[11:13] if path.name[0] == "2" else path.name for path in parent.iterdir())


def test_the_oldest_go_until_the_others_fit(tmp_path: Path) -> None:
    for hour in range(5):
        drive(tmp_path, hour, kb=10)
    said = make_room(tmp_path, LogSettings(keep_gb=25 * KB), NOW)
    assert names(tmp_path) == ["03", "04"]
    assert said == [f"drive {tmp_path / f'2026-11-30T0{hour}-00-00Z'} was removed: log.keep_gb" for hour in range(3)]
    assert make_room(tmp_path, LogSettings(keep_gb=25 * KB), NOW) == []


def test_age_counts_from_the_end(tmp_path: Path) -> None:
    for hour, age_days in enumerate((9, 7.01, 6.99, 0)):
        drive(tmp_path, hour, age_days=age_days)
    assert [line.rpartition(" ")[2] for line in make_room(tmp_path, LogSettings(keep_days=7), NOW)] == [
        "log.keep_days"
    ] * 2
    assert names(tmp_path) == ["02", "03"]


def test_without_limits_everything_stays(tmp_path: Path) -> None:
    drive(tmp_path, 0, age_days=10_000)
    with keeping_room(tmp_path, LogSettings(), print), keeping_room(None, LogSettings(keep_gb=1), print):
        assert names(tmp_path) == ["00"]
    assert make_room(tmp_path / "absent", LogSettings(keep_gb=1, keep_days=1)) == []


def test_what_is_protected_or_no_drive_stays(tmp_path: Path) -> None:
    (drive(tmp_path, 0) / PROTECTED).touch()
    drive(tmp_path, 1)
    (tmp_path / "monday").mkdir()
    (tmp_path / "monday" / "drive.jsonl").write_text("mine")
    (tmp_path / "2026-11-30T09-00-00Z").symlink_to(tmp_path / "monday")
    (tmp_path / "2026-11-30T10-00-00Z").write_text("a file")
    said = make_room(tmp_path, LogSettings(keep_gb=KB / 10, keep_days=1), NOW + 10 * DAY)
    assert names(tmp_path) == ["00", "09", "10", "monday"]
    assert said[-1] == f"drives in {tmp_path} take more than log.keep_gb: those that are left run or are protected"


def test_the_running_drive_stays_and_can_be_protected(tmp_path: Path) -> None:
    old, running = drive(tmp_path, 0), tmp_path / "2026-11-30T01-00-00Z"
    log = Log(running, "operator", {}, {}, print)
    assert log.protect("too early") == "this side logs no drive"
    log.begin()
    make_room(tmp_path, LogSettings(keep_gb=KB / 1000), time.time() + 10 * DAY)
    assert not old.exists()
    assert log.protect("alice: the last 60 s") is None
    log.close()
    assert (running / PROTECTED).read_text() == "alice: the last 60 s\n"
    make_room(tmp_path, LogSettings(keep_gb=KB / 1000), time.time() + 10 * DAY)
    assert running.exists()
    (running / PROTECTED).unlink()
    make_room(tmp_path, LogSettings(keep_gb=KB / 1000), time.time() + 10 * DAY)
    assert not running.exists()


def test_a_side_without_a_log_protects_nothing() -> None:
    log = Log(None, "vehicle", {}, {}, print)
    log.begin()
    assert log.protect("now") == "this side logs no drive"


def test_a_removal_that_was_interrupted_is_completed(tmp_path: Path) -> None:
    drive(tmp_path, 0).rename(tmp_path / ".2026-11-30T00-00-00Z.removed")
    protected = drive(tmp_path, 1)
    (protected / PROTECTED).touch()
    protected.rename(tmp_path / ".2026-11-30T01-00-00Z.removed")
    (tmp_path / ".hidden.removed").mkdir()
    assert make_room(tmp_path, LogSettings(keep_gb=1), NOW) == []
    assert names(tmp_path) == [".hidden.removed", "01"]


REMOVE = "import sys; from pathlib import Path; from runner.drive.keeping import make_room; " + (
    "from runner.settings import LogSettings; print(flush=True); make_room(Path(sys.argv[1]), LogSettings(False, 1e-9))"
)


@pytest.mark.parametrize("after_s", [0.0, 0.003, 0.01, 0.03])
def test_killed_at_any_time_it_leaves_whole_drives(tmp_path: Path, after_s: float) -> None:
    for hour in range(20):
        path = drive(tmp_path, hour)
        for number in range(50):
            (path / f"{number}.h264").write_text("x")
    with subprocess.Popen([sys.executable, "-c", REMOVE, str(tmp_path)], stdout=subprocess.PIPE) as child:
        assert child.stdout
        child.stdout.readline()
        time.sleep(after_s)
        child.send_signal(signal.SIGKILL)
    for path in tmp_path.glob("2*"):
        assert len(list(path.iterdir())) == 52
    make_room(tmp_path, LogSettings(keep_gb=1e-9))
    assert list(tmp_path.iterdir()) == []


def test_it_is_done_at_once_and_said(tmp_path: Path) -> None:
    drive(tmp_path, 0)
    said: list[str] = []
    with keeping_room(tmp_path, LogSettings(keep_gb=KB / 10), said.append):
        until = time.monotonic() + 10
        while not said and time.monotonic() < until:
            time.sleep(0.01)
    assert names(tmp_path) == []
    assert len(said) == 1
