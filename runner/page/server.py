"""Serves the operator's page, its video and its requests, in an asyncio loop in its own thread."""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict
from math import isfinite
from pathlib import Path
from socket import SO_SNDBUF, SOL_SOCKET
from struct import Struct
from typing import TYPE_CHECKING, Any

from aiohttp import WSMsgType, web
from msgspec import UNSET

from runner.configuration.layout import Layouts
from runner.core.events import Attention, Gear
from runner.core.model import Camera, plain
from runner.core.roles import MAY_REQUEST, PRESENCE, STOP_REQUESTED, Role
from runner.graph import video_codec
from runner.h264.access_unit import AccessUnit, RecentUnits
from runner.mqtt.messages import read_message
from runner.operator.station import LinkState, Listener, Station
from runner.page.access import Access
from runner.page.connections import Farewells, abort
from runner.page.counter import CounterReading, counter_reading
from runner.page.documents import Documents, document
from runner.page.front import Front
from runner.page.history import History
from runner.page.layouts import Answer, PageLayouts
from runner.page.loop import PageLoop
from runner.page.summaries import Summaries
from runner.page.viewer import PageViewer
from runner.page.views import PageViews
from runner.page.windows import Windows
from runner.records import to_json
from runner.records.lines import Note
from runner.records.operator import Sample
from runner.records.vehicle import Outcome, VehicleState, state_to_json
from runner.security.keyring import Keyring
from runner.settings import FROZEN_MS, Setup
from runner.system.ports import check_port_free

if TYPE_CHECKING:
    from runner.apply import SoundPacket

NOTES = 50  # kept for pages that open later
REPORTED = tuple(attention.value for attention in Attention if attention is not Attention.ABSENT)  # by pages
SPOKEN, MAX_SPOKEN_BYTES = Struct("<dd"), 4096  # s by a page's clock, and which clock; of a piece of voice: 40 ms
SEND_BUFFER_BYTES = 131_072  # small: a viewer that does not read is noticed here, not megabytes later
PING_S = 0.5
WRITE_BUFFER_BYTES = 65_536  # likewise, in front of it
UNRESPONSIVE_S = 2.0  # a viewer that has not answered a ping for this long is dropped, and reconnects if it is alive
WATCHER_UNRESPONSIVE_S = 10.0  # likewise of who may only watch, over any link: its pings wait behind its pictures
WATCHER_WINDOWS = 20  # that one such person may have open
WATCHER_MESSAGE_S, WATCHER_MESSAGE_BYTES = 0.02, 1024  # between two messages of such a viewer, and of each at most
CLOSE_TYPES = (WSMsgType.CLOSE, WSMsgType.CLOSING, WSMsgType.CLOSED, WSMsgType.ERROR)
MAX_MESSAGE_BYTES = 1_048_576  # a longer message closes the connection
MAY_ASK = (
    MAY_REQUEST[Role.SUPERVISOR] - PRESENCE
)  # what a page may request; its operator's role is checked by the vehicle


