"""People who look at a page that is served to other machines: they receive everything and decode nothing.

    python tests/integration/visitors.py URL CA NAME=TOKEN ...

As a program: prints a JSON line a few times a second, until its standard input ends. By name, and by camera index: how
many units have arrived, and the longest time between two of them since the last line, s.
"""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import json
import ssl
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager, contextmanager, suppress
from pathlib import Path
from typing import IO, Any, NamedTuple

import aiohttp

from rig import free_port, process, until
from runner.core.roles import Role
from runner.link import limited_link
from runner.link.limit import Limit
from runner.mqtt.broker import private_broker
from runner.page.viewer import HEADER
from runner.security.authority import Authority
from runner.security.keyring import AUTHORITY, TOKEN
from runner.security.page_people import PagePerson
from runner.settings import Endpoint

LINE_S = 0.25
OPERATOR, VEHICLE = "alice", "delivery_robot"
Take = Callable[[float, float], object]


@asynccontextmanager
async def logged_in(url: str, ca: Path, token: str, viewer: str) -> AsyncIterator[aiohttp.ClientWebSocketResponse]:
    """The connection of a page that has logged in."""
    async with (
        browsing(url, ca, token) as (session, origin),
        session.ws_connect(f"{origin}/live?viewer={viewer}", origin=origin, max_msg_size=0) as page,
    ):
        yield page


@asynccontextmanager
async def browsing(url: str, ca: Path, token: str) -> AsyncIterator[tuple[aiohttp.ClientSession, str]]:
    """A browser that has logged in, and the origin of its WebSockets."""
    tls, own = ssl.create_default_context(cafile=ca), url.rstrip("/")
    jar = aiohttp.CookieJar(unsafe=True)  # of an address, not a name
    async with aiohttp.ClientSession(cookie_jar=jar, connector=aiohttp.TCPConnector(ssl=tls)) as session:
        origin = {"Origin": own}
        async with session.post(f"{own}/login/challenge", headers=origin) as response:
            challenge = (await response.json())["challenge"]
        answer = hmac.new(token.encode(), challenge.encode(), hashlib.sha256).hexdigest()
        told = json.dumps({"challenge": challenge, "answer": answer})
        async with session.post(f"{own}/login", data=told, headers=origin) as response:
            assert response.status == 200, await response.text()
        yield session, own


class Seen(NamedTuple):
    """Of one camera: units that have arrived, and the longest time between two of them since the last line, s."""

    units: int
    gap_s: float


class Page(NamedTuple):
    """A page, and the token of its operator."""

    url: str
    ca: Path
    token: str


class Watcher:
    """One of them.

    take  called with the capture time, NaN if unknown, and the arrival time of each unit, s since 1970
    """

    def __init__(self, take: Take = lambda captured, arrived: None) -> None:
        self._take = take
        self._units: Counter[int] = Counter()
        self._newest: dict[int, float] = {}
        self._gaps: dict[int, float] = {}

    async def receive(self, page: aiohttp.ClientWebSocketResponse) -> None:
        """Until the page closes."""
        async for message in page:
            if message.type is not aiohttp.WSMsgType.BINARY:
                continue
            now = time.time()
            camera, _flags, _, _sequence, captured_ms, _arrived_ms = HEADER.unpack_from(message.data)
            self._gaps[camera] = max(self._gaps.get(camera, 0.0), now - self._newest.get(camera, now))
            self._newest[camera] = now
            self._units[camera] += 1
            self._take(captured_ms / 1000, now)

    def seen(self) -> dict[int, Seen]:
        now, gaps = time.time(), self._gaps
        self._gaps = {}
        waits = {camera: now - newest for camera, newest in self._newest.items()}
        return {camera: Seen(n, max(gaps.get(camera, 0.0), waits[camera])) for camera, n in self._units.items()}


async def _watch(url: str, ca: Path, tokens: Mapping[str, str]) -> None:
    watchers = {name: Watcher() for name in tokens}

    async def one(name: str) -> None:
        async with logged_in(url, ca, tokens[name], f"of-{name}") as page:
            await watchers[name].receive(page)
        raise ConnectionError(f"{name} was disconnected")

    async def tell() -> None:
        while True:
            await asyncio.sleep(LINE_S)
            print(json.dumps({name: watcher.seen() for name, watcher in watchers.items()}), flush=True)

    async def end() -> None:
        await asyncio.to_thread(sys.stdin.read)
        raise SystemExit

    await asyncio.gather(tell(), end(), *map(one, tokens))


