"""Serves the operator's page, its video and its requests, in an asyncio loop in a thread of its own."""

from __future__ import annotations

import asyncio
import mimetypes
import socket
import threading
import time
from collections import deque
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from aiohttp import WSMsgType, web

from runner.control import read_message
from runner.errors import RunError
from runner.model import Vehicle, plain
from runner.page.control import Control
from runner.page.history import History
from runner.page.viewer import Viewer
from runner.ports import check_port_free
from runner.station import Station
from runner.units import AccessUnit, Recent

STATIC = Path(__file__).with_name("static")
FROZEN_MS = 120  # a picture that stands for so long is marked within 150 ms
NOTES = 50  # told to a page that opens
EVENTS = ("mode_selected", "total_set", "camera_switched", "roi_set", "camera_configured", "weights_set")
SEND_BUFFER_BYTES = 131_072  # so that a viewer that does not read is noticed here and not megabytes later
HEARTBEAT_S = 30  # a viewer that vanished without a word is noticed after one and a half of these
CLOSED_ABOVE_BYTES = 1_048_576  # a message as long as this is not even read
POLICY = (
    "default-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; worker-src 'self'; "
    "frame-ancestors 'none'"
)


class Page:
    """The page and everybody who looks at it.

    `tell` and `show` may be called from any thread; everything else happens in the page's own.

    raises  RunError where the port is in use or plotly is not installed
    """

    def __init__(self, vehicle: Vehicle, station: Station) -> None:
        self._vehicle, self._station = vehicle, station
        check_port_free(vehicle.page.endpoint)
        self._address = (vehicle.page.endpoint.host, vehicle.page.endpoint.port)
        self._plotly = _plotly_script()
        self._index = {name: number for number, name in enumerate(vehicle.cameras)}
        periods = (camera.graph.settings.get("key_interval_s") for camera in vehicle.cameras.values())
        self._recent = [Recent(None if period is None else float(period)) for period in periods]
        self._history = History()
        self._notes: deque[Mapping[str, Any]] = deque(maxlen=NOTES)
        self._viewers: set[Viewer] = set()
        self._control = Control()
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="page", daemon=True)

    @property
    def url(self) -> str:
        host, port = self._address
        return f"http://{host}:{port}/"

    def start(self) -> None:
        self._thread.start()
        asyncio.run_coroutine_threadsafe(self._start(), self._loop).result()

    def stop(self) -> None:
        asyncio.run_coroutine_threadsafe(self._runner.cleanup(), self._loop).result()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(timeout=5)

    def tell(self, kind: str, message: Mapping[str, Any]) -> None:
        """What is new, as `Station` tells it."""
        self._loop.call_soon_threadsafe(self._tell, kind, message)

    def show(self, camera: str, unit: AccessUnit) -> None:
        """One access unit that has just come."""
        self._loop.call_soon_threadsafe(self._show, self._index[camera], unit)

    # --- in the page's thread -----------------------------------------------------------------------------------------

    async def _start(self) -> None:
        app = web.Application(middlewares=[_guard])
        app.router.add_get("/live", self._on_viewer)
        app.router.add_get("/plotly.js", lambda _: _script(self._plotly))
        app.router.add_get("/", _served(STATIC / "index.html"))
        for file in STATIC.iterdir():
            app.router.add_get(f"/static/{file.name}", _served(file))
        self._runner = web.AppRunner(app, access_log=None, shutdown_timeout=0.5)
        await self._runner.setup()
        await web.TCPSite(self._runner, *self._address).start()

    def _tell(self, kind: str, message: Mapping[str, Any]) -> None:
        if kind == "sample":
            self._history.add(message)
        elif kind == "note":
            self._notes.append(message)
        for viewer in self._viewers:
            viewer.tell(kind, message)

    def _show(self, camera: int, unit: AccessUnit) -> None:
        unit = self._recent[camera].add(unit)
        for viewer in self._viewers:
            viewer.show(camera, unit)

    async def _on_viewer(self, request: web.Request) -> web.WebSocketResponse:
        token = request.query.get("viewer", "")
        if not 0 < len(token) <= 64:
            raise web.HTTPBadRequest(text="viewer: must be given, as text of at most 64 characters\n")
        line = request.transport.get_extra_info("socket") if request.transport else None
        if line is not None:
            line.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
        ws = web.WebSocketResponse(compress=False, max_msg_size=CLOSED_ABOVE_BYTES, heartbeat=HEARTBEAT_S)
        await ws.prepare(request)
        viewer = Viewer(token, len(self._recent), lambda camera: self._recent[camera].burst())
        self._greet(viewer)
        self._viewers.add(viewer)
        self._control.opened(token, time.monotonic())
        self._tell_control()
        sender = asyncio.create_task(_send(ws, viewer))
        try:
            async for message in ws:
                if message.type in (WSMsgType.TEXT, WSMsgType.BINARY):
                    self._on_message(viewer, message.data)
        finally:
            sender.cancel()
            self._viewers.remove(viewer)
            if token not in {other.token for other in self._viewers}:
                self._control.closed(token, time.monotonic())
            self._tell_control()
        return ws

    def _greet(self, viewer: Viewer) -> None:
        viewer.tell("hello", _introduction(self._vehicle))
        viewer.tell("state", self._station.state)
        viewer.tell("history", self._history.columns())
        for note in self._notes:
            viewer.tell("note", note)

    def _tell_control(self) -> None:
        for viewer in self._viewers:
            viewer.tell("control", {"holder": self._control.seen_by(viewer.token)})

    def _on_message(self, viewer: Viewer, text: str | bytes) -> None:
        """One message of a page; whatever it holds, it is answered and nothing else suffers."""
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
            case {"take_control": True}:
                self._control.take(viewer.token)
                self._tell_control()
            case {"release_control": True}:
                self._control.release(viewer.token)
                self._tell_control()
            case _:
                self._on_request(viewer, document)

    def _on_request(self, viewer: Viewer, document: dict[str, Any]) -> None:
        identity = document.pop("id", None)

        def answer(kind: str, said: Mapping[str, Any]) -> None:
            viewer.tell(kind, {"id": identity, **said})

        problem = self._problem(viewer.token, identity, document.get("event"))
        if problem:
            answer("reply", {"result": "refused", "reason": problem})
        else:
            self._station.ask(document, lambda *said: self._loop.call_soon_threadsafe(answer, *said))

    def _problem(self, token: str, identity: object, event: object) -> str:
        """Why a request is not even sent to the vehicle, or ""."""
        if not isinstance(identity, str) or not 0 < len(identity) <= 64:
            return "id: must be given, as text of at most 64 characters"
        if event not in EVENTS:
            return f"event: {event!r}: must be one of {', '.join(EVENTS)}"
        if self._control.seen_by(token) != "you":
            return "this page does not hold control; take it first"
        return ""