class PageServer(Listener):
    """The page and its viewers.

    The listener's callbacks and `show` may be called from any thread; everything else runs in the page's own.

    on_counter  called in the page's thread with each reading of the counter that a camera films; None: such messages
                are refused
    keyring     of the operator, to serve other machines over HTTPS if they have its token; None: loopback only
    layouts     of the operator; None: layouts cannot be saved
    socket      Unix socket, at which the program serves this page that starts one process for each of several vehicles;
                None: it is served to browsers
    on_voice    called in the page's thread with what its holder speaks, as `LiveOperator.speak`; None: dropped
    on_shown    called in the page's thread with the cameras that all windows show, and whether one of them is a page
    on_lacking  called in the page's thread, a few times a second, with the cameras of which a window has nothing to
                begin with before a key picture comes, which only a request brings
    raises      RunError if the port is in use or plotly is not installed
    """

    def __init__(
        self,
        setup: Setup,
        station: Station,
        on_counter: Callable[[CounterReading], None] | None = None,
        keyring: Keyring | None = None,
        layouts: Layouts | None = None,
        socket: Path | None = None,
        on_shown: Callable[[Collection[str], bool], None] = lambda cameras, is_open: None,
        on_voice: Callable[[bytes, float, float], None] | None = None,
        on_lacking: Callable[[Collection[str]], None] = lambda cameras: None,
    ) -> None:
        self._on_lacking = on_lacking
        self._setup, self._station, self._on_counter = setup, station, on_counter
        self._socket, self._on_voice = socket, on_voice
        self._vehicle = vehicle = setup.vehicle
        self._loop = PageLoop()
        self._call_soon = self._loop.call_soon
        self._front = Front(setup.page.endpoint, keyring, setup.page.people, station.note)
        names = list(vehicle.cameras)

        def state_attention(attention: Attention | None) -> None:
            station.attention = attention

        self._windows = Windows(
            state_attention,
            lambda shown, is_open: on_shown([names[index] for index in shown], is_open),
        )
        self._views = PageViews(list(vehicle.cameras.values()), self._windows, station.seen)
        self._layouts = layouts or Layouts()
        self._page_layouts = PageLayouts(
            vehicle, self._layouts, self._call_soon, lambda stated: self._windows.broadcast("layout", stated)
        )
        if socket is None:
            check_port_free(setup.page.endpoint, "page.port")
        self._documents = Documents()
        self._index = {name: number for number, name in enumerate(vehicle.cameras)}
        self._recent = [_recent(camera) for camera in vehicle.cameras.values()]
        self._history = History()
        self._notes: deque[Mapping[str, Any]] = deque(maxlen=NOTES)
        self._turn = asyncio.Lock()
        self._farewells = Farewells()

    @property
    def url(self) -> str:
        return self._front.url

    def start(self) -> None:
        self._loop.start(self._start())
        for note in self._layouts.notes(self._vehicle):
            self._station.note(note)

    def stop(self) -> None:
        self._loop.stop(self._end())

    def on_state(self, state: VehicleState | None) -> None:
        self._call_soon(self._windows.broadcast, "state", _stated(state, self._station))

    def on_sample(self, sample: Sample) -> None:
        self._call_soon(self._add_sample, sample)

    def on_steering(self, at: float, rad: float, gear: Gear | None = None) -> None:
        known = {} if gear is None else {"gear": gear}
        self._call_soon(self._windows.broadcast, "steering", {"at_ms": 1000 * at, "rad": rad, **known})

    def on_link(self, link: LinkState) -> None:
        self._call_soon(self._windows.broadcast, "link", link._asdict())

    def on_note(self, note: Note) -> None:
        self._call_soon(self._add_note, {"time": note.t, "text": note.text})

    def forget(self, cameras: Collection[str]) -> None:
        """These cameras are no longer received: a page that shows them later begins with newer pictures."""
        self._call_soon(self._forget, cameras)

    def show(self, camera: str, unit: AccessUnit) -> None:
        """A newly received access unit."""
        self._call_soon(self._show, camera, unit)

    def hear(self, packet: SoundPacket) -> None:
        """A newly received packet of the vehicle's sound."""
        self._call_soon(_hear, self._windows, packet, self._station)

    # --- in the page's thread -----------------------------------------------------------------------------------------

    async def _start(self) -> None:
        self._expiring = asyncio.create_task(self._views.expire())
        app = self._front.application(self._front.connections.grant_all if self._socket else None)
        app.router.add_get("/live", self._on_viewer)
        if self._socket:
            summaries = Summaries(self._station)
            app.router.add_get("/summary", summaries.serve)
            app.on_shutdown.append(summaries.close)
            return await self._front.connections.serve(app, self._socket)
        app.router.add_get("/", document("index.html"))
        app.router.add_get("/counter", document("counter.html"))
        self._documents.add_to(app, self._front.access)
        return await self._front.connections.serve(app, self._setup.page.endpoint)

    async def _end(self) -> None:
        self._farewells.say()
        await self._front.connections.close()

    def _add_sample(self, sample: Sample) -> None:
        self._history.add(sample)
        self._windows.broadcast("sample", {"time": sample.t, **to_json(sample)})
        self._on_lacking(_lacking(self._vehicle.cameras, self._windows, self._recent))

    def _add_note(self, note: Mapping[str, Any]) -> None:
        self._notes.append(note)
        self._windows.broadcast("note", note)

    def _forget(self, cameras: Collection[str]) -> None:
        for name in cameras:
            self._recent[self._index[name]] = _recent(self._vehicle.cameras[name])

    def _show(self, camera: str, unit: AccessUnit) -> None:
        index = self._index[camera]
        unit = self._recent[index].add(unit._replace(captured=self._station.latency.captured(camera, unit.captured)))
        for viewer in self._windows:
            viewer.show(index, unit)

    async def _on_viewer(self, request: web.Request) -> web.WebSocketResponse:
        token, browser = (request.query.get(key, "") for key in ("viewer", "browser"))
        if not 0 < len(token) <= 64 or len(browser) > 64:
            rule = "viewer: must be given, as text of at most 64 characters; browser: at most 64 characters"
            raise web.HTTPBadRequest(text=f"{rule}\n")
        visitor = self._front.access.visitor(request)
        if visitor is None:  # since it was checked
            raise web.HTTPUnauthorized(text="login required: see /login\n")
        if not visitor.may_drive and self._windows.count(visitor.name) >= WATCHER_WINDOWS:
            raise web.HTTPTooManyRequests(text=f"{visitor.name} has {WATCHER_WINDOWS} windows open\n")
        monitor = "show" in request.query
        shown = request.query.get("show", "").split(",")
        cameras = [index for name, index in self._index.items() if name in shown or not monitor]
        connection = request.transport.get_extra_info("socket") if request.transport else None
        if connection is not None:
            connection.setsockopt(SOL_SOCKET, SO_SNDBUF, SEND_BUFFER_BYTES)
        if isinstance(request.transport, asyncio.WriteTransport):
            request.transport.set_write_buffer_limits(WRITE_BUFFER_BYTES)
        most = MAX_MESSAGE_BYTES if visitor.may_drive else WATCHER_MESSAGE_BYTES
        ws = web.WebSocketResponse(compress=False, max_msg_size=most, autoping=False)
        try:
            await ws.prepare(request)
        except ValueError:  # headers that are not ASCII: the client's fault
            raise web.HTTPBadRequest(text="not a handshake of a WebSocket\n") from None
        viewer = PageViewer(token, cameras, lambda camera: self._recent[camera].burst(), browser, monitor, visitor)
        return await self._farewells.serve(ws, self._serve(ws, viewer, request))

    async def _serve(self, ws: web.WebSocketResponse, viewer: PageViewer, request: web.Request) -> None:
        self._windows.add(viewer)
        self._send_current_state(viewer)
        self._windows.opened(viewer, request.query.get("before"))
        turn = None if viewer.visitor.may_drive else self._turn
        tasks = [
            asyncio.create_task(_send(ws, viewer, turn)),
            asyncio.create_task(_ping(ws, request, self._front.access)),
        ]
        try:
            await self._listen(ws, viewer, request)
        except TimeoutError:
            abort(request.transport)
        finally:
            for task in tasks:
                task.cancel()
            self._views.forget(viewer)
            self._windows.closed(viewer)

    async def _listen(self, ws: web.WebSocketResponse, viewer: PageViewer, request: web.Request) -> None:
        """Handle a viewer's messages, as long as it has access, until it disconnects.

        raises  TimeoutError if it makes no progress: pings share the connection with the video and must be answered
        """
        may_drive = viewer.visitor.may_drive
        limit_s = UNRESPONSIVE_S if may_drive else WATCHER_UNRESPONSIVE_S
        while (message := await ws.receive(limit_s)).type not in CLOSE_TYPES:
            if message.type is WSMsgType.PING:
                await asyncio.wait_for(ws.pong(message.data), limit_s)
            elif message.type in (WSMsgType.TEXT, WSMsgType.BINARY) and self._front.access.visitor(request):
                if message.type is WSMsgType.TEXT:
                    self._on_message(viewer, message.data)
                elif self._on_voice and (spoken := _spoken(viewer, message.data, self._windows.holder_for(viewer))):
                    self._on_voice(*spoken)
                if not may_drive:
                    await asyncio.sleep(WATCHER_MESSAGE_S)

    def _send_current_state(self, viewer: PageViewer) -> None:
        introduction = _introduction(self._setup, viewer.cameras)
        who = {"name": viewer.visitor.name, "may_drive": viewer.visitor.may_drive}
        station = {"operator": self._station.identity, "answer_s": self._station.answer_s, "visitor": who}
        current = {"layout": self._page_layouts.stated(), "selected": viewer.selected or None}
        viewer.post("hello", introduction | station | current)
        viewer.post("link", self._station.link_state._asdict())
        viewer.post("state", _stated(self._station.state, self._station))
        viewer.post("history", self._history.columns())
        for note in self._notes:
            viewer.post("note", note)

    def _on_message(self, viewer: PageViewer, text: str) -> None:
        """Handle one message of a page. Even an invalid one is answered and disturbs nothing else."""
        try:
            document = read_message(text.encode())
        except ValueError as problem:
            viewer.post("reply", {"id": None, "result": "refused", "reason": str(problem)})
            return
        match document:
            case {"clock": int() | float() as page_ms}:
                viewer.post("clock", {"page_ms": page_ms, "server_ms": time.time() * 1000})
            case {"resync": str(name)} if name in self._index:
                viewer.restart(self._index[name])
            case {"select": str(name)} if name in self._index:
                self._windows.select(viewer, name)
            case {"attention": _} if not viewer.visitor.may_drive:
                pass  # it counts of drivers only
            case _ if not viewer.visitor.may_drive:
                reason = f"{viewer.visitor.name} may only watch"
                viewer.post("reply", {"id": document.get("id"), "result": "refused", "reason": reason})
            case {"counter": dict(found)} if self._on_counter and (reading := counter_reading(found)):
                self._on_counter(reading)
            case {"attention": str(word)} if word in REPORTED:
                viewer.attention, viewer.focused = Attention(word), document.get("focused") is True
                self._windows.state_control()
                self._views.state()
            case {"view": _}:
                self._views.take(viewer, document)
            case {"take_control": True}:
                self._windows.take_control(viewer, document.get("id"))
            case _:
                self._on_request(viewer, document)

    def _on_request(self, viewer: PageViewer, document: dict[str, Any]) -> None:
        request_id = document.pop("id", None)

        def answer(result: str, reason: str) -> None:
            viewer.post("reply", {"id": request_id, "result": result, "reason": reason})

        if problem := _refusal(self._windows.holder_for(viewer), request_id, document.get("event")):
            answer("refused", problem)
        elif kind := next((kind for kind in ("layout", "drive") if kind in document), None):
            self._page_layouts.save(kind, document, answer)
        else:
            self._send_request(document, answer)

    def _send_request(self, document: dict[str, Any], answer: Answer) -> None:
        """Send a request to the vehicle."""

        def on_reply(outcome: Outcome) -> None:
            self._call_soon(answer, outcome.result, outcome.reason)

        event = document.get("event")
        if event in MAY_ASK:
            self._station.ask(document, on_reply)
        else:
            answer("refused", f"event: {event!r}: must be one of {', '.join(sorted(MAY_ASK))}")


