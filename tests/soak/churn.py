"""Thousands of size changes, viewers that come and go, and pipelines that fail and are rebuilt.

Meanwhile memory, descriptors and threads of each process are sampled. The slope of each over the number of operations,
after a warm-up, is printed with its confidence interval and that of each half: it must be flat.

    resizes     new sizes of all cameras while they play
    reconnects  viewers over TCP and UDP, with and without TEARDOWN
    rebuilds    faults at random moments: sources fail, encoders fail, connections of the operator's receivers break
"""

from __future__ import annotations

import random
import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
from system import CAMERAS, System, running

from rig import Operator, free_port, until

RESIZES, RECONNECTS, REBUILDS = 10_000, 1000, 3000
# Warm-up operations: caches, arenas and pools fill up, and viewers that left without TEARDOWN are dropped. The heap of
# the operator's side varies by 10 MB from one rebuild to the next, and its lowest size levels off over some 2000.
WARM = {"resizes": 2000, "reconnects": 150, "rebuilds": 500}
EVERY_S = 0.5
ENDING_S = 10.0  # until a process that is about to end has ended
BLOCKS = 20  # of samples, since successive samples are not independent
CONFIDENT = 2.1  # standard errors: 95 % for a line through this many means
PER = 1000  # operations
WAIT_S = 60.0
FAIL_AFTER = 12  # frames after which a source or a sender of this part fails
RESIZE_S = 0.08  # between two sizes: longer than a frame, so that each is sent
RECONNECT_S = 0.15  # between two viewers: those that leave without TEARDOWN are dropped after some seconds
QUIET_EVERY, QUIET_S = 50, 5.0  # viewers, then a pause: how long those that left linger depends on the load
BREAK_S = 0.4  # mean time between two connections that break
# front's source, and rear's pipeline after its encoder, fail again as soon as they work.
SOURCE = f"""\
frozen_s: 0.5
elements:
  - {{name: source, element: videotestsrc, properties: {{is-live: true, pattern: smpte}}}}
  - {{name: fails, element: identity, properties: {{error-after: {FAIL_AFTER}}}}}
  - {{name: raw, element: capsfilter, properties: {{caps: "{{raw_caps}}"}}}}
"""
GRAPH = f"""\
defaults: [h264_rtsp, _self_]
sender:
  - {{name: sent, element: identity, properties: {{error-after: {FAIL_AFTER}}}}}
  - {{name: pay0, element: rtph264pay, properties: {{pt: 96, mtu: "{{mtu_bytes}}", config-interval: -1}}}}
"""
FAILING = ("+source@cameras.front.source=failing", "+graph@cameras.rear.graph=failing")


class Resource(NamedTuple):
    """A resource of a process, and the growth per thousand operations that still counts as flat."""

    name: str
    flat: float
    read: Callable[[int], float]


class Slope(NamedTuple):
    """Growth per thousand operations, its error, and the growth in each half of the time."""

    value: float
    error: float
    halves: tuple[float, float]

    def __str__(self) -> str:
        return f"{self.value:+.2f} ± {self.error:.2f} ({self.halves[0]:+.2f}, {self.halves[1]:+.2f})"

    def rises(self, flat: float) -> bool:
        """Whether it grows, and has not stopped: a heap or a pool that grew early is not a leak."""
        return self.value - self.error > 0 and min(self.value, self.halves[1]) > flat


def _memory_mb(pid: int) -> float:
    """Resident memory without mapped files."""
    status = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines())
    return float(status["RssAnon"].split()[0]) / 1024


RESOURCES = (
    Resource("MB", 2.0, _memory_mb),
    Resource("descriptors", 1.0, lambda pid: len(list(Path(f"/proc/{pid}/fd").iterdir()))),
    Resource("threads", 1.0, lambda pid: len(list(Path(f"/proc/{pid}/task").iterdir()))),
)