async def _send(ws: web.WebSocketResponse, viewer: Viewer) -> None:
    """Send what waits, as fast as the viewer takes it."""
    try:
        while True:
            message = await viewer.next()
            if isinstance(message, str):
                await ws.send_str(message)
            else:
                await ws.send_bytes(message)
    except ConnectionError:
        pass  # who reads the socket ends it


def _introduction(vehicle: Vehicle) -> dict[str, Any]:
    """What a page must know of the vehicle before anything else."""
    cameras = [
        {
            "name": camera.name,
            "width": camera.width,
            "height": camera.height,
            "fps": float(camera.fps),
            "place": {"row": camera.place.row, "column": camera.place.column} if camera.place else None,
            "weight": plain(camera.weight),
            "scaling": [plain(factor) for factor in camera.rate_quality.scaling],
            "b_min_kbps": [plain(bound) for bound in camera.rate_quality.b_min],
            "b_full_kbps": plain(camera.rate_quality.b_full),
        }
        for camera in vehicle.cameras.values()
    ]
    return {"vehicle": vehicle.name, "cameras": cameras, "late_ms": vehicle.page.late_ms, "frozen_ms": FROZEN_MS}


@web.middleware
async def _guard(request: web.Request, handler: Any) -> web.StreamResponse:
    """Only pages of this server, by its own name: no other site in the same browser may look or ask."""
    allowed = {f"{host}:{request.url.port}" for host in ("127.0.0.1", "localhost")}
    origin = request.headers.get("Origin")
    if request.headers.get("Host") not in allowed or (origin and origin.removeprefix("http://") not in allowed):
        raise web.HTTPForbidden(text="only for pages of this server\n")
    response: web.StreamResponse = await handler(request)
    if not response.prepared:
        response.headers["Content-Security-Policy"] = POLICY
        response.headers["Cache-Control"] = "no-cache"
    return response


def _served(file: Path) -> Any:
    """A handler for a small file, from memory: a page that opens asks for thirty at once."""
    body, kind = file.read_bytes(), mimetypes.guess_type(file.name)[0]

    async def serve(_request: web.Request) -> web.Response:
        return web.Response(body=body, content_type=kind or "application/octet-stream")

    return serve


async def _script(path: Path) -> web.FileResponse:
    return web.FileResponse(path)


def _plotly_script() -> Path:
    """The script that plotly's wheel brings.

    raises  RunError
    """
    spec = find_spec("plotly")
    if spec is None or spec.origin is None:
        raise RunError("the Python module plotly is not installed: pip install 'tod-runner[page]'")
    return Path(spec.origin).parent / "package_data" / "plotly.min.js"
