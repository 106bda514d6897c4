"""Three vehicles, a broker, and the page of a station for all of them, as programs."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from rig import SMALL_ROBOT, free_port, until
from runner.mqtt.broker import private_broker
from runner.settings import Endpoint
from runner.system.children import environment

NAMES = ("courier-1", "courier-2", "courier-3")
SOURCE = (*SMALL_ROBOT, "source=test", "fps_max=10", "modes=open_loop", "pqos=constant", "pqos.kbps=900")


class Programs:
    """A broker and the programs of both sides, each ended with the block.

    words  of all of them
    log    directory of their output
    keys   directory of the keys of the broker, the vehicles and alice, whose page is served by HTTPS; None: none
    """

    def __init__(self, log: Path, words: Sequence[str] = SOURCE, keys: Path | None = None) -> None:
        self.control, self.page = free_port(), free_port()
        self.words = (*words, f"control.port={self.control}")
        self.media = {name: free_port() for name in NAMES}
        self._log, self._stack, self._keys = log, ExitStack(), keys
        self.processes: dict[str, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> Programs:
        own = self._keys and self._keys / "broker"
        self._stack.enter_context(private_broker(Endpoint("127.0.0.1", self.control), own))
        return self

    def __exit__(self, *_: object) -> None:
        self.end(*self.processes)
        self._stack.close()

    def of(self, name: str) -> list[str]:
        """What only this vehicle has."""
        first = 20_000 + 400 * NAMES.index(name)
        return [f"name={name}", f"media.port={self.media[name]}", f"media.rtp_ports=[{first},{first + 199}]"]

    def vehicle(self, name: str, *words: str) -> None:
        keys = (f"keys={self._keys / name}",) if self._keys else ()
        self.start(name, "vehicle", *self.of(name), *keys, *words)

    def station(self, vehicles: str, *words: str) -> None:
        of_vehicle = ("vehicle=", *(() if vehicles.endswith(".yaml") else ("cameras.", "~cameras.")))
        common = [word for word in self.words if not word.startswith(of_vehicle)]
        keys = (f"keys={self._keys / 'alice'}", "page.host=0.0.0.0") if self._keys else ()
        self._run("station", "operator", *common, f"vehicles={vehicles}", f"page.port={self.page}", *keys, *words)

    def end(self, *names: str) -> None:
        """End some of them."""
        ended = [self.processes.pop(name) for name in names]
        for process in ended:
            process.send_signal(signal.SIGTERM)
        for process in ended:
            try:
                process.wait(30)
            finally:
                process.kill()

    def start(self, name: str, verb: str, *words: str) -> None:
        self._run(name, verb, *self.words, *words)

    def _run(self, name: str, verb: str, *words: str) -> None:
        with (self._log / f"{name}.txt").open("ab") as output:
            self.processes[name] = subprocess.Popen(
                [sys.executable, "-m", "runner", verb, *words],
                stdout=output,
                stderr=subprocess.STDOUT,
                env=environment() | {"PYTHONUNBUFFERED": "1", "XDG_STATE_HOME": str(self._log)},
            )

    def output(self, name: str) -> str:
        return (self._log / f"{name}.txt").read_text()

    def file(self, names: Sequence[str] = NAMES) -> str:
        """A file of vehicles."""
        path = self._log / "vehicles.yaml"
        path.write_text(json.dumps({name: self._own(name) for name in names}))
        return str(path)

    def _own(self, name: str) -> dict[str, object]:
        first = 20_000 + 400 * NAMES.index(name)
        media = {"port": self.media[name], "rtp_ports": [first, first + 199]}
        return {"vehicle": "delivery_robot", "media": media}

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.page}/"


@contextmanager
def three(log: Path, *words: str) -> Iterator[Programs]:
    """Three vehicles and their station."""
    with Programs(log) as programs:
        for name in NAMES:
            programs.vehicle(name, *words)
        programs.station(programs.file())
        yield programs


def pids_of(programs: Programs) -> dict[str, int]:
    """The processes of the stations behind the page, by vehicle."""
    parent = programs.processes["station"].pid
    found = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal():
            try:
                line = (entry / "cmdline").read_bytes().decode().split("\0")
                above = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            except (OSError, ValueError):
                continue
            if above == parent and (name := next((w[5:] for w in line if w.startswith("name=")), None)):
                found[name] = int(entry.name)
    return found


def await_page(programs: Programs) -> None:
    """Wait until the list is served."""

    def is_served() -> bool:
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", programs.page)) == 0

    until(is_served, 60, 0.1)


def card(page: Any, name: str) -> Any:
    """A vehicle in the list."""
    return page.locator(f"article[aria-label={name}]")


def live(page: Any, *further: str) -> int:
    """How many pictures of the vehicle that is open are live, or have a further status."""
    statuses = ", ".join(f"[data-status={status}]" for status in ("live", *further))
    return int(page.locator(f".tile:is({statuses})").count())


def moving(page: Any) -> int:
    """Likewise, also those that a busy machine makes late."""
    return live(page, "late", "damaged")


def leave(page: Any, name: str) -> None:
    """Open another vehicle: one whose speed is unknown is left with a second press."""
    card(page, name).locator("a.open").click()
    if "press again" in page.inner_text("#toasts"):
        card(page, name).locator("a.open").click()
    until(lambda: page.url.endswith(f"/vehicle/{name}/"), every_s=0.02)
