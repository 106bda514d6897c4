"""What the list of several vehicles shows of one, for the program that serves the list."""

from __future__ import annotations

import asyncio
from dataclasses import asdict

from aiohttp import WSMsgType, web

from runner.operator.station import Station
from runner.operator.summary import summary
from runner.records.vehicle import Outcome

EVERY_S = 0.5
HEARTBEAT_S = 10.0  # between pings; to answer one, a browser on a slow network or a busy machine has half of it
CLOSE_S = 0.1  # how long the other side may take to answer that it is closed
RELEASE = "release"  # the other side's only message: release control


class Summaries:
    """Sends summaries, and why control was not released, to each WebSocket until the other side or the page closes."""

    def __init__(self, station: Station) -> None:
        self._station, self._open = station, set[web.WebSocketResponse]()

    async def serve(self, request: web.Request) -> web.WebSocketResponse:
        ws = web.WebSocketResponse(compress=False, heartbeat=HEARTBEAT_S, timeout=CLOSE_S)
        await ws.prepare(request)
        self._open.add(ws)
        try:
            await self._talk(ws)
        finally:
            self._open.discard(ws)
        return ws

    async def close(self, _app: web.Application) -> None:
        for ws in list(self._open):
            await ws.close()

    async def _talk(self, ws: web.WebSocketResponse) -> None:
        loop, answers = asyncio.get_running_loop(), asyncio.Queue[Outcome]()

        def on_reply(outcome: Outcome) -> None:
            loop.call_soon_threadsafe(answers.put_nowait, outcome)

        while not ws.closed:
            await ws.send_json(asdict(summary(self._station)))
            while not answers.empty():
                await ws.send_json({"answer": answers.get_nowait().reason})
            try:
                message = await ws.receive(EVERY_S)
            except TimeoutError:
                continue
            if message.type is WSMsgType.TEXT and message.data == RELEASE:
                self._station.ask({"event": "control_released"}, on_reply)
