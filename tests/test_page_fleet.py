"""The server of a list of vehicles, before a station that is scripted by the test."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from rig import free_port
from runner.settings import Endpoint

pytest.importorskip("aiohttp")
from aiohttp import ClientSession, WSMsgType, web

from runner.page.access import Access
from runner.page.fleet import FleetServer
from runner.page.login import PageLogin

Use = Callable[[FleetServer, ClientSession, str], Awaitable[None]]
LIMIT_S = 30


class Station:
    """Behind a socket: it answers each message of a page with its query, and notes what the list asks it."""

    def __init__(self, socket: Path) -> None:
        self.socket, self.asked = socket, list[str]()

    async def _live(self, request: web.Request) -> web.WebSocketResponse:
        ws = web.WebSocketResponse(autoping=False)
        await ws.prepare(request)
        await ws.send_str(request.query_string)
        async for message in ws:
            match message.type:
                case WSMsgType.BINARY:
                    await ws.send_bytes(message.data[::-1])
                case WSMsgType.PING:
                    await ws.pong(message.data)
        return ws

    async def _summary(self, request: web.Request) -> web.WebSocketResponse:
        ws = web.WebSocketResponse()
        await ws.prepare(request)
        await ws.send_json({"online": True})
        async for message in ws:
            self.asked.append(message.data)
            await ws.send_json({"answer": "it moves"})
        return ws

    @asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        app = web.Application()
        app.router.add_get("/live", self._live)
        app.router.add_get("/summary", self._summary)
        runner = web.AppRunner(app, shutdown_timeout=0.1)
        await runner.setup()
        await web.UnixSite(runner, str(self.socket)).start()
        try:
            yield
        finally:
            await runner.cleanup()


def served(use: Use) -> None:
    """Run something with the page of a list, at an address."""
    port = free_port()
    server = FleetServer(Endpoint("127.0.0.1", port), None, None, print)
    server.start()

    async def run() -> None:
        async with asyncio.timeout(LIMIT_S), ClientSession() as session:
            await use(server, session, f"http://127.0.0.1:{port}")

    try:
        server.add("absent", None, "no station: no such file")
        asyncio.run(run())
    finally:
        server.stop()


async def listed(session: ClientSession, url: str, is_right: Callable[[list[Any]], object]) -> Any:
    """The first list that is right, and its connection, still open."""
    ws = await session.ws_connect(f"{url}/list")
    while True:
        vehicles = json.loads(await ws.receive_str())["vehicles"]
        if is_right(vehicles):
            return vehicles, ws


def test_windows_reach_the_station_of_their_vehicle(tmp_path: Path) -> None:
    station = Station(tmp_path / "a")

    async def use(server: FleetServer, session: ClientSession, url: str) -> None:
        server.add("courier", station.socket)
        async with station.running():
            ws = await session.ws_connect(f"{url}/vehicle/courier/live?viewer=me&show=front", autoping=False)
            assert await ws.receive_str() == "viewer=me&show=front"
            await ws.send_bytes(b"abc")
            assert await ws.receive_bytes() == b"cba"
            await ws.ping(b"alive?")
            answer = await ws.receive()
            assert (answer.type, answer.data) == (WSMsgType.PONG, b"alive?")
        assert (await ws.receive()).type in (WSMsgType.CLOSE, WSMsgType.CLOSED)

    served(use)


def test_a_window_waits_for_a_station_that_is_starting(tmp_path: Path) -> None:
    station = Station(tmp_path / "a")

    async def use(server: FleetServer, session: ClientSession, url: str) -> None:
        server.add("courier", station.socket)
        connecting = asyncio.create_task(session.ws_connect(f"{url}/vehicle/courier/live?viewer=me"))
        await asyncio.sleep(0.3)
        assert not connecting.done()
        async with station.running():
            assert await (await connecting).receive_str() == "viewer=me"

    served(use)


def test_the_list_says_what_stations_say_and_why_one_does_not_run(tmp_path: Path) -> None:
    station = Station(tmp_path / "a")

    async def use(server: FleetServer, session: ClientSession, url: str) -> None:
        server.add("courier", station.socket)
        none = {"name": "absent", "fault": "no station: no such file", "summary": None, "answer": ""}
        rows, _ = await listed(session, url, lambda rows: len(rows) == 2)
        assert rows == [none, {**none, "name": "courier", "fault": "its station is not running"}]
        server.report("courier", None)
        async with station.running():
            rows, ws = await listed(session, url, lambda rows: rows[1]["summary"])
            assert rows == [none, {"name": "courier", "fault": None, "summary": {"online": True}, "answer": ""}]
            await ws.send_str("courier")
            await listed(session, url, lambda rows: rows[1]["answer"] == "it moves")
            assert station.asked == ["release"]
        server.report("courier", "its station ended (status 1)")
        rows, _ = await listed(session, url, lambda rows: not rows[1]["summary"] and rows[1]["fault"])
        assert rows[1]["fault"] == "its station ended (status 1)"

    served(use)


@pytest.mark.parametrize(
    "path, status",
    [("/", 200), ("/vehicle/absent/", 200), ("/vehicle/absent/live", 503), ("/vehicle/other/", 404)],
)
def test_pages_of_vehicles_that_are_listed(path: str, status: int) -> None:
    async def use(server: FleetServer, session: ClientSession, url: str) -> None:
        async with session.get(url + path) as answer:
            assert answer.status == status
        async with session.get(url + path, headers={"Host": "elsewhere"}) as answer:
            assert answer.status == 403

    served(use)


@pytest.mark.parametrize(
    "path, status", [("/", 303), ("/vehicle/absent/", 303), ("/list", 401), ("/vehicle/absent/live", 401)]
)
def test_nothing_is_shown_before_login(monkeypatch: pytest.MonkeyPatch, path: str, status: int) -> None:
    login = PageLogin(lambda: b"token")
    monkeypatch.setattr("runner.page.front.Access", lambda _none, *rest: Access(login, *rest))

    async def use(server: FleetServer, session: ClientSession, url: str) -> None:
        async with session.get(url + path, allow_redirects=False) as answer:
            assert answer.status == status

    served(use)
