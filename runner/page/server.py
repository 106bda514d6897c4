"""Serves the operator's page, its video and its requests, in an asyncio loop in its own thread."""

from __future__ import annotations

import asyncio
import logging
import mimetypes
import socket
import ssl
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from aiohttp import WSMsgType, web
from aiohttp.http_exceptions import HttpProcessingError
from aiohttp.web_protocol import RequestHandler

from runner.configuration.layout import NOWHERE, Layouts, Places, own_places
from runner.core.events import Attention
from runner.core.model import Camera, Vehicle, plain
from runner.errors import ConfigError, RunError, UserError
from runner.graph import video_codec
from runner.h264.access_unit import AccessUnit, RecentUnits
from runner.mqtt.messages import read_message
from runner.operator.station import Listener, Station
from runner.page.control import Control, attention_of, page_of
from runner.page.counter import CounterReading, counter_reading
from runner.page.history import History
from runner.page.login import COOKIE, SESSION_S, PageLogin
from runner.page.viewer import PageViewer
from runner.records import Note, Outcome, Sample, VehicleState, state_to_json, to_json
from runner.schema import shortened
from runner.security.keyring import Keyring
from runner.system.files import plotly_script
from runner.system.ports import check_port_free

STATIC = Path(__file__).with_name("static")
FROZEN_MS = 120  # a picture that is frozen for this long is marked within 150 ms
NOTES = 50  # sent to a page that opens
EVENTS = ("mode_selected", "total_set", "camera_switched", "roi_set", "camera_configured", "weights_set")
STATED = tuple(attention.value for attention in Attention if attention is not Attention.ABSENT)  # by a page itself
SEND_BUFFER_BYTES = 131_072  # so that a viewer that does not read is noticed here, not megabytes later
START_S = 10.0  # the port is known to be free: only a stalled machine takes longer
STOP_S = 0.5  # how long open connections may take to close
REQUEST_S = 10.0  # a connection without a complete request for this long is closed
PING_S = 0.5
SILENT_S = 2.0  # a viewer that has not answered a ping for this long is dropped, and reconnects if it is alive
ENDS = (WSMsgType.CLOSE, WSMsgType.CLOSING, WSMsgType.CLOSED, WSMsgType.ERROR)
CLOSED_ABOVE_BYTES = 1_048_576  # a longer message is not read
POLICY = (
    "default-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; worker-src 'self'; "
    "frame-ancestors 'none'; base-uri 'none'; form-action 'self'; object-src 'none'"
)
HEADERS = {
    "Content-Security-Policy": POLICY,
    "Cache-Control": "no-cache",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
# What a browser needs before it has logged in.
UNPROTECTED = (
    "/login",
    "/login/challenge",
    *(f"/static/{name}" for name in ("login.js", "login.css", "style.css")),
)


class PageServer(Listener):
    """The page and its viewers.

    A listener of the station; it and `show` may be called from any thread, everything else runs in the page's own.

    on_counter  called, in the page's thread, with what a page read of the counter that a camera films; None: such
                messages are refused
    keyring     of the operator, to serve other machines: by HTTPS, to those that have its token; None: loopback only
    layouts     of the operator; None: none can be saved
    raises      RunError if the port is in use or plotly is not installed
    """

    def __init__(
        self,
        vehicle: Vehicle,
        station: Station,
        on_counter: Callable[[CounterReading], None] | None = None,
        keyring: Keyring | None = None,
        layouts: Layouts | None = None,
    ) -> None:
        self._vehicle, self._station, self._on_counter = vehicle, station, on_counter
        self._layouts, self._saving = layouts or Layouts(), False
        self._keyring = keyring
        self._login = PageLogin(keyring.watched_token(station.note).get) if keyring else None
        self._names = keyring.holder.hosts if keyring else ("127.0.0.1", "localhost")
        self._refusals = 0
        check_port_free(vehicle.page.endpoint)
        self._address = (vehicle.page.endpoint.host, vehicle.page.endpoint.port)
        self._plotly = plotly_script("page")
        self._index = {name: number for number, name in enumerate(vehicle.cameras)}
        self._recent = [_recent(camera) for camera in vehicle.cameras.values()]
        self._history = History()
        self._notes: deque[Mapping[str, Any]] = deque(maxlen=NOTES)
        self._viewers: list[PageViewer] = []  # the newest last
        self._control = Control()
        self._silent: set[RequestHandler] = set()  # new connections without a complete request
        self._loop = asyncio.new_event_loop()
        self._stopped = asyncio.Event()
        self._thread = threading.Thread(target=self._run, name="page", daemon=True)

    @property
    def url(self) -> str:
        host, port = self._address
        if self._keyring is None:
            return f"http://{host}:{port}/"
        return f"https://{next(iter(self._names), host)}:{port}/"

    def start(self) -> None:
        self._thread.start()
        asyncio.run_coroutine_threadsafe(self._start(), self._loop).result(START_S)
        for note in self._layouts.notes(self._vehicle):
            self._station.note(note)

    def stop(self) -> None:
        with suppress(TimeoutError):  # a connection that does not close ends with the process
            asyncio.run_coroutine_threadsafe(self._end(), self._loop).result(STOP_S)
        self._in_page(self._stopped.set)
        self._thread.join(STOP_S)

    def on_state(self, state: VehicleState | None) -> None:
        self._in_page(self._tell, "state", state_to_json(state))

    def on_sample(self, sample: Sample) -> None:
        self._in_page(self._add_sample, sample)

    def on_steering(self, at: float, rad: float) -> None:
        self._in_page(self._tell, "steering", {"at_ms": 1000 * at, "rad": rad})

    def on_note(self, note: Note) -> None:
        self._in_page(self._add_note, {"time": note.t, "text": note.text})

    def show(self, camera: str, unit: AccessUnit) -> None:
        """A newly received access unit."""
        self._in_page(self._show, camera, unit)

    def _in_page(self, callback: Callable[..., object], *values: object) -> None:
        """Call it in the page's thread, unless the page has stopped."""
        with suppress(RuntimeError):
            self._loop.call_soon_threadsafe(callback, *values)

    def _run(self) -> None:
        """Serve until stopped, then cancel what still waits: Python 3.11 may crash on it when the process ends."""
        with asyncio.Runner(loop_factory=lambda: self._loop) as runner:
            runner.run(self._stopped.wait())

    # --- in the page's thread -----------------------------------------------------------------------------------------

    async def _start(self) -> None:
        app = web.Application(middlewares=[self._heard, self._guard])
        app.router.add_get("/live", self._on_viewer)
        app.router.add_get("/plotly.js", lambda _: _script(self._plotly))
        app.router.add_get("/", _served(STATIC / "index.html"))
        app.router.add_get("/counter", _served(STATIC / "counter.html"))
        if self._login:
            app.router.add_get("/login", _served(STATIC / "login.html"))
            app.router.add_post("/login/challenge", self._on_challenge)
            app.router.add_post("/login", self._on_login)
        for file in STATIC.iterdir():
            app.router.add_get(f"/static/{file.name}", _served(file))
        self._runner = web.AppRunner(
            app, access_log=None, logger=self._logger(), shutdown_timeout=0.5, keepalive_timeout=REQUEST_S
        )
        await self._runner.setup()
        tls = _tls(self._keyring) if self._keyring else None
        self._server = await self._loop.create_server(self._connection, *self._address, ssl=tls)

    def _logger(self) -> logging.Logger:
        """Reports the server library's warnings, without its tracebacks."""
        logger = logging.Logger("page")
        logger.addHandler(_FaultHandler(self._station.note))
        return logger

    def _connection(self) -> asyncio.Protocol:
        """A new connection, which is closed unless its first request is complete in time."""
        assert self._runner.server
        connection = self._runner.server()
        self._silent.add(connection)
        self._loop.call_later(REQUEST_S, self._expire, connection)
        return connection

    def _expire(self, connection: RequestHandler) -> None:
        if connection in self._silent:
            self._silent.remove(connection)
            connection.force_close()

    async def _end(self) -> None:
        self._server.close()
        await self._runner.cleanup()

    @web.middleware
    async def _heard(self, request: web.Request, handler: Any) -> web.StreamResponse:
        """A request is complete."""
        self._silent.discard(request.protocol)
        response: web.StreamResponse = await handler(request)
        return response

    @web.middleware
    async def _guard(self, request: web.Request, handler: Any) -> web.StreamResponse:
        """Only pages of this server, by its own name, and from other machines only those that have logged in.

        No other site in the same browser may read or send anything, whatever name it gives this server (DNS rebinding).
        """
        sockname = request.get_extra_info("sockname") or ("", 0)  # not request.url, which raises for a malformed Host
        allowed = {f"{name}:{sockname[1]}" for name in self._names}
        scheme, origin = "https" if self._login else "http", request.headers.get("Origin")
        foreign = origin is not None and origin not in {f"{scheme}://{name}" for name in allowed}
        if request.headers.get("Host") not in allowed or foreign or (request.method == "POST" and origin is None):
            raise web.HTTPForbidden(text="only for pages of this server\n")
        if not self._may_see(request):
            if request.path == "/":
                raise web.HTTPSeeOther(f"/login?{request.rel_url.raw_query_string}".rstrip("?"))
            if request.path not in UNPROTECTED:
                raise web.HTTPUnauthorized(text="log in first, at /login\n")
        response: web.StreamResponse = await handler(request)
        if not response.prepared:
            response.headers.update(HEADERS)
        return response

    async def _on_challenge(self, _request: web.Request) -> web.Response:
        assert self._login
        return web.json_response({"challenge": self._login.challenge(time.monotonic())})

    async def _on_login(self, request: web.Request) -> web.Response:
        assert self._login
        try:
            document = read_message(await request.read())
        except ValueError as problem:
            raise web.HTTPBadRequest(text=f"{problem}\n") from None
        challenge, answer = (str(document.get(key, "")) for key in ("challenge", "answer"))
        session = self._login.open(challenge, answer, time.monotonic())
        if session is None:
            self._refusals += 1
            self._station.note(f"page: {request.remote} did not have the token ({self._refusals} refused so far)")
            raise web.HTTPForbidden(text="not the token of this page\n")
        response = web.Response(text="welcome\n")
        response.set_cookie(COOKIE, session, max_age=int(SESSION_S), secure=True, httponly=True, samesite="Strict")
        return response

    def _add_sample(self, sample: Sample) -> None:
        self._history.add(sample)
        self._tell("sample", {"time": sample.t, **to_json(sample)})

    def _add_note(self, note: Mapping[str, Any]) -> None:
        self._notes.append(note)
        self._tell("note", note)

    def _tell(self, kind: str, message: Mapping[str, Any]) -> None:
        for viewer in self._viewers:
            viewer.tell(kind, message)

    def _show(self, camera: str, unit: AccessUnit) -> None:
        index = self._index[camera]
        unit = self._recent[index].add(unit._replace(captured=self._station.captured_here(camera, unit.captured)))
        for viewer in self._viewers:
            viewer.show(index, unit)

    async def _on_viewer(self, request: web.Request) -> web.WebSocketResponse:
        token, browser = (request.query.get(key, "") for key in ("viewer", "browser"))
        if not 0 < len(token) <= 64 or len(browser) > 64:
            rule = "viewer: must be given, as text of at most 64 characters; browser: at most as many"
            raise web.HTTPBadRequest(text=f"{rule}\n")
        monitor = "show" in request.query
        shown = request.query.get("show", "").split(",")
        cameras = [index for name, index in self._index.items() if name in shown or not monitor]
        line = request.transport.get_extra_info("socket") if request.transport else None
        if line is not None:
            line.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
        ws = web.WebSocketResponse(compress=False, max_msg_size=CLOSED_ABOVE_BYTES, autoping=False)
        await ws.prepare(request)
        viewer = PageViewer(token, cameras, lambda camera: self._recent[camera].burst(), browser, monitor)
        self._viewers.append(viewer)
        self._greet(viewer)
        if not monitor:
            self._control.opened(token, time.monotonic())
        self._tell_control()
        tasks = [asyncio.create_task(_send(ws, viewer)), asyncio.create_task(self._ping(ws, request))]
        try:
            await self._listen(ws, viewer)
        except TimeoutError:
            if request.transport:
                request.transport.abort()  # a close frame would not be answered either
        finally:
            for task in tasks:
                task.cancel()
            self._viewers.remove(viewer)
            if token not in {other.token for other in self._viewers if not other.monitor}:
                self._control.closed(token, time.monotonic())
            self._tell_control()
        return ws

    async def _listen(self, ws: web.WebSocketResponse, viewer: PageViewer) -> None:
        """The messages of a viewer, until it disconnects.

        raises  TimeoutError if it makes no progress: pings share the connection with the video, and must be answered
        """
        while (message := await ws.receive(SILENT_S)).type not in ENDS:
            if message.type is WSMsgType.PING:
                await asyncio.wait_for(ws.pong(message.data), SILENT_S)
            elif message.type in (WSMsgType.TEXT, WSMsgType.BINARY):
                self._on_message(viewer, message.data)

    async def _ping(self, ws: web.WebSocketResponse, request: web.Request) -> None:
        """Ping a viewer regularly, so that it answers, as long as it may watch."""
        with suppress(ConnectionError):  # the reader of the socket ends it
            while self._may_see(request):
                await asyncio.sleep(PING_S)
                await ws.ping()
            await ws.close(message=b"log in again")

    def _may_see(self, request: web.Request) -> bool:
        return self._login is None or self._login.accepts(request.cookies.get(COOKIE), time.monotonic())

    def _greet(self, viewer: PageViewer) -> None:
        viewer.selected = next((other.selected for other in self._others(viewer) if other.selected), "")
        introduction = _introduction(self._vehicle, viewer.cameras)
        own = {"layout": self._layout(), "selected": viewer.selected or None, "answer_s": self._station.answer_s}
        viewer.tell("hello", introduction | own)
        viewer.tell("state", state_to_json(self._station.state))
        viewer.tell("history", self._history.columns())
        for note in self._notes:
            viewer.tell("note", note)

    def _layout(self) -> dict[str, Any]:
        """Where the pictures of the Configure view are, and why another layout cannot be saved."""
        own, places = own_places(self._vehicle), self._layouts.places(self._vehicle)
        return {"places": _places(places), "own": _places(own), "problem": None if self._layouts.path else NOWHERE}

    def _page_of(self, viewer: PageViewer) -> str:
        return page_of(viewer, self._viewers, self._control)

    def _others(self, viewer: PageViewer) -> list[PageViewer]:
        """The other windows of a viewer's page."""
        page = self._page_of(viewer)
        return [other for other in self._viewers if other is not viewer and self._page_of(other) == page]

    def _tell_control(self) -> None:
        """To each viewer who holds control, and whether keys reach another window of its page."""
        for viewer in self._viewers:
            elsewhere = any(other.attention is Attention.WATCHING for other in self._others(viewer))
            holder = self._control.seen_by(self._page_of(viewer))
            viewer.tell("control", {"holder": holder, "elsewhere": elsewhere})
        self._state_attention()

    def _state_attention(self) -> None:
        """State whether the person who drives can see the pictures: by the windows of the page in control."""
        driving = [viewer for viewer in self._viewers if self._control.seen_by(self._page_of(viewer)) == "you"]
        if driving:
            self._station.attention = attention_of([viewer.attention for viewer in driving])
        else:
            self._station.attention = Attention.ABSENT if self._control.is_held else None

    def _on_message(self, viewer: PageViewer, text: str | bytes) -> None:
        """One message of a page; whatever it contains, it is answered and affects nothing else."""
        try:
            document = read_message(text.encode() if isinstance(text, str) else text)
        except ValueError as problem:
            viewer.tell("reply", {"id": None, "result": "refused", "reason": str(problem)})
            return
        match document:
            case {"clock": int() | float() as page_ms}:
                viewer.tell("clock", {"page_ms": page_ms, "server_ms": time.time() * 1000})
            case {"resync": str(name)} if name in self._index:
                viewer.restart(self._index[name])
            case {"counter": dict(found)} if self._on_counter and (reading := counter_reading(found)):
                self._on_counter(reading)
            case {"attention": str(word)} if word in STATED:
                viewer.attention = Attention(word)
                self._tell_control()
            case {"select": str(name)} if name in self._index:
                self._select(viewer, name)
            case {"take_control": True} | {"release_control": True} if viewer.monitor:
                reason = "a monitor takes and releases no control: the page that it belongs to does"
                viewer.tell("reply", {"id": document.get("id"), "result": "refused", "reason": reason})
            case {"take_control": True}:
                self._control.take(viewer.token)
                self._tell_control()
            case {"release_control": True}:
                self._control.release(viewer.token)
                self._tell_control()
            case _:
                self._on_request(viewer, document)

    def _select(self, viewer: PageViewer, camera: str) -> None:
        """A camera is selected in all windows of a page."""
        viewer.selected = camera
        for other in self._others(viewer):
            other.selected = camera
            other.tell("selection", {"camera": camera})

    def _on_request(self, viewer: PageViewer, document: dict[str, Any]) -> None:
        identity = document.pop("id", None)

        def answer(result: str, reason: str) -> None:
            viewer.tell("reply", {"id": identity, "result": result, "reason": reason})

        if problem := self._not_allowed(viewer, identity):
            answer("refused", problem)
        elif "layout" in document:
            self._save(document, answer)
        else:
            self._ask(document, answer)

    def _not_allowed(self, viewer: PageViewer, identity: object) -> str | None:
        """Why a request of a viewer is not carried out; None if it is."""
        if not isinstance(identity, str) or not 0 < len(identity) <= 64:
            return "id: must be given, as text of at most 64 characters"
        if self._control.seen_by(self._page_of(viewer)) != "you":
            return "this page does not hold control; take it first"
        return None

    def _ask(self, document: dict[str, Any], answer: Callable[[str, str], None]) -> None:
        """Send a request to the vehicle."""

        def on_reply(outcome: Outcome) -> None:
            self._in_page(answer, outcome.result, outcome.reason)

        event = document.get("event")
        if event in EVENTS:
            self._station.ask(document, on_reply)
        else:
            answer("refused", f"event: {event!r}: must be one of {', '.join(EVENTS)}")

    def _save(self, document: dict[str, Any], answer: Callable[[str, str], None]) -> None:
        """Save a layout in a thread of its own: a disk that hangs must not stop the video."""
        if unknown := sorted(document.keys() - {"layout"}):
            answer("refused", f"{shortened(unknown[0])}: unknown key beside layout")
        elif self._saving:
            answer("refused", "another layout is being saved")
        else:
            self._saving = True
            threading.Thread(target=self._write, args=(document["layout"], answer), name="layout", daemon=True).start()

    def _write(self, layout: Any, answer: Callable[[str, str], None]) -> None:
        """In its own thread."""
        problem = "the layout could not be saved"
        try:
            self._layouts.save(self._vehicle, layout)
            problem = ""
        except ConfigError as error:
            problem = "; ".join(map(str, error.problems))
        except (UserError, RunError) as error:
            problem = str(error)
        finally:
            self._in_page(self._saved, problem, answer)

    def _saved(self, problem: str, answer: Callable[[str, str], None]) -> None:
        self._saving = False
        if not problem:
            self._tell("layout", self._layout())
        answer("refused" if problem else "applied", problem)


def _recent(camera: Camera) -> RecentUnits:
    period = camera.graph.settings.get("key_interval_s")
    return RecentUnits(None if period is None else float(period), video_codec(camera.graph))


class _FaultHandler(logging.Handler):
    """Notes each fault of this server once. Invalid HTTP is its sender's fault, and answered with 400."""

    def __init__(self, note: Callable[[str], None]) -> None:
        super().__init__(logging.WARNING)
        self._note, self._noted = note, set[str]()

    def emit(self, record: logging.LogRecord) -> None:
        error = record.exc_info[1] if record.exc_info else None
        text = f"page: {record.getMessage()}" + (f": {type(error).__name__}: {error}" if error else "")
        if not isinstance(error, HttpProcessingError) and text not in self._noted and len(self._noted) < NOTES:
            self._noted.add(text)
            self._note(text)


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
        pass  # the reader of the socket ends it


def _introduction(vehicle: Vehicle, shown: Sequence[int]) -> dict[str, Any]:
    """What a page must know about the vehicle first.

    shown  indexes of the cameras that it shows
    """
    cameras = [
        {
            "name": camera.name,
            "index": index,
            "width": camera.width,
            "height": camera.height,
            "fps": float(camera.fps),
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
        for index, camera in enumerate(vehicle.cameras.values())
        if index in shown
    ]
    dimensions = vehicle.dimensions and asdict(vehicle.dimensions)
    limits = {"late_ms": vehicle.page.late_ms, "frozen_ms": FROZEN_MS}
    inputs = asdict(vehicle.inputs)
    return {"vehicle": vehicle.name, "cameras": cameras, "dimensions": dimensions, "inputs": inputs, **limits}


def _places(places: Places) -> dict[str, Any]:
    return {name: place and asdict(place) for name, place in places.items()}


def _native(camera: Camera) -> dict[str, int]:
    """The source's image, and where the full image begins in it, px."""
    width, height = camera.source_size
    return {"width": width, "height": height, "left": camera.in_source.x, "top": camera.in_source.y}


def _tls(keyring: Keyring) -> ssl.SSLContext:
    """raises RunError"""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    try:
        context.load_cert_chain(keyring.certificate, keyring.key)
    except (OSError, ssl.SSLError) as error:
        raise RunError(f"{keyring.directory}: {error}") from None
    return context


def _served(file: Path) -> Any:
    """A handler for a small file, from memory: a page that opens requests thirty at once."""
    body, kind = file.read_bytes(), mimetypes.guess_type(file.name)[0]

    async def serve(_request: web.Request) -> web.Response:
        return web.Response(body=body, content_type=kind or "application/octet-stream")

    return serve


async def _script(path: Path) -> web.FileResponse:
    return web.FileResponse(path)