def _refusal(holder: str, request_id: object, event: object) -> str | None:
    """Why a viewer's request is refused; None: it is accepted.

    holder  of control, as that viewer sees it
    """
    if not isinstance(request_id, str) or not 0 < len(request_id) <= 64:
        return "id: must be given, as text of at most 64 characters"
    if event != STOP_REQUESTED and holder != "you":
        return "this page does not hold control; take it first"
    return None


def _spoken(viewer: PageViewer, piece: bytes, holder: str) -> tuple[bytes, float, float] | None:
    """A piece of what a page's microphone hears, as of `LiveOperator.speak`; None: not of who may speak.

    holder  of control, as that viewer sees it
    """
    samples = piece[SPOKEN.size :]
    is_meant = viewer.visitor.may_drive and not viewer.monitor and holder == "you"
    if not is_meant or not samples or len(samples) % 2 or len(piece) > MAX_SPOKEN_BYTES:
        return None
    at, clock = SPOKEN.unpack_from(piece)
    return (samples, at, clock) if isfinite(at) else None


def _stated(state: VehicleState | None, station: Station) -> dict[str, Any]:
    """The vehicle's state, and since when its holder is in control, its page is closed, and a stop was asked for.

    s since 1970
    """
    if state is None or state.driving is UNSET:
        return state_to_json(state)
    driving = state.driving
    since = station.own_time(driving.since) if driving.holder else None
    stop = None if driving.stop_since is None else station.own_time(driving.stop_since)
    changed = state.attention_since if state.attention is Attention.ABSENT else UNSET
    absent = None if changed is UNSET else station.own_time(changed)
    return {**state_to_json(state), "held_since": since, "stop_since": stop, "absent_since": absent}


