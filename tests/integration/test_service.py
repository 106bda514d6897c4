"""Both sides under a service manager: it is notified while they work, and no longer once they hang."""

from __future__ import annotations

import shutil
import signal
import socket
import subprocess
import time

import pytest

from rig import CHECKOUT, ROBOT, free_port, process, until

UNITS = sorted((CHECKOUT / "deploy" / "systemd").glob("*.service"))


@pytest.mark.parametrize("verb", ["vehicle", "operator"])
def test_a_side_reports_to_its_service_manager(verb, tmp_path, broker):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.settimeout(20)
        ports = (f"media.port={free_port()}", f"control.port={broker.port}")
        with process(verb, *ROBOT, *ports, env={"NOTIFY_SOCKET": str(tmp_path / "notify")}) as side:
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


@pytest.mark.skipif(not shutil.which("systemd-analyze"), reason="needs systemd")
@pytest.mark.parametrize("unit", UNITS, ids=lambda path: path.name)
def test_the_units_are_valid_and_grant_little(unit, tmp_path):
    installed = tmp_path / unit.name
    installed.write_text(unit.read_text().replace("/opt/tod-runner/bin/tod-runner", "/bin/true"))
    verified = subprocess.run(["systemd-analyze", "verify", installed], capture_output=True, text=True, check=False)
    assert (verified.returncode, verified.stderr) == (0, "")
    rated = subprocess.run(
        ["systemd-analyze", "security", "--offline=true", "--threshold=30", installed],
        capture_output=True,
        text=True,
        check=False,
    )
    assert rated.returncode == 0, rated.stdout[-300:]
