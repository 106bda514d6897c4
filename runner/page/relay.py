"""Passes a browser's WebSocket on to the station of one vehicle, and back, unread: pings and pictures alike."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from socket import SO_SNDBUF, SOL_SOCKET

from aiohttp import ClientSession, UnixConnector, web

from runner.page.connections import abort
from runner.page.login import RELAYED, Visitor

RETRY_S = 0.1  # a station may be starting
PATIENCE_S = 3.0  # for its start; the page connects again
ACCESS_S = 1.0  # how soon a relay ends whose browser may no longer see anything
STATION = "http://station"  # any name: the socket decides
HANDSHAKE = ("Upgrade", "Connection", "Sec-WebSocket-Key", "Sec-WebSocket-Version")
SEND_BUFFER_BYTES = 131_072  # small: the station notices a browser that does not read


def station_session(socket: Path) -> ClientSession:
    """HTTP with the station at a Unix socket."""
    return ClientSession(connector=UnixConnector(str(socket)))


async def relay(
    request: web.Request, socket: Path, whose: Visitor, visitor: Callable[[], Visitor | None]
) -> web.Response:
    """Relay until either side ends, or access does.

    whose    who asks
    visitor  returns who has access by this request now; None: nobody
    raises  HTTPServiceUnavailable if the station does not run
    """
    browser = request.transport
    assert isinstance(browser, asyncio.Transport)
    to_browser, to_station = _End(), _End(browser.get_protocol())
    station = await _connected(socket, to_browser, browser)
    if (connection := browser.get_extra_info("socket")) is not None:
        connection.setsockopt(SOL_SOCKET, SO_SNDBUF, SEND_BUFFER_BYTES)
    to_browser.other, to_station.other = browser, station
    browser.set_protocol(to_station)  # the station answers the handshake
    station.write(_handshake(request, whose))
    try:
        ended = {asyncio.create_task(end.ended.wait()) for end in (to_browser, to_station)}
        while (
            visitor() == whose and not (await asyncio.wait(ended, timeout=ACCESS_S, return_when="FIRST_COMPLETED"))[0]
        ):
            pass
    finally:
        for task in ended:
            task.cancel()
        station.close()
        if to_station.ended.is_set() or to_browser.ended.is_set():
            browser.close()  # with what has been written
        else:
            abort(browser)
    return web.Response()  # which nobody gets


class _End(asyncio.Protocol):
    """Receives from one side, and passes on to the other one as fast as that accepts.

    before  protocol of the connection until now, which has to learn of its end; None: it is a new one
    """

    def __init__(self, before: asyncio.BaseProtocol | None = None) -> None:
        self.other: asyncio.Transport | None = None
        self.ended = asyncio.Event()
        self._before = before

    def data_received(self, data: bytes) -> None:
        assert self.other
        self.other.write(data)

    def pause_writing(self) -> None:
        """This side does not accept what the other one sends."""
        if self.other and not self.other.is_closing():
            self.other.pause_reading()

    def resume_writing(self) -> None:
        if self.other and not self.other.is_closing():
            self.other.resume_reading()

    def connection_lost(self, error: Exception | None) -> None:
        self.ended.set()
        if self._before:
            self._before.connection_lost(error)


async def _connected(socket: Path, protocol: _End, browser: asyncio.Transport) -> asyncio.Transport:
    """Connect to a station, once it is there: browsers delay the WebSockets of a page that has seen many fail."""
    loop = asyncio.get_running_loop()
    until = loop.time() + PATIENCE_S
    while loop.time() < until and not browser.is_closing():
        try:
            return (await loop.create_unix_connection(lambda: protocol, str(socket)))[0]
        except OSError:
            await asyncio.sleep(RETRY_S)
    raise web.HTTPServiceUnavailable(text="the station of this vehicle is not running\n")


def _handshake(request: web.Request, visitor: Visitor) -> bytes:
    """The browser's request, as the station gets it."""
    given = [(name, request.headers[name]) for name in HANDSHAKE if name in request.headers]
    headers = [("Host", "station"), (RELAYED, visitor.words()), *given]
    lines = [f"GET /live?{request.rel_url.raw_query_string} HTTP/1.1", *(f"{name}: {value}" for name, value in headers)]
    return "\r\n".join([*lines, "", ""]).encode("utf-8", "surrogateescape")
