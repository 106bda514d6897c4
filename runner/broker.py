"""A private MQTT broker as a child process, for the demo and for tests."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from runner.errors import RunError
from runner.model import Endpoint
from runner.ports import check_port_free

START_S = 5.0


@contextmanager
def private_broker(endpoint: Endpoint) -> Iterator[None]:
    """mosquitto, listening on one address for anybody there, remembering nothing; gone at the end.

    raises  RunError where mosquitto is missing or does not come up
    """
    program = find_mosquitto()
    check_port_free(endpoint)
    with tempfile.TemporaryDirectory(prefix="tod-broker-") as directory:
        file = Path(directory) / "mosquitto.conf"
        settings = ("allow_anonymous true", "persistence false", "set_tcp_nodelay true")
        file.write_text("\n".join((f"listener {endpoint.port} {endpoint.host}", *settings, "")))
        command = [program, "-c", str(file)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as child:
            try:
                _wait(child, endpoint)
                yield
            finally:
                child.terminate()


def find_mosquitto() -> str:
    """Path of the broker, which Debian puts where only root looks.

    raises  RunError
    """
    program = shutil.which("mosquitto", path=f"{os.environ.get('PATH', '')}:/usr/local/sbin:/usr/sbin")
    if program is None:
        raise RunError("mosquitto is not installed; on Debian: apt-get install mosquitto")
    return program


def _wait(child: subprocess.Popen[str], endpoint: Endpoint) -> None:
    until = time.monotonic() + START_S
    while time.monotonic() < until and child.poll() is None:
        with socket.socket() as probe:
            if probe.connect_ex((endpoint.host, endpoint.port)) == 0 and child.poll() is None:
                return
        time.sleep(0.02)
    said = child.communicate(timeout=1)[0].strip() if child.poll() is not None else "it does not answer"
    where, why = f"{endpoint.host}:{endpoint.port}", said.splitlines()[-1] if said else ""
    raise RunError(f"mosquitto does not come up on {where}: {why}; choose another control.port")
