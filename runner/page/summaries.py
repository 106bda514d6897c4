"""What the list of several vehicles shows of one, for the program that serves the list."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import asdict

from aiohttp import WSMsgType, web

from runner.operator.station import Station
from runner.operator.summary import summary
from runner.records.vehicle import Outcome

EVERY_S = 0.5
RELEASE = "release"  # the other side's only message: release control


def summaries(station: Station) -> Callable[[web.Request], Awaitable[web.WebSocketResponse]]:
    """A handler of WebSockets that sends summaries, and why control was not released, until the other side closes."""

    async def serve(request: web.Request) -> web.WebSocketResponse:
        ws, loop = web.WebSocketResponse(compress=False, heartbeat=1.0), asyncio.get_running_loop()
        answers = asyncio.Queue[Outcome]()

        def on_reply(outcome: Outcome) -> None:
            loop.call_soon_threadsafe(answers.put_nowait, outcome)

        await ws.prepare(request)
        while not ws.closed:
            await ws.send_json(asdict(summary(station)))
            while not answers.empty():
                await ws.send_json({"answer": answers.get_nowait().reason})
            try:
                message = await ws.receive(EVERY_S)
            except TimeoutError:
                continue
            if message.type is WSMsgType.TEXT and message.data == RELEASE:
                station.ask({"event": "control_released"}, on_reply)
        return ws

    return serve