def soak(seed: int, scale: float) -> list[str]:
    rng, problems = random.Random(seed), []
    # It uses only the processor time that others leave: requests may wait.
    with running("mode=single", "page.serve=false", "control.expires_s=10") as (system, operator):
        problems += _measured(system, "resizes", round(RESIZES * scale), _resize(operator, rng))
        problems += system.tracebacks()
    with running("mode=single", "page.serve=false") as (system, _):
        problems += _measured(system, "reconnects", round(RECONNECTS * scale), _reconnect(system, rng, problems))
        problems += system.tracebacks()
    with TemporaryDirectory(prefix="tod-soak-conf-") as conf, Proxy() as proxy:
        for kind, text in (("source", SOURCE), ("graph", GRAPH)):
            (Path(conf) / kind).mkdir()
            (Path(conf) / kind / "failing.yaml").write_text(text)
        words = (f"conf={conf}", *FAILING, "page.serve=false", f"media.port={proxy.inner}")
        with running(*words, own={"operator": [f"media.port={proxy.port}"]}, complete=False) as (system, _):
            problems += _measured(system, "rebuilds", round(REBUILDS * scale), _rebuild(system, proxy, rng))
            problems += system.tracebacks()
    return problems


def _measured(system: System, what: str, most: int, operations: Iterator[int]) -> list[str]:
    """Problems during a number of operations, after the warm-up.

    operations  yields the number done so far
    """
    warm = WARM[what]
    samples_by_kind: dict[tuple[str, Resource], list[tuple[int, float]]] = {}
    began, due = time.monotonic(), 0.0
    for done in operations:
        if time.monotonic() >= due:
            due = time.monotonic() + EVERY_S
            for name, child in system.processes.items():
                system.check_running(name)
                for kind in RESOURCES:
                    try:
                        samples_by_kind.setdefault((name, kind), []).append((done, kind.read(child.pid)))
                    except (OSError, KeyError):  # it is ending
                        child.wait(ENDING_S)
                        system.check_running(name)
        if done >= warm + most:
            break
    print(f"  {warm + most} {what} in {time.monotonic() - began:.0f} s; growth per {PER}:", flush=True)
    problems = []
    for name in system.processes:
        slopes = {kind: slope([s for s in samples_by_kind[name, kind] if s[0] >= warm]) for kind in RESOURCES}
        last = {kind: samples_by_kind[name, kind][-1][1] for kind in RESOURCES}
        words = (f"{last[kind]:8.1f} {kind.name} {found}" for kind, found in slopes.items())
        print(f"    {name:9}{''.join(words)}", flush=True)
        for kind, found in slopes.items():
            if found.rises(kind.flat):
                growth = f"{found} {kind.name} per {PER}"
                problems.append(f"{what}: {name} grows by {growth}, flat is {kind.flat:g}")
    return problems


def slope(samples: Sequence[tuple[int, float]]) -> Slope:
    """The line through the minima of successive blocks of samples (operations, value), with its 95 % interval.

    Temporary growth, such as viewers that left without TEARDOWN, is above it.
    """
    assert len(samples) >= 4, f"{len(samples)} samples are too few: more operations"
    blocks = np.array_split(np.array(samples, float), min(BLOCKS, len(samples)))
    points = np.array([(block[:, 0].mean(), block[:, 1].min()) for block in blocks])
    (rate, _), covariance = np.polyfit(*points.T, 1, cov=True)
    first, second = (PER * float(np.polyfit(*half.T, 1)[0]) for half in np.array_split(points, 2))
    return Slope(PER * float(rate), PER * CONFIDENT * float(np.sqrt(covariance[0, 0])), (first, second))


# --- operations -------------------------------------------------------------------------------------------------------


