"""The connections of the page's server, and their limits: strangers must not take all of a process's descriptors."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

from aiohttp import WSCloseCode, web
from aiohttp.http_exceptions import HttpProcessingError
from aiohttp.web_protocol import RequestHandler

from runner.page.tls import PageTls
from runner.settings import Endpoint
from runner.system.reports import LimitedReports

MAX_STRANGERS = 100  # connections without access; a new one replaces the oldest
MAX_BODY = 4096  # bytes of a request
REQUEST_S = 10.0  # a connection without a complete request for this long is closed
FAREWELL_S = 0.4  # how long browsers may take to answer that it ends
ENDED = b"the station has ended"  # reason of closing, to pages: a crash or a cut link states none


class Connections:
    """In the page's thread.

    tls     None: connections are not encrypted
    report  called with the server library's warnings
    """

    def __init__(self, tls: PageTls | None, report: LimitedReports) -> None:
        self._tls, self._report = tls, report
        self._awaiting_request: set[RequestHandler] = set()  # new connections without a complete request
        self._strangers: dict[RequestHandler, float] = {}  # connections that have shown no access, and when they came

    async def serve(self, app: web.Application, at: Endpoint | Path) -> None:
        """at  address, or the name of a Unix socket"""
        logger = logging.Logger("page")
        logger.addHandler(_FaultHandler(lambda text: self._report(text, "")))
        self._runner = web.AppRunner(
            app, access_log=None, logger=logger, shutdown_timeout=FAREWELL_S, keepalive_timeout=REQUEST_S
        )
        await self._runner.setup()
        self._loop = asyncio.get_running_loop()
        if isinstance(at, Path):
            self._server = await self._loop.create_unix_server(self._new, at)
            return
        tls = self._tls.context if self._tls else None
        handshake_s = REQUEST_S if tls else None  # until it has ended, `_expire` has nothing to close
        self._server = await self._loop.create_server(
            self._new, at.host, at.port, ssl=tls, ssl_handshake_timeout=handshake_s
        )

    async def close(self) -> None:
        self._server.close()
        await self._runner.cleanup()

    def grant(self, request: web.Request) -> None:
        """The connection of a request has shown access."""
        self._strangers.pop(request.protocol, None)

    @web.middleware
    async def grant_all(self, request: web.Request, handler: Any) -> web.StreamResponse:
        """Of a Unix socket, which only its owner can open."""
        self.grant(request)
        response: web.StreamResponse = await handler(request)
        return response

    @web.middleware
    async def on_request_complete(self, request: web.Request, handler: Any) -> web.StreamResponse:
        """The first request is complete: cancel the connection's deadline."""
        self._awaiting_request.discard(request.protocol)
        response: web.StreamResponse = await handler(request)
        return response

    async def body(self, request: web.Request) -> bytes:
        """The body of a request."""
        try:
            async with asyncio.timeout(REQUEST_S):
                return await request.read()
        except TimeoutError:
            request.protocol.force_close()
            raise web.HTTPRequestTimeout from None

    def _new(self) -> asyncio.Protocol:
        """A new connection, closed unless its first request completes in time.

        raises  ConnectionRefusedError, for which asyncio closes the socket, if too many handshakes are pending
        """
        assert self._runner.server
        self._limit_strangers()
        if self._tls:
            self._tls.refresh()
        connection = self._runner.server()
        self._awaiting_request.add(connection)
        self._strangers[connection] = self._loop.time()
        self._loop.call_later(REQUEST_S, self._expire, connection)
        return connection

    def _expire(self, connection: RequestHandler) -> None:
        if connection in self._awaiting_request:
            self._awaiting_request.remove(connection)
            abort(connection.transport)

    def _limit_strangers(self) -> None:
        """Make room for a new connection."""
        shaken = self._loop.time() - REQUEST_S  # handshakes that began before have ended
        # `_manager` is private: aiohttp clears it once a connection is closed.
        pending = {it for it, came in self._strangers.items() if came > shaken and it._manager is not None}
        self._strangers = {it: came for it, came in self._strangers.items() if it.transport or it in pending}
        if len(self._strangers) < MAX_STRANGERS:
            return
        oldest = next((it for it in self._strangers if it.transport), None)
        if oldest is None:
            raise ConnectionRefusedError("too many connections")
        del self._strangers[oldest]
        abort(oldest.transport)


class Farewells:
    """WebSockets whose browsers are told if this program ends in order."""

    def __init__(self) -> None:
        self._served = set[asyncio.Task[None]]()

    async def serve(self, ws: web.WebSocketResponse, work: Coroutine[Any, Any, None]) -> web.WebSocketResponse:
        """Serve a browser until the work is done, or until `say`."""
        task = asyncio.create_task(work)
        self._served.add(task)
        try:
            await asyncio.wait([task])
        finally:
            task.cancel()
            self._served.discard(task)
        if task.cancelled():
            # Nothing else reads or writes now: this takes what the browser still sends until it answers. Closing with
            # something unread would reset the connection, and the reason might never be seen.
            await ws.close(code=WSCloseCode.GOING_AWAY, message=ENDED)
        else:
            task.result()
        return ws

    def say(self) -> None:
        """The server then waits for the answers as it closes."""
        for task in self._served:
            task.cancel()


def abort(transport: asyncio.BaseTransport | None) -> None:
    """End a connection whose peer would not answer."""
    if isinstance(transport, asyncio.Transport):
        transport.abort()


class _FaultHandler(logging.Handler):
    """Reports the faults of this server. Invalid HTTP, answered with 400, and leaving early are the client's."""

    def __init__(self, on_report: Callable[[str], None]) -> None:
        super().__init__(logging.WARNING)
        self._on_report = on_report

    def emit(self, record: logging.LogRecord) -> None:
        error = record.exc_info[1] if record.exc_info else None
        text = f"page: {record.getMessage()}" + (f": {type(error).__name__}: {error}" if error else "")
        if not isinstance(error, HttpProcessingError | ConnectionError):
            self._on_report(text)