def _hear(windows: Windows, packet: SoundPacket, station: Station) -> None:
    captured = None if packet.captured is None else station.latency.own_time(packet.captured)
    for viewer in windows:
        if not viewer.monitor:
            viewer.hear(packet.number, captured, packet.arrived, packet.data)


def _lacking(cameras: Mapping[str, Camera], windows: Windows, recent: Sequence[RecentUnits]) -> list[str]:
    """Cameras that send key pictures on request only, and of which a window has nothing to begin with."""
    asked = [(index, name) for index, name in enumerate(cameras) if cameras[name].graph.settings.may_have_no_waves]
    return [name for index, name in asked if any(w.waits(index) for w in windows) and not recent[index].burst()]


def _recent(camera: Camera) -> RecentUnits:
    graph = camera.graph
    interval = graph.settings.key_interval_s or graph.settings.shortest_wave_s
    keyed = graph.passes is not None or graph.settings.may_have_no_waves
    return RecentUnits(interval, video_codec(graph), keyed=keyed)


async def _send(ws: web.WebSocketResponse, viewer: PageViewer, turn: asyncio.Lock | None) -> None:
    """Send the queued messages, as fast as the viewer accepts them.

    turn  of those who only watch: each pass of the loop encrypts a message for one of them, and does the rest first
    """
    try:
        while True:
            message = await viewer.next()
            if turn:
                async with turn:
                    await asyncio.sleep(0)
            if isinstance(message, str):
                await ws.send_str(message)
            else:
                await ws.send_bytes(message)
    except ConnectionError:
        pass  # `_listen` ends the connection


async def _ping(ws: web.WebSocketResponse, request: web.Request, access: Access) -> None:
    """Ping a viewer at intervals, as long as it has access; `_listen` notices if it does not answer."""
    try:
        while access.visitor(request):
            await asyncio.sleep(PING_S)
            await ws.ping()
        await asyncio.wait_for(ws.close(message=b"log in again"), UNRESPONSIVE_S)
    except ConnectionError:
        pass  # `_listen` ends the connection
    except TimeoutError:
        abort(request.transport)


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
            "passed": camera.graph.passes is not None,
            "settable": camera.name in setup.vehicle.lowest,
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
    described = {"vehicle": setup.vehicle.name, "cameras": cameras, "dimensions": dimensions, "inputs": inputs}
    chosen = {"sound": setup.sound, "voice": setup.voice}
    return described | limits | {name: True for name, its in chosen.items() if its}


def _native(camera: Camera) -> dict[str, int]:
    """Size of the source's image, and where the full image begins in it, px."""
    width, height = camera.source_size
    return {"width": width, "height": height, "left": camera.in_source.x, "top": camera.in_source.y}