class Watching:
    """Watchers in a process of their own.

    lines  what it has told so far, the newest last
    """

    def __init__(self, output: IO[str]) -> None:
        self.lines: list[dict[str, dict[str, Seen]]] = []
        threading.Thread(target=self._read, args=(output,), daemon=True).start()

    def _read(self, output: IO[str]) -> None:
        for line in output:
            told: Mapping[str, Mapping[str, Any]] = json.loads(line)
            self.lines.append({name: {camera: Seen(*each) for camera, each in of.items()} for name, of in told.items()})


@contextmanager
def watching(at: Page, people: Mapping[str, PagePerson]) -> Iterator[Watching]:
    words = [f"{name}={person.token.decode()}" for name, person in people.items()]
    command = [sys.executable, __file__, at.url, str(at.ca), *words]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout
        try:
            yield Watching(child.stdout)
        finally:
            child.kill()


# --- what they look at ------------------------------------------------------------------------------------------------


def issue(directory: Path) -> Path:
    """Keys of a vehicle, its broker, two operators who drive, the page of one of them, and one who watches."""
    authority = Authority(directory)
    with authority.opened():
        for name, role, hosts in (
            ("broker", Role.BROKER, ()),
            (VEHICLE, Role.VEHICLE, ()),
            (OPERATOR, Role.CONTROLLER, ("127.0.0.1",)),
            ("carol", Role.CONTROLLER, ()),
            ("bob", Role.WATCHER, ()),
        ):
            authority.issue(name, role, hosts)
    return directory


@contextmanager
def vehicle(keys: Path, *words: str) -> Iterator[tuple[list[str], subprocess.Popen[str]]]:
    """A vehicle in a network of its own; yields the words that an operator here needs, and its process."""
    media, control = (Endpoint("127.0.0.1", free_port()) for _ in range(2))
    with (
        limited_link("netns", Limit(lambda t: 20_000, 200, 0), media, control, lambda line: None) as link,
        private_broker(link.broker, keys / "broker"),
        process(
            "vehicle", *words, *link.vehicle_overrides, f"keys={keys / VEHICLE}", before=link.vehicle_command
        ) as child,
    ):
        yield [*words, *link.operator_overrides], child
        link.check()


@contextmanager
def page(keys: Path, people: Path, words: Sequence[str]) -> Iterator[Page]:
    """The page of an operator at that vehicle."""
    port, own = free_port(), keys / OPERATOR
    more = (f"keys={own}", "page.host=0.0.0.0", f"page.port={port}", f"page.people={people}")
    with process("operator", *words, *more) as child:
        assert child.stdout
        until(lambda: any("page: https" in line for line in child.stdout or ()), seconds=60)
        threading.Thread(target=child.stdout.read, daemon=True).start()
        yield Page(f"https://127.0.0.1:{port}/", own / AUTHORITY, (own / TOKEN).read_text().strip())


@contextmanager
def driver(at: Page, take: Take = lambda captured, arrived: None) -> Iterator[Watcher]:
    """The page of whoever drives: it has control, and receives every camera. take: as in `Watcher`.

    Like a browser's, it connects again if it was dropped, as on a busy machine.
    """
    watcher, stopped, loop = Watcher(take), asyncio.Event(), asyncio.new_event_loop()

    async def drive() -> None:
        while True:
            async with logged_in(at.url, at.ca, at.token, "driver") as connection:
                await connection.send_json({"take_control": True})
                await watcher.receive(connection)

    async def look() -> None:
        driving = asyncio.create_task(drive())
        await stopped.wait()
        driving.cancel()
        with suppress(asyncio.CancelledError):
            await driving

    thread = threading.Thread(target=lambda: loop.run_until_complete(look()))
    thread.start()
    try:
        yield watcher
    finally:
        loop.call_soon_threadsafe(stopped.set)
        thread.join()
        loop.close()


def uplink_bytes(words: Iterable[str]) -> int:
    """What a vehicle behind `link=netns` has sent, with IP headers: what this machine's device of the link received.

    words  of its operator
    """
    host = next(word.removeprefix("media.host=") for word in words if word.startswith("media.host="))
    (route,) = json.loads(subprocess.check_output(["ip", "-json", "route", "get", host]))
    return int(Path("/sys/class/net", route["dev"], "statistics/rx_bytes").read_text())


if __name__ == "__main__":
    asyncio.run(_watch(sys.argv[1], Path(sys.argv[2]), dict(word.split("=", 1) for word in sys.argv[3:])))
