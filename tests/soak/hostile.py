"""Garbage sent to running sides over RTSP, MQTT in both directions, WebSocket and HTTP.

With KEYS=1 it comes from holders of keys: a watcher, and a vehicle that sends to the operator. In addition, clients
without keys abort a TLS handshake halfway, or stay connected and send nothing.

No process ends, no thread dies, nothing prints a traceback, watched cameras lose no frame; memory, threads and
descriptors return to their initial values.
"""

from __future__ import annotations

import asyncio
import json
import os
import random
import socket
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

import aiohttp
from system import CAMERAS, System, Watched, running

import keyed
from rig import until
from rtsp_client import Digest, client_hello, is_closed, tls

COUNT = 10_000  # of each kind
GROWTH_MB = 60.0
POOL = 4 + min(32, (os.cpu_count() or 1) + 4)  # threads
SETTLE_S = 40.0  # sessions and half-finished requests expire
SILENT, SILENT_S = 100, 15.0  # simultaneous silent connections, and time until the RTSP server closes them
ADMITTED_S = 4.0  # for a viewer that connects meanwhile


class Size(NamedTuple):
    """Resources that a process holds."""

    memory_mb: float
    threads: int
    descriptors: int


def soak(seed: int, scale: float) -> list[str]:
    rng, count = random.Random(seed), max(200, round(COUNT * scale))
    problems: list[str] = []
    kinds: dict[str, Callable[[System, random.Random, int], None]] = {
        "RTSP": rtsp,
        "HTTP": http,
        "WebSocket": websocket,
        "MQTT to the vehicle": to_vehicle,
        "MQTT to the operator": to_operator,
    }
    with running() as (system, operator):
        if system.keys:
            kinds["TLS handshakes"] = handshakes
        # The baseline includes everything loaded and cached on first use, and the arenas of many threads.
        for kind in kinds.values():
            kind(system, rng, max(100, count // 5))
        time.sleep(SETTLE_S / 2)
        before = _sizes(system)
        for name, kind in kinds.items():
            watched = [Watched(system, operator, camera) for camera in CAMERAS]
            began = time.monotonic()
            kind(system, rng, count)
            print(f"  {name}: {count} inputs in {time.monotonic() - began:.0f} s", flush=True)
            problems += [f"{name}: {problem}" for watch in watched for problem in watch.problems()]
            problems += [f"{name}: {n} ended" for n, child in system.processes.items() if child.poll() is not None]
        time.sleep(SETTLE_S)
        for name, now in _sizes(system).items():
            was = before[name]
            print(f"  {name}: before {was}, after {now}", flush=True)
            if now.memory_mb > was.memory_mb + GROWTH_MB:
                problems.append(f"{name}: memory rose from {was.memory_mb:.0f} to {now.memory_mb:.0f} MB")
            # Asyncio's pool, which reads files, may have started its threads; those of clients and cameras have ended.
            if abs(now.threads - was.threads) > POOL:
                problems.append(f"{name}: {was.threads} threads before, {now.threads} after")
            if abs(now.descriptors - was.descriptors) > 8:
                problems.append(f"{name}: {was.descriptors} descriptors before, {now.descriptors} after")
        problems += system.tracebacks()
    return problems


def _sizes(system: System) -> dict[str, Size]:
    return {name: _size(child.pid) for name, child in system.processes.items() if name != "broker"}


def _size(pid: int) -> Size:
    status = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines())
    memory_kb = float(status["VmRSS"].split()[0])
    return Size(round(memory_kb / 1024, 1), int(status["Threads"]), len(list(Path(f"/proc/{pid}/fd").iterdir())))


# --- inputs -----------------------------------------------------------------------------------------------------------

METHODS = (
    "OPTIONS",
    "DESCRIBE",
    "SETUP",
    "PLAY",
    "PAUSE",
    "TEARDOWN",
    "GET_PARAMETER",
    "ANNOUNCE",
    "RECORD",
    "GET",
    "X",
)
TRANSPORTS = (
    "RTP/AVP;unicast;client_port=5000-5001",
    "RTP/AVP/TCP;unicast;interleaved=0-1",
    "RTP/AVP;multicast",
    "RTP/AVP;unicast;client_port=99999-0",
    "",
    "\x00",
)
EVENTS = (
    "mode_selected",
    "total_set",
    "camera_switched",
    "roi_set",
    "camera_configured",
    "weights_set",
    "x",
    "",
    None,
    7,
)


def random_bytes(rng: random.Random, most: int = 200) -> bytes:
    return bytes(rng.randrange(256) for _ in range(rng.randrange(most)))


def corrupted(rng: random.Random, data: bytes) -> bytes:
    """A message that is truncated, inserted into or changed; sometimes unchanged."""
    at, way = rng.randrange(len(data) + 1), rng.randrange(5)
    if way == 0:
        return data[:at]
    if way == 1:
        return data[:at] + random_bytes(rng, 20) + data[at:]
    if way == 2:
        return data[:at] + bytes([rng.randrange(256)]) + data[at + 1 :]
    return data if way == 3 else random_bytes(rng)


@contextmanager
def _connected(system: System) -> Iterator[tuple[socket.socket, Digest | None]]:
    """A connection to the RTSP server, and the password for it."""
    with socket.create_connection(("127.0.0.1", system.media), 1) as sock:
        if system.keys is None:
            yield sock, None
            return
        own = system.keys / keyed.WATCHER
        with tls(own).wrap_socket(sock) as encrypted:
            yield encrypted, Digest(own, keyed.VEHICLE)


def rtsp(system: System, rng: random.Random, count: int) -> None:
    """Valid and corrupted requests, several on a connection; some connections are closed without TEARDOWN."""
    sent = 0
    while sent < count:
        with suppress(OSError), _connected(system) as (sock, login):
            sock.settimeout(0.05)
            for number in range(rng.randrange(1, 8)):
                camera = rng.choice((*CAMERAS, "none", "", "front/../rear", "front?x=1", "front/stream=9", "%00"))
                method, url = rng.choice(METHODS), system.url(camera)
                head = [f"{method} {url} RTSP/1.0", f"CSeq: {number}"]
                head += [f"{name}: {value}" for name, value in (login.header(method, url) if login else {}).items()]
                head += [f"Transport: {rng.choice(TRANSPORTS)}"] * rng.randrange(2)
                head += [f"Session: {rng.randrange(10**8)}"] * rng.randrange(2)
                head += [f"Range: npt={rng.choice(('0.000-', 'now-', '-1-', 'x', '9' * 40))}"] * rng.randrange(2)
                head += [f"Content-Length: {rng.choice((0, 5, -1, 4 * 10**9, 10**12, 'x'))}"] * (rng.random() < 0.1)
                sock.sendall(corrupted(rng, "\r\n".join([*head, "", ""]).encode()))
                sent += 1
                with suppress(OSError):
                    answer = sock.recv(4096)
                    if login and b" 401 " in answer:
                        login.challenge(answer.decode(errors="replace"))


def handshakes(system: System, rng: random.Random, count: int) -> None:
    """Clients of RTSP server and broker that send nothing, garbage, or the start of a handshake, valid or corrupted."""
    assert system.keys
    hello, silent = client_hello(system.keys / keyed.WATCHER), deque[tuple[int, socket.socket]]()
    for _ in range(count):
        with suppress(OSError):
            port = rng.choice((system.media, system.broker.port))
            sock = socket.create_connection(("127.0.0.1", port), 1)
            silent.append((port, sock))
            cut = hello[: rng.randrange(len(hello))]
            sock.sendall(rng.choice((b"", random_bytes(rng), cut, corrupted(rng, hello), hello)))
        while len(silent) > SILENT:
            silent.popleft()[1].close()
    began = time.monotonic()
    until(lambda: _is_admitted(system))
    took_s = time.monotonic() - began
    assert took_s < ADMITTED_S, f"a viewer waited {took_s:.1f} s behind {len(silent)} silent clients"
    for port, sock in silent:
        with closing(sock):
            if port == system.media:
                assert is_closed(sock, began + SILENT_S), (
                    f"a client was silent for {SILENT_S:g} s and is still connected"
                )


def _is_admitted(system: System) -> bool:
    """Whether a viewer is admitted; one that is dropped connects again, as receivers do after 1 s."""
    with suppress(OSError, EOFError), system.viewer(CAMERAS[0]) as viewer:
        return viewer.open() == [200, 200, 200]
    return False


def http(system: System, rng: random.Random, count: int) -> None:
    sent = 0
    while sent < count:
        with suppress(OSError), socket.create_connection(("127.0.0.1", system.page), 1) as sock:
            sock.settimeout(0.05)
            path = rng.choice(("/", "/live", "/live?viewer=a", "/static/../x", "/plotly.js", "/%ff", "x" * 9000, "*"))
            host = rng.choice((f"127.0.0.1:{system.page}", "evil.example", "[::1", "a:b:c", "", "\xff", "x" * 500))
            head = [f"{rng.choice(('GET', 'POST', 'HEAD', 'PUT', 'CONNECT', 'x'))} {path} HTTP/1.1", f"Host: {host}"]
            if rng.random() < 0.3:
                head += [
                    "Connection: Upgrade",
                    "Upgrade: websocket",
                    "Sec-WebSocket-Version: 13",
                    "Sec-WebSocket-Key: x",
                ]
            head += [f"Origin: {rng.choice(('http://evil.example', 'null', 'x'))}"] * rng.randrange(2)
            head += [f"Content-Length: {rng.choice((0, 3, -1, 10**12, 'x'))}"] * (rng.random() < 0.2)
            sock.sendall(corrupted(rng, "\r\n".join([*head, "", ""]).encode("latin-1")))
            sent += 1
            with suppress(OSError):
                sock.recv(4096)


def document(rng: random.Random) -> object:
    """A request, or something like one."""
    values = (0, -1, 1e308, 10**400, "x", None, True, [], {}, [[]], "\ud800", float("nan"), "front", "../", 0.5, 300)
    keys = (
        "kbps",
        "camera",
        "on",
        "mode",
        "x",
        "y",
        "width",
        "height",
        "scaling",
        "weights",
        "t",
        "id",
        "as_of",
        "clock",
    )
    chosen: dict[str, object] = {key: rng.choice(values) for key in rng.sample(keys, rng.randrange(5))}
    return rng.choice(({"id": "h", "event": rng.choice(EVENTS), **chosen}, chosen, list(chosen), rng.choice(values)))


def message(rng: random.Random) -> bytes:
    if rng.random() < 0.01:
        return rng.choice((b"[" * 20_000, b'{"a":' * 5000, b"x" * 200_000, b"1" * 5000, b""))
    return corrupted(rng, json.dumps(document(rng)).encode())


def websocket(system: System, rng: random.Random, count: int) -> None:
    asyncio.run(_websocket(system, rng, count))


async def _websocket(system: System, rng: random.Random, count: int) -> None:
    sent = 0
    live = f"http://127.0.0.1:{system.page}/live?viewer="
    async with aiohttp.ClientSession() as session, session.ws_connect(f"{live}driver", max_msg_size=0) as driver:
        # The driver's page holds control. Requests of others are refused, so that watched cameras stay unchanged.
        reading = asyncio.create_task(_read(driver))
        while sent < count:
            async with session.ws_connect(f"{live}hostile{rng.randrange(5)}", max_msg_size=0) as ws:
                with suppress(ConnectionError):
                    for _ in range(rng.randrange(1, 200)):
                        data = message(rng)
                        if b"take_control" in data:
                            continue
                        await (
                            ws.send_bytes(data) if rng.random() < 0.5 else ws.send_str(data.decode("utf-8", "replace"))
                        )
                        sent += 1
                        while rng.random() < 0.2 and not ws.closed:
                            with suppress(TimeoutError):
                                await ws.receive(0.01)
        assert not driver.closed
        reading.cancel()


async def _read(ws: aiohttp.ClientWebSocketResponse) -> None:
    async for _ in ws:
        pass


def _publish(system: System, holder: str, rng: random.Random, count: int, topics: tuple[str, ...]) -> None:
    client = system.mqtt_client(holder)
    client.loop_start()
    for number in range(count):
        info = client.publish(f"tod/delivery_robot/{rng.choice(topics)}", message(rng), qos=rng.randrange(2))
        if number % 50 == 49:
            info.wait_for_publish(5)
    client.disconnect()
    client.loop_stop()


def to_vehicle(system: System, rng: random.Random, count: int) -> None:
    own = keyed.WATCHER if system.keys else "hostile"
    topics = (f"request/{own}", f"reception/{own}", "request/other", "request/\ud7ff", "configuration")
    _publish(system, keyed.WATCHER, rng, count, topics)


def to_operator(system: System, rng: random.Random, count: int) -> None:
    """Not retained: invalid messages are dropped; a valid state would pass for the vehicle's."""
    own = _operator(system)
    topics = ("state", "telemetry", "configuration", "reply/x", f"reply/{own}", f"clock/{own}")
    _publish(system, keyed.VEHICLE, rng, count, topics)


def _operator(system: System) -> str:
    """The operator's id, as the vehicle has reported it."""
    words = [line.split() for line in system.output("vehicle").read_text().splitlines() if "is present" in line]
    return words[-1][words[-1].index("operator") + 1]
