"""A running broker, vehicle and operator's side, as three processes that a test may stop, kill and restart.

With KEYS=1 RTSP is TLS with passwords, RTP is SRTP, and MQTT is TLS 1.3.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion

import keyed
from rig import CHECKOUT, Operator, free_port, passes, until
from rtsp_client import RtspClient
from runner.link import LimitedLink
from runner.mqtt.broker import find_mosquitto
from runner.mqtt.login import Login
from runner.security.broker_files import broker_settings
from runner.security.keyring import Keyring
from runner.settings import Endpoint

ROBOT = ("vehicle=delivery_robot", "source=test", "fps_max=15")
CONSTANT = ("pqos=constant", "pqos.kbps=3000")
CAMERAS = ("front", "rear", "mast")
ANSWERED_S, ATTEMPTS = 10.0, 6  # for a request
FAULTS = {"PYTHONFAULTHANDLER": "1"}  # a side that crashes prints where
PATIENCE_S = 60.0  # of another player: longer than any source is silent, as ffmpeg waits


class System:
    """Three processes: broker, vehicle, operator.

    words        overrides of both sides
    predictions  overrides that name the source of predictions
    keys         directory with the keys of everybody; None: nothing is encrypted
    link         limited link in front of the vehicle; None: it is on this machine
    environment  of each side, by name, in addition to this process's
    own          overrides of one side, by name
    url          address of a camera: `url("front")`
    page         port of the operator's page
    """

    def __init__(
        self,
        directory: Path,
        words: Sequence[str],
        keys: Path | None = None,
        link: LimitedLink | None = None,
        environment: Mapping[str, Mapping[str, str]] | None = None,
        predictions: Sequence[str] = CONSTANT,
        own: Mapping[str, Sequence[str]] | None = None,
    ) -> None:
        self.directory, self.keys = directory, keys
        self._environment, self._own = environment or {}, own or {}
        self.broker = link.broker if link else Endpoint("127.0.0.1", free_port())
        self.media, self.page = free_port(), free_port()
        ports = (f"control.port={self.broker.port}", f"media.port={self.media}")
        self.words = (*ROBOT, *predictions, *(link.operator_overrides if link else ports), *words)
        self._before = {"vehicle": link.vehicle_command} if link else {}
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        self._started = 0
        host, port = self.broker.host, self.broker.port
        (directory / "mosquitto.conf").write_text(
            f"{broker_settings(str(self.keys / 'broker'), host, port)}user root\n"
            if self.keys
            else f"listener {port} {host}\nallow_anonymous true\nset_tcp_nodelay true\n"
        )

    def url(self, camera: str) -> str:
        return f"rtsp{'s' if self.keys else ''}://127.0.0.1:{self.media}/{camera}"

    def viewer(self, camera: str, *, small: bool = False) -> RtspClient:
        """A client of a camera's stream: with keys, a watcher."""
        keys = self.keys / keyed.WATCHER if self.keys else None
        return RtspClient(self.url(camera), small=small, keys=keys)

    def mqtt_client(self, holder: str) -> Client:
        """A client that is connected to the broker, with the holder's keys if keys are in use."""
        client = Client(CallbackAPIVersion.VERSION2)
        if self.keys:
            login = Login(Keyring(self.keys / holder), print)
            client.tls_set_context(login.context)
            client.username_pw_set(login.user, login.refresh())
        client.connect(self.broker.host, self.broker.port)
        return client

    def start(self, name: str) -> None:
        self._started += 1
        self.log = self.directory / f"{name}{self._started}"
        if name == "broker":
            command = [find_mosquitto(), "-c", str(self.directory / "mosquitto.conf")]
        else:
            page = [f"page.port={self.page}"] if name == "operator" else ["page.serve=false"]
            holder = keyed.VEHICLE if name == "vehicle" else keyed.CONTROLLER
            own = [*([f"keys={self.keys / holder}"] if self.keys else []), *self._own.get(name, ())]
            before = self._before.get(name, ())
            command = [*before, sys.executable, "-m", "runner", name, *self.words, *own, *page, f"log={self.log}"]
        if name == "operator":
            self.operator_log = self.log / "operator.jsonl"
        with self.output(name).open("ab") as output:
            self.processes[name] = subprocess.Popen(
                command,
                stdout=output,
                stderr=output,
                cwd=CHECKOUT,
                env={**os.environ, **FAULTS, "PYTHONPATH": str(CHECKOUT), **self._environment.get(name, {})},
            )

    def output(self, name: str) -> Path:
        return self.directory / f"{name}.txt"

    def check_running(self, name: str) -> None:
        """raises  AssertionError if a process has ended, with its status and the end of its output"""
        if (status := self.processes[name].poll()) is not None:
            raise AssertionError(f"{name} ended with status {status}: {self.output(name).read_text()[-2000:]}")

    def stop(self) -> None:
        for child in self.processes.values():
            child.kill()
            child.wait()

    def samples(self) -> dict[str, Any]:
        """The newest counters of what the operator has received, by camera."""
        with self.operator_log.open("rb") as file:
            file.seek(max(0, self.operator_log.stat().st_size - 200_000))
            lines = file.read().split(b"\n")[1:-1]
        newest = next((line for line in reversed(lines) if b'"log": "sample"' in line), b'{"cameras": {}}')
        cameras: dict[str, Any] = json.loads(newest)["cameras"]
        return cameras

    def received(self) -> bool:
        """Whether pictures have arrived at the operator."""
        return self.operator_log.exists() and any(camera.get("frames") for camera in self.samples().values())

    def tracebacks(self) -> list[str]:
        """The first traceback in the output of each process."""
        found = []
        for name in self.processes:
            text = self.output(name).read_text(errors="replace")
            at = text.find("Traceback")
            if at >= 0:
                found.append(f"{name} printed a traceback:\n{text[max(0, at - 300) : at + 3000]}")
        return found