def _resize(operator: Operator, rng: random.Random) -> Iterator[int]:
    """Resize all cameras together; the next sizes follow once these are read back from the pipelines.

    If the machine stalls for a second, some requests are refused as too old, and not counted.
    """
    began, done = time.monotonic(), 0
    for number in count():
        time.sleep(max(0.0, began + RESIZE_S * number - time.monotonic()))
        identities = [f"size{number}{name}" for name in CAMERAS]
        for identity, name in zip(identities, CAMERAS, strict=True):
            scaling = round(rng.uniform(0.2, 1), 3)
            operator.send(identity, event="camera_configured", camera=name, scaling=scaling)
        until(lambda a=identities: operator.replies.keys() >= set(a), WAIT_S, every_s=0.002)
        replies = [operator.replies.pop(identity) for identity in identities]
        applied = sum(reply["result"] == "applied" for reply in replies)
        assert applied, replies
        done += applied
        yield done


def _reconnect(system: System, rng: random.Random, problems: list[str]) -> Iterator[int]:
    """One viewer after the other, in addition to those of the operator."""
    began = time.monotonic()
    for number in count(1):
        time.sleep(max(0.0, began + RECONNECT_S * number - time.monotonic()))
        camera, udp = rng.choice(CAMERAS), rng.random() < 0.5
        with system.viewer(camera) as viewer:
            if (codes := viewer.open(udp=udp)) != [200, 200, 200]:
                problems.append(f"{camera}: a viewer was answered {codes}")
            else:
                viewer.read()
                until(lambda v=viewer: v.packets, WAIT_S)
            if rng.random() < 0.5:
                viewer.leave()
        if number % QUIET_EVERY == 0:
            time.sleep(QUIET_S)
            began += QUIET_S
        yield number


def _rebuild(system: System, proxy: Proxy, rng: random.Random) -> Iterator[int]:
    """Counts pipelines that the operator's side has rebuilt, and sources that the vehicle has replaced."""
    at = time.monotonic()
    while True:
        if time.monotonic() >= at:
            at = time.monotonic() + rng.expovariate(1 / BREAK_S)
            proxy.break_one(rng)
        received = sum(camera["rebuilt"] for camera in system.samples().values())
        yield received + system.output("vehicle").read_text().count("front: source: ")
        time.sleep(0.1)


class Proxy:
    """A TCP proxy to the RTSP server, which can break its connections.

    port, inner  where the operator's side connects, and where the server listens
    """

    def __init__(self) -> None:
        self.port, self.inner = free_port(), free_port()
        self._listening = socket.create_server(("127.0.0.1", self.port))
        self._open: dict[socket.socket, socket.socket] = {}
        threading.Thread(target=self._accept, daemon=True).start()

    def __enter__(self) -> Proxy:
        return self

    def __exit__(self, *_: object) -> None:
        self._listening.close()

    def break_one(self, rng: random.Random) -> None:
        """Break one of the connections, if there is any."""
        if self._open:
            _break(*rng.choice(list(self._open.items())))

    def _accept(self) -> None:
        with suppress(OSError):  # the socket was closed
            while True:
                client, _ = self._listening.accept()
                try:
                    server = socket.create_connection(("127.0.0.1", self.inner), 1)
                except OSError:  # the server does not listen yet
                    client.close()
                    continue
                server.settimeout(None)
                self._open[client] = server
                threading.Thread(target=self._pass, args=(client, server), daemon=True).start()

    def _pass(self, client: socket.socket, server: socket.socket) -> None:
        with client, server:
            back = threading.Thread(target=_copy, args=(server, client), daemon=True)
            back.start()
            _copy(client, server)
            del self._open[client]
            _break(client, server)
            back.join()


def _copy(one: socket.socket, other: socket.socket) -> None:
    with suppress(OSError):
        while data := one.recv(65_536):
            other.sendall(data)
        other.shutdown(socket.SHUT_WR)


def _break(*ends: socket.socket) -> None:
    for end in ends:
        with suppress(OSError):
            end.shutdown(socket.SHUT_RDWR)
