"""Both sides under a service manager: it is notified while they work, and no longer once they hang."""

from __future__ import annotations

import json
import re
import shutil
import signal
import socket
import subprocess
import time
from pathlib import Path

import pytest
from recipes import SERVICE, lines

from rig import CHECKOUT, ROBOT, free_port, needs_root, process, until
from runner.drive.read import read_drive

SYSTEMD = CHECKOUT / "deploy" / "systemd"
UNITS = sorted(SYSTEMD.glob("*.service"))


@pytest.mark.parametrize("verb", ["vehicle", "operator"])
def test_a_side_reports_to_its_service_manager(verb, tmp_path, broker):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.settimeout(20)
        ports = (f"media.port={free_port()}", f"control.port={broker.port}")
        drives = f"drives={tmp_path / 'drives'}"
        with process(verb, *ROBOT, *ports, drives, env={"NOTIFY_SOCKET": str(tmp_path / "notify")}) as side:
            assert manager.recv(100) == b"READY=1"
            for _ in range(3):
                assert manager.recv(100) == b"WATCHDOG=1"
            side.send_signal(signal.SIGSTOP)
            time.sleep(0.5)
            _drain(manager)
            time.sleep(1)
            assert _drain(manager) == []
            side.send_signal(signal.SIGCONT)
            assert manager.recv(100) == b"WATCHDOG=1"
            side.send_signal(signal.SIGTERM)
            until(lambda: side.poll() is not None)
            assert b"STOPPING=1" in _drain(manager)
    (drive,) = (tmp_path / "drives").iterdir()
    assert list(read_drive(drive).sides) == [verb]


@needs_root
@pytest.mark.soak
@pytest.mark.sources
@pytest.mark.parametrize("disk", ["ro", "nr_inodes=1"])
@pytest.mark.parametrize("verb", ["vehicle", "operator"])
def test_a_side_drives_while_its_disk_cannot_be_written(verb, disk, tmp_path, broker):
    """The disk is mounted for this side only, and can be written once it is mounted again."""
    (tmp_path / "disk").mkdir()
    mounted = f'mount -t tmpfs -o {disk} tmpfs {tmp_path}/disk && exec "$@"'
    before = ("unshare", "--mount", "sh", "-c", mounted, "sh")
    words = (*ROBOT, f"media.port={free_port()}", f"control.port={broker.port}", f"drives={tmp_path}/disk")
    with process(verb, *words, before=before) as side:
        until(lambda: "continues without its log" in side.stdout.readline())
        again = ("mount", "-o", "remount,rw,nr_inodes=100", f"{tmp_path}/disk")
        subprocess.run(["nsenter", f"--mount=/proc/{side.pid}/ns/mnt", *again], check=True)
        until(lambda: "the log continues" in side.stdout.readline())
        (file,) = Path(f"/proc/{side.pid}/root{tmp_path}/disk").glob("*/*.jsonl")
        assert json.loads(file.open().readline())["log"] == "began"
        side.send_signal(signal.SIGTERM)
        side.wait(20)


def _drain(manager):
    found = []
    manager.setblocking(False)
    try:
        while True:
            found.append(manager.recv(100))
    except BlockingIOError:
        return found
    finally:
        manager.settimeout(20)


@pytest.mark.parametrize("unit", UNITS, ids=lambda path: path.name)
def test_the_example_of_a_unit_is_the_command_of_the_document(unit):
    """Apart from the paths of keys, and the vehicle, which is the default one."""
    (example,) = re.findall(r"^#   TOD_OVERRIDES=(.*)$", unit.read_text(), flags=re.MULTILINE)
    verb = unit.stem.removeprefix("tod-")
    (command,) = (line.text for line in lines(SERVICE) if line.text.startswith(f"tod-runner {verb} "))
    given, documented = ({word for word in text.split() if "keys=" not in word} for text in (example, command))
    assert given - {"vehicle=tum_q7"} == documented - {"tod-runner", verb}
    assert "keys=/etc/tod-runner/keys" in example.split()


@pytest.mark.skipif(not shutil.which("rsync"), reason="needs rsync")
def test_the_documented_command_installs_keys_and_new_ones_over_them(tmp_path):
    commands = [text for _, text in lines("Services") if "rsync" in text]
    assert [text.split()[-2:] for text in commands] == [
        ["tod-keys/", "/etc/tod-runner/keys/"],
        ["keys/alice/", "/etc/tod-runner/keys/"],
    ]
    for text in commands:
        assert text.startswith("sudo rsync -a --delete --chown=tod-runner:tod-runner ")
        given, installed = tmp_path / text.split()[-2], tmp_path / "installed"
        words = [word for word in text.split()[1:-2] if not word.startswith("--chown")]  # which needs root
        given.mkdir(mode=0o700, parents=True)
        (given / "own.key").write_text("old")
        (given / "own.key").chmod(0o600)
        subprocess.run([*words, f"{given}/", f"{installed}/"], check=True)
        (given / "own.key").write_text(f"new, of {given}")
        subprocess.run([*words, f"{given}/", f"{installed}/"], check=True)
        assert [(path.name, path.read_text()) for path in installed.iterdir()] == [("own.key", f"new, of {given}")]
        assert [path.stat().st_mode & 0o777 for path in (installed, installed / "own.key")] == [0o700, 0o600]


@pytest.mark.skipif(not shutil.which("systemd-analyze"), reason="needs systemd")
@pytest.mark.parametrize(
    ("unit", "drop_in"),
    [*((unit, None) for unit in UNITS), (SYSTEMD / "tod-vehicle.service", SYSTEMD / "nvidia.conf")],
    ids=lambda path: path and path.name,
)
def test_the_units_are_valid_and_grant_little(unit, drop_in, tmp_path):
    installed = tmp_path / unit.name
    if drop_in:
        (tmp_path / f"{unit.name}.d").mkdir()
        shutil.copy(drop_in, tmp_path / f"{unit.name}.d")
    command = f"/usr/lib/tod-runner/{unit.stem.removeprefix('tod-')}/bin/tod-runner"  # where its package has it
    installed.write_text(unit.read_text().replace(command, "/bin/true"))
    verified = subprocess.run(["systemd-analyze", "verify", installed], capture_output=True, text=True, check=False)
    assert (verified.returncode, verified.stderr) == (0, "")
    rated = subprocess.run(
        ["systemd-analyze", "security", "--offline=true", "--threshold=30", installed],
        capture_output=True,
        text=True,
        check=False,
    )
    assert rated.returncode == 0, rated.stdout[-300:]
