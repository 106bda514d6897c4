"""Serves the operator's page, its video and its requests, in an asyncio loop in its own thread."""

from __future__ import annotations

import asyncio
import logging
import mimetypes
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from functools import partial
from ipaddress import ip_address
from pathlib import Path
from typing import Any

from aiohttp import WSMsgType, web
from aiohttp.http_exceptions import HttpProcessingError
from aiohttp.web_protocol import RequestHandler

from runner.configuration.layout import NOWHERE, Layouts, Places, own_places
from runner.core.events import Attention
from runner.core.model import Camera, plain
from runner.core.roles import DRIVER_EVENTS
from runner.errors import ConfigError, RunError, UserError
from runner.graph import video_codec
from runner.h264.access_unit import AccessUnit, RecentUnits
from runner.mqtt.messages import read_message
from runner.operator.station import LinkState, Listener, Station
from runner.page.control import Control, combined_attention, page_of
from runner.page.counter import CounterReading, counter_reading
from runner.page.history import History
from runner.page.login import COOKIE, PageLogin
from runner.page.tls import PageTls
from runner.page.viewer import PageViewer
from runner.records import Note, Outcome, Sample, VehicleState, state_to_json, to_json
from runner.schema import shortened
from runner.security.keyring import Keyring
from runner.settings import Setup
from runner.system.files import plotly_script
from runner.system.ports import check_port_free
from runner.system.reports import LimitedReports

