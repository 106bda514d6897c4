"""What the list of several vehicles shows of one, for the program that serves the list."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import asdict

from aiohttp import web

from runner.operator.station import Station
from runner.operator.summary import summary

EVERY_S = 0.25


def summaries(station: Station) -> Callable[[web.Request], Awaitable[web.WebSocketResponse]]:
    """A handler of WebSockets that sends summaries until the other side closes."""

    async def send(request: web.Request) -> web.WebSocketResponse:
        ws = web.WebSocketResponse(compress=False, heartbeat=1.0)
        await ws.prepare(request)
        while not ws.closed:
            await ws.send_json(asdict(summary(station)))
            try:
                await ws.receive(EVERY_S)
            except TimeoutError:
                continue
        return ws

    return send
