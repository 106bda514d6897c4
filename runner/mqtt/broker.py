"""A private MQTT broker as a child process, for the demo and for tests."""

from __future__ import annotations

import os
import re
import shutil
import signal
import socket
import subprocess
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from runner.errors import RunError
from runner.security.broker_files import ACCESS, PASSWORDS, broker_settings
from runner.security.keyring import CERTIFICATE, REVOKED, version_of
from runner.settings import Endpoint
from runner.system import children, signals
from runner.system.ports import check_port_free
from runner.system.reports import LimitedReports

START_S = 5.0
END_S = 0.3  # the broker has nothing to write to disk
KEPT_LINES = 20
OPEN = ("allow_anonymous true", "persistence false", "set_tcp_nodelay true")
SETTINGS = (
    "user root",  # if started by root: after a change of user, the kernel would not end it with this process
    "log_type error",
    "log_timestamp false",
)
CONNECTIONS = {
    False: ("connection_messages false",),
    True: ("connection_messages true", "log_type notice"),
}  # with keys?

# What it logs about connections. Only some lines on refused clients name their address.
RELOADED = (PASSWORDS, ACCESS, REVOKED, CERTIFICATE)
CONNECTED = re.compile(r"New connection from (?P<address>\S+):\d+ on port ")
REFUSED = re.compile(
    r"Client connection from (?P<address>\S+) failed: (?:error:\w*:)?(?P<failed>.*)"
    r"|OpenSSL Error[^[]*\[\d+\]: (?:error:\w*:)?(?P<tls>.*)"
    r"|Client (?:\S+ disconnected, |\S+ \[(?P<at>\S+):\d+\] disconnected: )(?P<why>not authorised)\."
)
CONNECTION = re.compile("New c|Client |OpenSSL Error")
LEFT = "unexpected eof"  # a client that ended the connection itself


class Broker:
    """mosquitto as a child process that ends with this one.

    keys       the broker's directory of keys; None: no authentication
    on_report  called, from another thread, with a line about clients that it refuses
    """

    def __init__(
        self, endpoint: Endpoint, keys: Path | None = None, on_report: Callable[[str], None] = lambda line: None
    ) -> None:
        self._endpoint, self._keys = endpoint, keys
        self._listed = keys is not None and (keys / REVOKED).exists()  # another authority may have no revocation list
        self._loaded = self._versions()
        self._stderr_lines: deque[str] = deque(maxlen=KEPT_LINES)
        listener = (
            broker_settings(str(keys.absolute()), endpoint.host, endpoint.port, listed=self._listed).splitlines()
            if keys
            else (f"listener {endpoint.port} {endpoint.host}", *OPEN)
        )
        self._report, self._newest = LimitedReports(on_report), ""  # address of the newest connection
        settings = (*listener, *SETTINGS, *CONNECTIONS[keys is not None], "")
        file = os.memfd_create("mosquitto.conf")
        try:
            os.write(file, "\n".join(settings).encode())
            self._process = subprocess.Popen(
                children.bound([find_mosquitto(), "-c", f"/proc/self/fd/{file}"]),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                errors="replace",
                pass_fds=[file],
                start_new_session=True,  # Ctrl-C must end only this process: both sides sign off at the broker first
            )
        finally:
            os.close(file)
        # A pipe that is not read fills up, and the broker then blocks.
        self._reader = threading.Thread(target=self._read, name="broker", daemon=True)
        self._reader.start()

    def check(self) -> None:
        """Reload new keys. To be called a few times a second; raises RunError if the broker has ended."""
        status = self._process.poll()
        if status is not None:
            message = "; ".join(filter(None, (children.ending(status), self._last_line())))
            raise RunError(f"the MQTT broker on {self._endpoint} ended: {message}")
        if None not in (versions := self._versions()) and versions != self._loaded:
            self._loaded = versions
            self.reload()

    def _versions(self) -> list[tuple[int, int, int] | None]:
        """Of the files that mosquitto reads again; None while one is just being replaced."""
        named = [name for name in RELOADED if name != REVOKED or self._listed]
        return [version_of(self._keys / name) for name in named] if self._keys else []

    def wait_until_it_answers(self) -> None:
        """raises RunError if it does not answer within `START_S`"""
        until = time.monotonic() + START_S
        while time.monotonic() < until and self._process.poll() is None:
            signals.check()
            with suppress(OSError), socket.create_connection((self._endpoint.host, self._endpoint.port), START_S):
                if self._process.poll() is None:
                    return
            time.sleep(0.02)
        message = self._last_line() if self._process.poll() is not None else "it does not answer"
        raise RunError(f"mosquitto does not start on {self._endpoint}: {message}; choose another control.port")

    def reload(self) -> None:
        """Reload passwords and revocation list; clients that are no longer accepted are disconnected."""
        self._process.send_signal(signal.SIGHUP)

    def end(self) -> None:
        self._process.terminate()
        children.end(self._process, END_S)
        self._reader.join(END_S)

    def _last_line(self) -> str:
        self._reader.join(END_S)
        return self._stderr_lines[-1] if self._stderr_lines else ""

    def _read(self) -> None:
        assert self._process.stdout
        with self._process.stdout as lines:
            for line in map(str.strip, lines):
                if CONNECTION.match(line):
                    self._on_connection(line)
                else:
                    self._stderr_lines.append(line)

    def _on_connection(self, line: str) -> None:
        """Report a refused client. Its address is that of the newest connection, unless the line states it."""
        if connected := CONNECTED.match(line):
            self._newest = connected["address"]
        elif refused := refusal(line):
            address = refused[0] or self._newest
            self._report(f"the MQTT broker refused a client at {address}: {refused[1]}", address)


def refusal(line: str) -> tuple[str | None, str] | None:
    """The address, if stated, and the reason of a line about a refused client; None: it is about none.

    mosquitto has two wordings for the same reason: it depends on whether the client's first bytes come at once.
    Later versions name the client (2.0.21) or word it otherwise (2.1), also for one that they no longer accept.
    """
    refused = REFUSED.match(line)
    if refused is None or LEFT in line:
        return None
    return refused["address"] or refused["at"], (refused["failed"] or refused["tls"] or refused["why"]).rstrip(".")


@contextmanager
def private_broker(
    endpoint: Endpoint, keys: Path | None = None, on_report: Callable[[str], None] = lambda line: None
) -> Iterator[Broker]:
    """mosquitto on one address, without persistence, for the duration of the block.

    keys       the broker's directory of keys; None: no authentication
    on_report  called, from another thread, with a line about clients that it refuses
    raises     RunError if mosquitto is missing or does not start
    """
    check_port_free(endpoint)
    broker = Broker(endpoint, keys, on_report)
    try:
        broker.wait_until_it_answers()
        yield broker
    finally:
        broker.end()


def find_mosquitto() -> str:
    """Path of the broker, which Debian installs in a directory that is only in root's PATH.

    raises  RunError
    """
    program = shutil.which("mosquitto", path=f"{os.environ.get('PATH', '')}:/usr/local/sbin:/usr/sbin")
    if program is None:
        raise RunError("mosquitto is not installed; on Debian: apt-get install mosquitto")
    return program
