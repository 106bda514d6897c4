"""Serves one page for several vehicles: the list of them, and each one's page, behind which is a station of its own."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from aiohttp import ClientError, ClientWebSocketResponse, WSMessage, WSMsgType, web

from runner.page.connections import Farewells
from runner.page.documents import Documents, document
from runner.page.front import Front
from runner.page.loop import PageLoop
from runner.page.relay import RETRY_S, STATION, relay, station_session
from runner.page.summaries import CLOSE_S, HEARTBEAT_S, RELEASE
from runner.security.keyring import Keyring
from runner.settings import Endpoint
from runner.system.ports import check_port_free

LIST_S = 0.25  # between two lists to a browser
SILENT_S = 2.0  # a station that sends no summary for this long does not respond; it sends two a second
NOT_RUNNING = "its station is not running"


@dataclass
class Listed:
    """A vehicle of the list.

    socket   of its station; None: it has none
    fault    why its station does not work; None: it does
    summary  what that said last, see `runner.operator.summary`; None: nothing, or not any more
    answer   why control was not released when somebody wanted to; "": it was, or nobody did
    """

    name: str
    socket: Path | None
    fault: str | None = NOT_RUNNING
    summary: Mapping[str, Any] | None = None
    answer: str = ""
    station: ClientWebSocketResponse | None = None
    task: asyncio.Task[None] | None = None

    def row(self) -> dict[str, Any]:
        return {"name": self.name, "fault": self.fault, "summary": self.summary, "answer": self.answer}


class FleetServer:
    """The page of several vehicles.

    endpoint  where browsers reach it
    keyring   of the operator, to serve other machines over HTTPS if they have its token; None: loopback only
    people    file of others who may log in; None: nobody
    note      called with a message for the operator
    raises    RunError if the port is in use or plotly is not installed, UserError if that file cannot be used
    """

    def __init__(
        self, endpoint: Endpoint, keyring: Keyring | None, people: str | None, note: Callable[[str], None]
    ) -> None:
        self._endpoint, self._front = endpoint, Front(endpoint, keyring, people, note)
        check_port_free(endpoint, "page.port")
        self._documents, self._page = Documents(), document("index.html")
        self._vehicles: dict[str, Listed] = {}
        self._farewells, self._relayed = Farewells(), set[asyncio.Transport]()  # that are open
        self._loop = PageLoop()

    @property
    def url(self) -> str:
        return self._front.url

    def start(self) -> None:
        self._loop.start(self._start())

    def stop(self) -> None:
        self._loop.stop(self._stop())

    def add(self, name: str, socket: Path | None, fault: str | None = NOT_RUNNING) -> None:
        """List a vehicle, whose station serves at this socket; None: it has no station, for a reason."""
        self._loop.call_soon(self._add, Listed(name, socket, fault))

    def report(self, name: str, fault: str | None) -> None:
        """State why a vehicle's station is not running; None: it is."""
        self._loop.call_soon(self._report, name, fault)

    def rows(self) -> list[dict[str, Any]]:
        """What the list shows now. From any thread."""
        return [vehicle.row() for vehicle in list(self._vehicles.values())]

    # --- in the page's thread -----------------------------------------------------------------------------------------

    async def _start(self) -> None:
        app = self._front.application()
        app.router.add_get("/", document("fleet.html"))
        app.router.add_get("/list", self._on_list)
        app.router.add_get("/vehicle/{name}/", self._on_page)
        app.router.add_get("/vehicle/{name}/live", self._on_live)
        self._documents.add_to(app, self._front.access)
        await self._front.connections.serve(app, self._endpoint)

    async def _stop(self) -> None:
        for vehicle in self._vehicles.values():
            if vehicle.task:
                vehicle.task.cancel()
        for transport in list(self._relayed):
            transport.abort()
        self._farewells.say()
        await self._front.connections.close()

    def _add(self, vehicle: Listed) -> None:
        self._vehicles[vehicle.name] = vehicle
        if vehicle.socket:
            vehicle.task = asyncio.get_running_loop().create_task(_follow(vehicle, vehicle.socket))

    def _report(self, name: str, fault: str | None) -> None:
        self._vehicles[name].fault = fault

    async def _on_page(self, request: web.Request) -> web.StreamResponse:
        self._vehicle(request)
        response: web.Response = await self._page(request)
        return response

    async def _on_live(self, request: web.Request) -> web.Response:
        vehicle = self._vehicle(request)
        if vehicle.socket is None:
            raise web.HTTPServiceUnavailable(text=f"{vehicle.fault}\n")
        transport, whose = request.transport, self._front.access.visitor(request)
        assert isinstance(transport, asyncio.Transport)
        if whose is None:  # since it was checked
            raise web.HTTPUnauthorized(text="login required: see /login\n")
        self._relayed.add(transport)
        try:
            return await relay(request, vehicle.socket, whose, lambda: self._front.access.visitor(request))
        finally:
            self._relayed.discard(transport)

    def _vehicle(self, request: web.Request) -> Listed:
        name = request.match_info["name"]
        if name not in self._vehicles:
            raise web.HTTPNotFound(text=f"no such vehicle; there are {', '.join(self._vehicles) or 'none'}\n")
        return self._vehicles[name]

    async def _on_list(self, request: web.Request) -> web.WebSocketResponse:
        """Send the list whenever it has changed, until the browser leaves or may no longer see it."""
        ws = web.WebSocketResponse(compress=False, heartbeat=HEARTBEAT_S, timeout=CLOSE_S)
        await ws.prepare(request)
        return await self._farewells.serve(ws, self._list(ws, request))

    async def _list(self, ws: web.WebSocketResponse, request: web.Request) -> None:
        while not ws.closed and (visitor := self._front.access.visitor(request)) is not None:
            await ws.send_json({"vehicles": self.rows(), "may_drive": visitor.may_drive})
            with suppress(TimeoutError):
                message = await ws.receive(LIST_S)
                if visitor.may_drive:
                    await self._on_message(message)
        await ws.close()

    async def _on_message(self, message: WSMessage) -> None:
        """Release control of a vehicle: its name is the browser's only message."""
        vehicle = self._vehicles.get(message.data) if message.type is WSMsgType.TEXT else None
        if vehicle and vehicle.station:
            vehicle.answer = ""
            await vehicle.station.send_str(RELEASE)


async def _follow(vehicle: Listed, socket: Path) -> None:
    """Keep what a station says up to date, as long as it runs."""
    while True:
        with suppress(ClientError, OSError, TimeoutError, ValueError):
            async with station_session(socket) as session, session.ws_connect(f"{STATION}/summary") as station:
                vehicle.station = station
                while (message := await station.receive(SILENT_S)).type is WSMsgType.TEXT:
                    _take(vehicle, json.loads(message.data))
        vehicle.station = vehicle.summary = None
        await asyncio.sleep(RETRY_S)


def _take(vehicle: Listed, said: dict[str, Any]) -> None:
    if "answer" in said:
        vehicle.answer = said["answer"]
    else:
        vehicle.summary = said