@contextmanager
def running(
    *words: str,
    keys: Path | None = None,
    link: LimitedLink | None = None,
    environment: Mapping[str, Mapping[str, str]] | None = None,
    predictions: Sequence[str] = CONSTANT,
    own: Mapping[str, Sequence[str]] | None = None,
    complete: bool = True,
) -> Iterator[tuple[System, Operator]]:
    """A streaming system, and a program at the other end of its control link.

    keys      None: those that the environment requests, if any
    complete  wait until all cameras are sent
    For the others see `System`.
    """
    with tempfile.TemporaryDirectory(prefix="tod-soak-") as directory:
        system = System(Path(directory), words, keys or keyed.keys(), link, environment, predictions, own)
        try:
            for name in ("broker", "vehicle", "operator"):
                system.start(name)
            # With the keys of the operator's side, and therefore in control whenever that is.
            operator = Operator(system.broker, keys=system.keys and system.keys / keyed.CONTROLLER)
            until(lambda: (flowing(operator) or not complete) and system.received(), seconds=30, every_s=0.1)
            yield system, operator
        finally:
            system.stop()


def newest(operator: Operator) -> Any:
    """The vehicle's newest state."""
    state = None
    while not operator.states.empty():
        state = operator.states.get()
    operator.newest = state or getattr(operator, "newest", {"online": False})  # type: ignore[attr-defined]
    return operator.newest  # type: ignore[attr-defined]


def flowing(operator: Operator, cameras: Sequence[str] = CAMERAS) -> bool:
    """Whether all cameras are being sent and have viewers."""
    state = newest(operator)
    return state["online"] and all(
        state["cameras"][name]["sending"] and state["cameras"][name]["applied"] for name in cameras
    )


class Watched:
    """A camera that the operator watches: every frame that its encoder outputs must arrive."""

    def __init__(self, system: System, operator: Operator, camera: str = "front") -> None:
        self._system, self._operator, self._camera = system, operator, camera
        self._before = self._settled()

    def problems(self) -> list[str]:
        """Losses since the last call."""
        before, self._before = self._before, self._settled()
        sent, received, lost, rebuilt = (self._before[key] - before[key] for key in before)
        print(f"    watched {self._camera}: {sent} frames sent, {received} received, {lost} packets lost", flush=True)
        found = []
        if sent <= 0 or sent != received:
            found.append(f"{sent} frames sent, {received} received")
        if lost:
            found.append(f"{lost} packets lost")
        if rebuilt:
            found.append(f"its pipeline was rebuilt {rebuilt} times")
        return [f"watched {self._camera}: {problem}" for problem in found]

    def _settled(self) -> Mapping[str, int]:
        """Settled counters: nothing is in flight while the camera is switched off."""
        self._switch(False)
        seen: list[Mapping[str, int]] = []
        while len(seen) < 5 or seen[-1] != seen[-5]:
            time.sleep(0.3)
            sample = self._system.samples()[self._camera]
            sent = self._operator.telemetry[-1]["cameras"][self._camera]["frames"]
            seen.append(
                {"sent": sent, "received": sample["frames"], "lost": sample["lost"], "rebuilt": sample["rebuilt"]}
            )
        self._switch(True)
        return seen[-1]

    def _switch(self, on: bool) -> None:
        """Asks again if there is no answer: the broker drops what finds the vehicle's queue full after a flood."""
        replies, asked = self._operator.replies, []
        while not any(identity in replies for identity in asked):
            assert len(asked) < ATTEMPTS, f"no answer to {len(asked)} requests"
            asked.append(str(time.monotonic()))
            self._operator.send(asked[-1], event="camera_switched", camera=self._camera, on=on)
            passes(lambda: asked[-1] in replies, ANSWERED_S)
        if len(asked) > 1:
            print(f"    {len(asked) - 1} requests were not answered", flush=True)
        reply = next(replies[identity] for identity in asked if identity in replies)
        assert reply["result"] == "applied", reply


@contextmanager
def player(system: System, camera: str, transport: str) -> Iterator[Callable[[], bool]]:
    """Another player of a camera: ffmpeg, or `RtspClient` with keys, which ffmpeg does not support.

    Yields a function that tells whether it still plays.
    """
    if system.keys:
        with system.viewer(camera) as client:
            with suppress(OSError, EOFError):  # refused, or nothing is sent
                client.open(udp=transport == "udp")
            client.tcp.settimeout(PATIENCE_S)
            client.read()
            yield client.is_reading
        return
    command = ["ffmpeg", "-v", "error", "-rtsp_transport", transport, "-i", system.url(camera), "-f", "null", "-"]
    with subprocess.Popen(command, stdin=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as ffmpeg:
        yield lambda: ffmpeg.poll() is None
        ffmpeg.kill()


def ended(child: subprocess.Popen[bytes], seconds: float) -> bool:
    with suppress(subprocess.TimeoutExpired):
        child.wait(seconds)
    return child.poll() is not None
