"""How the verbs end: when a part of a demo dies, and when the demo itself is killed; `make soak` sends them signals."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import time
import uuid
from contextlib import contextmanager, suppress

import pytest
from soak.signals import LIMIT_S, MARK, ROBOT, marked_processes

from rig import CHECKOUT, free_port, until
from runner.mqtt.broker import private_broker
from runner.settings import Endpoint

pytestmark = pytest.mark.gst

PARTS = {  # by name in messages: a pattern for the command line
    "the vehicle's side": r"-m runner vehicle ",
    "the operator's side": r"-m runner operator ",
    "the MQTT broker": r"/mosquitto -c ",
    "relay": r"-m runner\.link\.relay ",
}


@contextmanager
def demo(tmp_path, *words):
    """A running demo over a relay. Yields its process and the process ids of all that it started, by part."""
    mark = uuid.uuid4().hex
    ports = (f"media.port={free_port()}", f"control.port={free_port()}")
    command = (sys.executable, "-m", "runner", "demo", *ROBOT, *ports, "link=relay", f"log={tmp_path / 'drive'}")
    environment = {**os.environ, "PYTHONPATH": str(CHECKOUT), MARK: mark}
    with (
        (tmp_path / "output").open("w+") as output,
        subprocess.Popen(
            [*command, "duration_s=60", *words], stdout=output, stderr=output, env=environment, cwd=CHECKOUT
        ) as child,
    ):
        try:
            until(lambda: (tmp_path / "drive" / "link.jsonl").exists() and "front" in (tmp_path / "output").read_text())
            yield child, until(lambda: _parts(mark)), (tmp_path / "output").read_text
        finally:
            for pid in marked_processes(mark):
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)


def _parts(mark):
    """The process id of each part; None before all of them run."""
    started = marked_processes(mark)
    found = {name: [p for p, words in started.items() if re.search(part, words + " ")] for name, part in PARTS.items()}
    return {name: pid for name, (pid,) in found.items()} if all(found.values()) else None


def _alive(pids):
    """The processes that still run; zombies do not count."""
    alive = []
    for pid in pids:
        with suppress(OSError), open(f"/proc/{pid}/stat") as stat:
            alive += [] if stat.read().rpartition(")")[2].split()[0] == "Z" else [pid]
    return alive


def test_a_demo_that_is_killed_leaves_no_process_behind(tmp_path):
    with demo(tmp_path) as (child, parts, _):
        child.kill()
        until(lambda: not _alive(parts.values()))
    lines = (tmp_path / "drive" / "drive.jsonl").read_text().splitlines()
    assert '"ended"' in lines[-1]  # the vehicle's side shut down properly


def some_of(*now):
    """All parts, the others by `make soak`: each takes a drive."""
    return [part if part in now else pytest.param(part, marks=pytest.mark.soak) for part in PARTS]


@pytest.mark.parametrize("part", some_of("the operator's side"))
def test_a_dead_part_of_a_demo_is_reported_and_ends_it(tmp_path, part):
    with demo(tmp_path) as (child, parts, output):
        os.kill(parts[part], signal.SIGKILL)
        assert child.wait(20) == 1
        assert re.search(f"^{part}.* ended.*killed by SIGKILL", output(), re.MULTILINE), output()
        assert "Traceback" not in output()
        assert not _alive(parts.values())


@pytest.mark.parametrize("part", some_of("the MQTT broker"))
def test_a_part_of_a_demo_that_hangs_does_not_delay_its_end(tmp_path, part):
    end_of_a_demo_with_a_hanging_part(tmp_path, part)


@pytest.mark.soak  # 2.3 s of these 3 are normal
@pytest.mark.parametrize("part", PARTS)
def test_a_demo_with_a_part_that_hangs_ends_within_its_limit(tmp_path, part):
    assert end_of_a_demo_with_a_hanging_part(tmp_path, part) < LIMIT_S


def end_of_a_demo_with_a_hanging_part(tmp_path, part):
    """s from the signal to the end of the last process."""
    with demo(tmp_path) as (child, parts, output):
        os.kill(parts[part], signal.SIGSTOP)
        child.send_signal(signal.SIGINT)
        began = time.monotonic()
        until(lambda: child.poll() is not None and not _alive(parts.values()), seconds=20)
        ended = time.monotonic()
        assert child.returncode == 130
        assert "Traceback" not in output()
    return ended - began


def test_the_broker_serves_any_number_of_connections():
    """Each would write a line to a pipe that holds 64 KB."""
    endpoint = Endpoint("127.0.0.1", free_port())
    with private_broker(endpoint) as broker:
        for number in range(1200):
            with socket.create_connection((endpoint.host, endpoint.port), timeout=5) as client:
                client.settimeout(5)
                name = f"client-{number:04}".encode()
                client.sendall(b"\x10" + bytes([12 + len(name)]) + b"\0\4MQTT\4\2\0\x3c\0" + bytes([len(name)]) + name)
                assert client.recv(4) == b"\x20\2\0\0", f"no answer to connection {number}"
                client.sendall(b"not MQTT")
        broker.check()