STATIC = Path(__file__).with_name("static")
FROZEN_MS = 120  # a picture that is frozen for this long is marked within 150 ms
NOTES = 50  # kept for pages that open later
REPORTED = tuple(attention.value for attention in Attention if attention is not Attention.ABSENT)  # by pages
SEND_BUFFER_BYTES = 131_072  # small: a viewer that does not read is noticed here, not megabytes later
START_S = 10.0  # the port is known to be free: only a stalled machine takes longer
STOP_S = 0.5  # how long open connections may take to close
LOOPBACK = ("127.0.0.1", "localhost")  # names of the page without keys
DEFAULT_PORTS = {"http": 80, "https": 443}
MAX_STRANGERS = 100  # connections without access; a new one replaces the oldest
MAX_BODY = 4096  # bytes of a request
REQUEST_S = 10.0  # a connection without a complete request for this long is closed
PING_S = 0.5
UNRESPONSIVE_S = 2.0  # a viewer that has not answered a ping for this long is dropped, and reconnects if it is alive
CLOSE_TYPES = (WSMsgType.CLOSE, WSMsgType.CLOSING, WSMsgType.CLOSED, WSMsgType.ERROR)
MAX_MESSAGE_BYTES = 1_048_576  # a longer message closes the connection
# Inline styles: Plotly adds style elements and attributes of its own. Inline scripts stay forbidden.
POLICY = (
    "default-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; worker-src 'self'; "
    "frame-ancestors 'none'; base-uri 'none'; form-action 'self'; object-src 'none'"
)
LOGIN_POLICY = POLICY.replace(" 'unsafe-inline'", "")
HEADERS = {
    "Content-Security-Policy": POLICY,
    "Cache-Control": "no-cache",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
LOGIN_HEADERS = HEADERS | {"Content-Security-Policy": LOGIN_POLICY}
# What a browser needs before login.
UNPROTECTED = (
    "/login",
    "/login/challenge",
    *(f"/static/{name}" for name in ("login.js", "login.css", "style.css")),
)


class PageServer(Listener):
    """The page and its viewers.

    The listener's callbacks and `show` may be called from any thread; everything else runs in the page's own.

    on_counter  called in the page's thread with each reading of the counter that a camera films; None: such messages
                are refused
    keyring     of the operator, to serve other machines over HTTPS if they have its token; None: loopback only
    layouts     of the operator; None: layouts cannot be saved
    raises      RunError if the port is in use or plotly is not installed
    """

    def __init__(
        self,
        setup: Setup,
        station: Station,
        on_counter: Callable[[CounterReading], None] | None = None,
        keyring: Keyring | None = None,
        layouts: Layouts | None = None,
    ) -> None:
        self._setup, self._station, self._on_counter = setup, station, on_counter
        self._vehicle = vehicle = setup.vehicle
        self._layouts, self._is_saving = layouts or Layouts(), False
        self._report = LimitedReports(station.note)  # of what browsers and others on the network can cause
        self._tls = PageTls(keyring, station.note) if keyring else None
        self._holder = keyring.watched_holder(station.note) if keyring else None
        self._login = PageLogin(keyring.watched_token(station.note).get) if keyring else None
        check_port_free(setup.page.endpoint)
        self._plotly = plotly_script("page")
        self._index = {name: number for number, name in enumerate(vehicle.cameras)}
        self._recent = [_recent(camera) for camera in vehicle.cameras.values()]
        self._history = History()
        self._notes: deque[Mapping[str, Any]] = deque(maxlen=NOTES)
        self._viewers: list[PageViewer] = []  # the newest last
        self._control = Control()
        self._awaiting_request: set[RequestHandler] = set()  # new connections without a complete request
        self._strangers: dict[RequestHandler, float] = {}  # connections that have shown no access, and when they came
        self._loop = asyncio.new_event_loop()
        self._stopped = asyncio.Event()
        self._thread = threading.Thread(target=self._run, name="page", daemon=True)

    @property
    def url(self) -> str:
        endpoint = self._setup.page.endpoint
        if self._holder is None:
            return f"http://{endpoint}/"
        return f"https://{replace(endpoint, host=next(iter(self._names), endpoint.host))}/"

    @property
    def _names(self) -> tuple[str, ...]:
        """Addresses and names at which browsers reach the page."""
        return self._holder.get().hosts if self._holder else (*LOOPBACK, self._setup.page.host)

    def start(self) -> None:
        self._thread.start()
        asyncio.run_coroutine_threadsafe(self._start(), self._loop).result(START_S)
        for note in self._layouts.notes(self._vehicle):
            self._station.note(note)

    def stop(self) -> None:
        with suppress(TimeoutError):  # a connection that does not close ends with the process
            asyncio.run_coroutine_threadsafe(self._close(), self._loop).result(STOP_S)
        self._call_soon(self._stopped.set)
        self._thread.join(STOP_S)

    def on_state(self, state: VehicleState | None) -> None:
        self._call_soon(self._broadcast, "state", state_to_json(state))

    def on_sample(self, sample: Sample) -> None:
        self._call_soon(self._add_sample, sample)

    def on_steering(self, at: float, rad: float) -> None:
        self._call_soon(self._broadcast, "steering", {"at_ms": 1000 * at, "rad": rad})

    def on_link(self, link: LinkState) -> None:
        self._call_soon(self._broadcast, "link", link._asdict())

    def on_note(self, note: Note) -> None:
        self._call_soon(self._add_note, {"time": note.t, "text": note.text})

    def show(self, camera: str, unit: AccessUnit) -> None:
        """A newly received access unit."""
        self._call_soon(self._show, camera, unit)

    def _call_soon(self, callback: Callable[..., object], *values: object) -> None:
        """Call a function in the page's thread, unless the page has stopped."""
        with suppress(RuntimeError):
            self._loop.call_soon_threadsafe(callback, *values)

    def _run(self) -> None:
        """Serve until stopped, then cancel pending tasks: Python 3.11 may crash on them at exit."""
        with asyncio.Runner(loop_factory=lambda: self._loop) as runner:
            runner.run(self._stopped.wait())

    # --- in the page's thread -----------------------------------------------------------------------------------------

    async def _start(self) -> None:
        middlewares = [self._on_request_complete, self._add_headers, self._check_access]
        app = web.Application(middlewares=middlewares, client_max_size=MAX_BODY)
        app.router.add_get("/live", self._on_viewer)
        app.router.add_get("/plotly.js", _file_handler(self._plotly))
        app.router.add_get("/", _static_handler(STATIC / "index.html"))
        app.router.add_get("/counter", _static_handler(STATIC / "counter.html"))
        if self._login:
            app.router.add_get("/login", _static_handler(STATIC / "login.html"))
            app.router.add_post("/login/challenge", self._on_challenge)
            app.router.add_post("/login", self._on_login)
        for file in STATIC.iterdir():
            app.router.add_get(f"/static/{file.name}", _static_handler(file))
        self._runner = web.AppRunner(
            app, access_log=None, logger=self._logger(), shutdown_timeout=0.5, keepalive_timeout=REQUEST_S
        )
        await self._runner.setup()
        endpoint, tls = self._setup.page.endpoint, self._tls.context if self._tls else None
        handshake_s = REQUEST_S if tls else None  # until it has ended, `_expire` has nothing to close
        self._server = await self._loop.create_server(
            self._new_connection, endpoint.host, endpoint.port, ssl=tls, ssl_handshake_timeout=handshake_s
        )

    def _logger(self) -> logging.Logger:
        """Reports the server library's warnings, without its tracebacks."""
        logger = logging.Logger("page")
        logger.addHandler(_FaultHandler(lambda text: self._report(text, "")))
        return logger

    def _new_connection(self) -> asyncio.Protocol:
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
            _abort(connection.transport)

    def _limit_strangers(self) -> None:
        """Make room for a new connection: without a limit, strangers would take all of the process's descriptors."""
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
        _abort(oldest.transport)

    async def _close(self) -> None:
        self._server.close()
        await self._runner.cleanup()

    @web.middleware
    async def _on_request_complete(self, request: web.Request, handler: Any) -> web.StreamResponse:
        """The first request is complete: cancel the connection's deadline."""
        self._awaiting_request.discard(request.protocol)
        response: web.StreamResponse = await handler(request)
        return response

    @web.middleware
    async def _add_headers(self, request: web.Request, handler: Any) -> web.StreamResponse:
        """Add HEADERS to every response, also to one that is raised."""
        headers = LOGIN_HEADERS if request.path in UNPROTECTED else HEADERS
        try:
            response: web.StreamResponse = await handler(request)
        except web.HTTPException as raised:
            raised.headers.update(headers)
            raise
        if not response.prepared:
            response.headers.update(headers)
        return response

    @web.middleware
    async def _check_access(self, request: web.Request, handler: Any) -> web.StreamResponse:
        """Accept only this server's own pages, under its own name, and from other machines only after login.

        No other site in the same browser may read or send anything, by whatever host name it resolves this server (DNS
        rebinding).
        """
        if foreign := self._foreign(request):
            self._report_refusal(request, foreign)
            raise web.HTTPForbidden(text="accepted only from this server's own pages\n")
        if not self._has_access(request):
            if request.path == "/":
                raise web.HTTPSeeOther(f"/login?{request.rel_url.raw_query_string}".rstrip("?"))
            if request.path not in UNPROTECTED:
                self._report_refusal(request, "not logged in")
                raise web.HTTPUnauthorized(text="login required: see /login\n")
        else:
            self._strangers.pop(request.protocol, None)
        try:
            response: web.StreamResponse = await handler(request)
        except (web.HTTPNotFound, web.HTTPMethodNotAllowed) as refused:
            self._report_refusal(request, refused.reason.lower())
            raise
        return response

    def _foreign(self, request: web.Request) -> str | None:
        """How a request differs from those of this server's own pages; None if it does not."""
        sockname = request.get_extra_info("sockname") or ("", 0)  # not request.url, which raises for a malformed Host
        scheme, origin = "https" if self._login else "http", request.headers.get("Origin")
        allowed = hosts(self._names, sockname[1], scheme)
        host = request.headers.get("Host", "")
        if host.lower() not in allowed:
            return f"Host {shortened(repr(host))} is not an address of this page"
        if origin is None:
            return "a POST without Origin" if request.method == "POST" else None
        own = {f"{scheme}://{name}" for name in allowed}
        return None if origin in own else f"Origin {shortened(repr(origin))} is another site"

    def _report_refusal(self, request: web.Request, why: str) -> None:
        path = shortened(repr(request.raw_path.partition("?")[0]))  # what follows may be anything, such as a password
        self._report(f"page: refused {request.method} {path} from {request.remote}: {why}", str(request.remote))

    async def _on_challenge(self, _request: web.Request) -> web.Response:
        assert self._login
        return web.json_response({"challenge": self._login.challenge(time.monotonic())})

    async def _on_login(self, request: web.Request) -> web.Response:
        assert self._login
        try:
            async with asyncio.timeout(REQUEST_S):
                document = read_message(await request.read())
        except TimeoutError:
            request.protocol.force_close()
            raise web.HTTPRequestTimeout from None
        except ValueError as problem:
            raise web.HTTPBadRequest(text=f"{problem}\n") from None
        challenge, answer = (str(document.get(key, "")) for key in ("challenge", "answer"))
        session = self._login.open(challenge, answer, time.monotonic())
        if session is None:
            self._report_refusal(request, "wrong token")
            raise web.HTTPForbidden(text="wrong token\n")
        response = web.Response(text="logged in\n")
        response.set_cookie(COOKIE, session, secure=True, httponly=True, samesite="Strict")
        return response

    def _add_sample(self, sample: Sample) -> None:
        self._history.add(sample)
        self._broadcast("sample", {"time": sample.t, **to_json(sample)})

    def _add_note(self, note: Mapping[str, Any]) -> None:
        self._notes.append(note)
        self._broadcast("note", note)

    def _broadcast(self, kind: str, message: Mapping[str, Any]) -> None:
        for viewer in self._viewers:
            viewer.post(kind, message)

    def _show(self, camera: str, unit: AccessUnit) -> None:
        index = self._index[camera]
        unit = self._recent[index].add(unit._replace(captured=self._station.captured_here(camera, unit.captured)))
        for viewer in self._viewers:
            viewer.show(index, unit)

    async def _on_viewer(self, request: web.Request) -> web.WebSocketResponse:
        token, browser = (request.query.get(key, "") for key in ("viewer", "browser"))
        if not 0 < len(token) <= 64 or len(browser) > 64:
            rule = "viewer: must be given, as text of at most 64 characters; browser: at most 64 characters"
            raise web.HTTPBadRequest(text=f"{rule}\n")
        monitor = "show" in request.query
        shown = request.query.get("show", "").split(",")
        cameras = [index for name, index in self._index.items() if name in shown or not monitor]
        connection = request.transport.get_extra_info("socket") if request.transport else None
        if connection is not None:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
        ws = web.WebSocketResponse(compress=False, max_msg_size=MAX_MESSAGE_BYTES, autoping=False)
        try:
            await ws.prepare(request)
        except ValueError:  # headers that are not ASCII: the client's fault
            raise web.HTTPBadRequest(text="not a handshake of a WebSocket\n") from None
        viewer = PageViewer(token, cameras, lambda camera: self._recent[camera].burst(), browser, monitor)
        self._viewers.append(viewer)
        self._send_current_state(viewer)
        if not monitor:
            self._control.on_opened(token, time.monotonic(), request.query.get("before"))
        self._broadcast_control()
        tasks = [asyncio.create_task(_send(ws, viewer)), asyncio.create_task(self._ping(ws, request))]
        try:
            await self._listen(ws, viewer, request)
        except TimeoutError:
            _abort(request.transport)
        finally:
            for task in tasks:
                task.cancel()
            self._viewers.remove(viewer)
            if token not in {other.token for other in self._viewers if not other.monitor}:
                self._control.on_closed(token, time.monotonic())
            self._broadcast_control()
        return ws

    async def _listen(self, ws: web.WebSocketResponse, viewer: PageViewer, request: web.Request) -> None:
        """Handle a viewer's messages, as long as it has access, until it disconnects.

        raises  TimeoutError if it makes no progress: pings share the connection with the video and must be answered
        """
        while (message := await ws.receive(UNRESPONSIVE_S)).type not in CLOSE_TYPES:
            if message.type is WSMsgType.PING:
                await asyncio.wait_for(ws.pong(message.data), UNRESPONSIVE_S)
            elif message.type in (WSMsgType.TEXT, WSMsgType.BINARY) and self._has_access(request):
                self._on_message(viewer, message.data)

    async def _ping(self, ws: web.WebSocketResponse, request: web.Request) -> None:
        """Ping a viewer at intervals, as long as it has access; `_listen` notices if it does not answer."""
        try:
            while self._has_access(request):
                await asyncio.sleep(PING_S)
                await ws.ping()
            await asyncio.wait_for(ws.close(message=b"log in again"), UNRESPONSIVE_S)
        except ConnectionError:
            pass  # `_listen` ends the connection
        except TimeoutError:
            _abort(request.transport)

    def _has_access(self, request: web.Request) -> bool:
        return self._login is None or self._login.accepts(request.cookies.get(COOKIE), time.monotonic())

    def _send_current_state(self, viewer: PageViewer) -> None:
        viewer.selected = next((other.selected for other in self._others(viewer) if other.selected), "")
        introduction = _introduction(self._setup, viewer.cameras)
        station = {"operator": self._station.user, "answer_s": self._station.answer_s}
        current = {"layout": self._layout(), "selected": viewer.selected or None}
        viewer.post("hello", introduction | station | current)
        viewer.post("link", self._station.link_state._asdict())
        viewer.post("state", state_to_json(self._station.state))
        viewer.post("history", self._history.columns())
        for note in self._notes:
            viewer.post("note", note)

    def _layout(self) -> dict[str, Any]:
        """The places of the pictures in both views, and why a layout cannot be saved."""
        own, places = own_places(self._vehicle), self._layouts.places(self._vehicle)
        problem, drive = None if self._layouts.path else NOWHERE, self._layouts.drive_places(self._vehicle)
        return {"places": _places(places), "own": _places(own), "drive": drive, "problem": problem}

    def _page_of(self, viewer: PageViewer) -> str:
        return page_of(viewer, self._viewers, self._control)

    def _others(self, viewer: PageViewer) -> list[PageViewer]:
        """The other windows of a viewer's page."""
        page = self._page_of(viewer)
        return [other for other in self._viewers if other is not viewer and self._page_of(other) == page]

    def _broadcast_control(self) -> None:
        """Send each viewer the holder of control, and whether another window of its page has the focus or is hidden.

        abandoned  nobody is in control because the page that was has closed
        """
        for viewer in self._viewers:
            others = self._others(viewer)
            elsewhere = any(other.focused for other in others)
            covered = any(other.attention is Attention.HIDDEN for other in others)
            holder = self._control.holder_for(self._page_of(viewer))
            abandoned = holder == "nobody" and self._control.is_held
            message = {"holder": holder, "abandoned": abandoned, "elsewhere": elsewhere, "covered": covered}
            viewer.post("control", message)
        self._report_attention()

    def _report_attention(self) -> None:
        """Report whether the driver can see the pictures, from the windows of the page in control."""
        driving = [viewer for viewer in self._viewers if self._control.holder_for(self._page_of(viewer)) == "you"]
        if driving:
            self._station.attention = combined_attention([viewer.attention for viewer in driving])
        else:
            self._station.attention = Attention.ABSENT if self._control.is_held else None

    def _on_message(self, viewer: PageViewer, text: str | bytes) -> None:
        """Handle one message of a page. Even an invalid one is answered and disturbs nothing else."""
        try:
            document = read_message(text.encode() if isinstance(text, str) else text)
        except ValueError as problem:
            viewer.post("reply", {"id": None, "result": "refused", "reason": str(problem)})
            return
        match document:
            case {"clock": int() | float() as page_ms}:
                viewer.post("clock", {"page_ms": page_ms, "server_ms": time.time() * 1000})
            case {"resync": str(name)} if name in self._index:
                viewer.restart(self._index[name])
            case {"counter": dict(found)} if self._on_counter and (reading := counter_reading(found)):
                self._on_counter(reading)
            case {"attention": str(word)} if word in REPORTED:
                viewer.attention, viewer.focused = Attention(word), document.get("focused") is True
                self._broadcast_control()
            case {"select": str(name)} if name in self._index:
                self._select(viewer, name)
            case {"take_control": True} | {"release_control": True} if viewer.monitor:
                reason = "only a page can take or release control, not its monitors"
                viewer.post("reply", {"id": document.get("id"), "result": "refused", "reason": reason})
            case {"take_control": True}:
                self._control.take(viewer.token)
                self._broadcast_control()
            case {"release_control": True}:
                self._control.release(viewer.token)
                self._broadcast_control()
            case _:
                self._on_request(viewer, document)

    def _select(self, viewer: PageViewer, camera: str) -> None:
        """Select a camera in all windows of a page."""
        viewer.selected = camera
        for other in self._others(viewer):
            other.selected = camera
            other.post("selection", {"camera": camera})

    def _on_request(self, viewer: PageViewer, document: dict[str, Any]) -> None:
        request_id = document.pop("id", None)

        def answer(result: str, reason: str) -> None:
            viewer.post("reply", {"id": request_id, "result": result, "reason": reason})

        if problem := self._refusal(viewer, request_id):
            answer("refused", problem)
        elif kind := next((kind for kind in ("layout", "drive") if kind in document), None):
            self._save_layout(kind, document, answer)
        else:
            self._send_request(document, answer)

    def _refusal(self, viewer: PageViewer, request_id: object) -> str | None:
        """Why a viewer's request is refused; None: it is accepted."""
        if not isinstance(request_id, str) or not 0 < len(request_id) <= 64:
            return "id: must be given, as text of at most 64 characters"
        if self._control.holder_for(self._page_of(viewer)) != "you":
            return "this page does not hold control; take it first"
        return None

    def _send_request(self, document: dict[str, Any], answer: Callable[[str, str], None]) -> None:
        """Send a request to the vehicle."""

        def on_reply(outcome: Outcome) -> None:
            self._call_soon(answer, outcome.result, outcome.reason)

        event = document.get("event")
        if event in DRIVER_EVENTS:
            self._station.ask(document, on_reply)
        else:
            answer("refused", f"event: {event!r}: must be one of {', '.join(sorted(DRIVER_EVENTS))}")

    def _save_layout(self, kind: str, document: dict[str, Any], answer: Callable[[str, str], None]) -> None:
        """Save the layout of a view in its own thread: a hung disk must not stop the video."""
        if unknown := sorted(document.keys() - {kind}):
            answer("refused", f"{shortened(unknown[0])}: unknown key, only {kind} is allowed")
        elif self._is_saving:
            answer("refused", "another layout is being saved")
        else:
            self._is_saving = True
            save = self._layouts.save if kind == "layout" else self._layouts.save_drive
            work = partial(save, self._vehicle, document[kind])
            threading.Thread(target=self._write_layout, args=(work, answer), name="layout", daemon=True).start()

    def _write_layout(self, save: Callable[[], None], answer: Callable[[str, str], None]) -> None:
        """Runs in its own thread."""
        problem = "the layout could not be saved"
        try:
            save()
            problem = ""
        except ConfigError as error:
            problem = "; ".join(map(str, error.problems))
        except (UserError, RunError) as error:
            problem = str(error)
        finally:
            self._call_soon(self._on_layout_saved, problem, answer)

    def _on_layout_saved(self, problem: str, answer: Callable[[str, str], None]) -> None:
        self._is_saving = False
        if not problem:
            self._broadcast("layout", self._layout())
        answer("refused" if problem else "applied", problem)


def hosts(names: Iterable[str], port: int, scheme: str) -> set[str]:
    """What browsers send as Host: a name in lower case, without the port if it is the scheme's own."""
    known = {_as_in_url(name) for name in names}
    return {f"{name}:{port}" for name in known} | (known if port == DEFAULT_PORTS[scheme] else set())


def _as_in_url(name: str) -> str:
    """An address or name as browsers write it: IPv6 in its shortest form (RFC 5952), in brackets."""
    try:
        address = ip_address(name)
    except ValueError:
        return name.lower()
    return f"[{address}]" if address.version == 6 else str(address)


def _recent(camera: Camera) -> RecentUnits:
    return RecentUnits(camera.graph.settings.key_interval_s, video_codec(camera.graph))


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


def _abort(transport: asyncio.BaseTransport | None) -> None:
    """End a connection whose peer would not answer."""
    if isinstance(transport, asyncio.Transport):
        transport.abort()


async def _send(ws: web.WebSocketResponse, viewer: PageViewer) -> None:
    """Send the queued messages, as fast as the viewer accepts them."""
    try:
        while True:
            message = await viewer.next()
            if isinstance(message, str):
                await ws.send_str(message)
            else:
                await ws.send_bytes(message)
    except ConnectionError:
        pass  # `_listen` ends the connection


def _introduction(setup: Setup, shown: Sequence[int]) -> dict[str, Any]:
    """The description of the vehicle that a page needs first.

    shown  indexes of the cameras that the page shows
    """
    cameras = [
        {
            "name": camera.name,
            "index": index,
            "width": camera.width,
            "height": camera.height,
            "fps": float(camera.fps),
            "wave_s": camera.graph.settings.key_interval_s,
            "pose": camera.pose and asdict(camera.pose),
            "fov_deg": camera.fov_deg,
            "lens": camera.lens,
            "native": _native(camera),
            "calibrated": camera.calibrated,
            "framing": camera.framing,
            "codec": video_codec(camera.graph) or None,
            "weight": plain(camera.weight),
            "scaling": [plain(factor) for factor in camera.rate_quality.scaling],
            "b_min_kbps": [plain(bound) for bound in camera.rate_quality.b_min],
            "b_full_kbps": plain(camera.rate_quality.b_full),
        }
        for index, camera in enumerate(setup.vehicle.cameras.values())
        if index in shown
    ]
    dimensions = setup.dimensions and asdict(setup.dimensions)
    limits = {"late_ms": setup.page.late_ms, "frozen_ms": FROZEN_MS}
    inputs = asdict(setup.inputs)
    return {"vehicle": setup.vehicle.name, "cameras": cameras, "dimensions": dimensions, "inputs": inputs, **limits}


def _places(places: Places) -> dict[str, Any]:
    return {name: place and asdict(place) for name, place in places.items()}


def _native(camera: Camera) -> dict[str, int]:
    """Size of the source's image, and where the full image begins in it, px."""
    width, height = camera.source_size
    return {"width": width, "height": height, "left": camera.in_source.x, "top": camera.in_source.y}


def _static_handler(file: Path) -> Any:
    """A handler that serves a small file from memory: a page requests dozens of them when it opens."""
    body, kind = file.read_bytes(), mimetypes.guess_type(file.name)[0]

    async def serve(_request: web.Request) -> web.Response:
        return web.Response(body=body, content_type=kind or "application/octet-stream")

    return serve


def _file_handler(path: Path) -> Any:
    """A handler that sends a large file from disk."""

    async def send(_request: web.Request) -> web.FileResponse:
        return web.FileResponse(path)

    return send
