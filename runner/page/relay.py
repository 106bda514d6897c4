"""Passes a browser's WebSocket on to the station of one vehicle, and back."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path

from aiohttp import ClientError, ClientSession, ClientWebSocketResponse, UnixConnector, WSMsgType, web

RETRY_S = 0.1  # a station may be starting
PATIENCE_S = 3.0  # for its start; the page connects again
ACCESS_S = 1.0  # how soon a relay ends whose browser may no longer see anything
STATION = "http://station"  # any name: the socket decides
MAX_BYTES = 16 * 1_048_576  # of a message: an access unit, or the history of all cameras

Peer = web.WebSocketResponse | ClientWebSocketResponse


def station_session(socket: Path) -> ClientSession:
    """HTTP with the station at a Unix socket."""
    return ClientSession(connector=UnixConnector(str(socket)))


async def relay(request: web.Request, socket: Path, is_granted: Callable[[], bool]) -> web.WebSocketResponse:
    """Relay until either side ends, or access does. Pings pass, too: each side sees whether the other one is alive."""
    browser = web.WebSocketResponse(compress=False, max_msg_size=MAX_BYTES, autoping=False)
    await browser.prepare(request)
    async with station_session(socket) as session:
        tasks = [asyncio.create_task(_watch(is_granted)), asyncio.create_task(_join(browser, session, request))]
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
    await browser.close()
    return browser


async def _watch(is_granted: Callable[[], bool]) -> None:
    while is_granted():
        await asyncio.sleep(ACCESS_S)


async def _join(browser: web.WebSocketResponse, session: ClientSession, request: web.Request) -> None:
    url = f"{STATION}/live?{request.rel_url.raw_query_string}"
    async with await _connected(session, url) as station:
        tasks = [asyncio.create_task(_pass(browser, station)), asyncio.create_task(_pass(station, browser))]
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)


async def _connected(session: ClientSession, url: str) -> ClientWebSocketResponse:
    """Connect, once the station is there: browsers delay the WebSockets of a page that has seen many fail.

    raises  TimeoutError
    """
    async with asyncio.timeout(PATIENCE_S):
        while True:
            try:
                return await session.ws_connect(url, autoping=False, max_msg_size=MAX_BYTES)
            except (ClientError, OSError):
                await asyncio.sleep(RETRY_S)


async def _pass(source: Peer, sink: Peer) -> None:
    """Pass messages on as fast as the sink accepts them."""
    async for message in source:
        match message.type:
            case WSMsgType.TEXT:
                await sink.send_str(message.data)
            case WSMsgType.BINARY:
                await sink.send_bytes(message.data)
            case WSMsgType.PING:
                await sink.ping(message.data)
            case WSMsgType.PONG:
                await sink.pong(message.data)
            case _:
                return
