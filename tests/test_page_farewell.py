"""Browsers learn that the program that serves them ends in order, whatever they are sending at that moment."""

from __future__ import annotations

import asyncio

import pytest

from rig import free_port
from runner.settings import Endpoint

pytest.importorskip("aiohttp")
import aiohttp
from aiohttp import web

from runner.page.connections import ENDED, FAREWELL_S, Connections, Farewells


async def served(talk, farewells):
    """Close a server while a browser is connected; how its WebSocket was closed.

    talk  what the browser does
    """
    port, connections = free_port(), Connections(None, lambda text, at: None)

    async def listen(ws):
        while True:
            await ws.receive()

    async def live(request):
        ws = web.WebSocketResponse()
        await ws.prepare(request)
        return await farewells.serve(ws, listen(ws))

    app = web.Application()
    app.router.add_get("/", live)
    await connections.serve(app, Endpoint("127.0.0.1", port))
    async with aiohttp.ClientSession() as session, session.ws_connect(f"http://127.0.0.1:{port}") as ws:
        talking = asyncio.create_task(talk(ws))
        await asyncio.sleep(0.05)
        farewells.say()
        began = asyncio.get_running_loop().time()
        await connections.close()
        lasted = asyncio.get_running_loop().time() - began
        return await talking, lasted


async def chatter(ws):
    """Send for a while before anything is read, like a busy page: browsers give up where they can no longer send."""
    for _ in range(100):
        await ws.send_str("x" * 1000)
        await asyncio.sleep(0.001)
    message = await ws.receive(5)
    return message.type, message.extra


async def silent(ws):
    await asyncio.sleep(3 * FAREWELL_S)


def test_a_browser_that_is_sending_reads_why_it_is_closed():
    closed, _ = asyncio.run(served(chatter, Farewells()))
    assert closed == (aiohttp.WSMsgType.CLOSE, ENDED.decode())


def test_a_browser_that_does_not_answer_is_not_waited_for():
    _, lasted = asyncio.run(served(silent, Farewells()))
    assert lasted < 10 * FAREWELL_S
