"""The vehicle's RTSP server: one shared factory (`camera_media`) per camera, whose pipeline is built when watched.

The server library runs each client in its own thread, so that a waiting client does not delay the others. Its
callbacks run in any of these threads, and one lock guards all shared state.
"""

from __future__ import annotations

import resource
import secrets
import threading
import time
import weakref
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from enum import Enum, auto
from typing import TYPE_CHECKING

from gi.repository import GLib, GObject, Gst, GstRtsp, GstRtspServer

from runner.errors import RunError
from runner.graph import FEEDBACK, Plan, rtsp_url
from runner.gst.camera_media import CameraFactory, address_pool, describe_for, on_element, wants_feedback
from runner.gst.connections import RtspConnection
from runner.gst.lost import LostCameras
from runner.gst.memory import give_back
from runner.gst.pipeline import Build, CameraPipeline
from runner.gst.timers import every
from runner.gst.video_files import concerns_file
from runner.gst.viewers import admit, operator_of, over_uplink
from runner.settings import Media
from runner.system.ports import check_port_free, ip_address_of
from runner.system.reports import LimitedReports

if TYPE_CHECKING:
    from runner.gst.patient_media import PatientMedia
    from runner.gst.secure import ViewerCheck
    from runner.security.keyring import Keyring

OnReport = Callable[[str, str], None]  # camera, what happened to it

OPEN_S = 0.9  # a request for a camera that delivers nothing within this is answered 503; the camera continues to open
OPENING_S = 0.02  # between two looks whether an IP camera has answered
SLOW_S = 3.0  # a camera that has delivered nothing this long after a viewer's request counts as lost until it does
HELD_S = 5.0  # how long an open camera then waits for the next request
CLOSE_S = 2.0  # how long connections may take to end when the server stops
TEARDOWN_S = 5.0  # how long a camera that is reopened waits for the end of its previous pipeline
BACKLOG = 128  # connections waiting to be accepted; with the library's 5, further viewers would retry after 1 s
MAX_BODY_BYTES = 65_536  # of a request; the library's limit is 4 GB ...
MAX_REQUEST_BYTES = 1_048_576  # ... and it has none for the number of headers
# TLS handshakes wait in a pool of ten threads, to which GLib adds slowly. A client without a request is dropped after
# FIRST_REQUEST_S, or after CROWDED_S if there are more than CROWD of them.
FIRST_REQUEST_S, CROWD, CROWDED_S = 5.0, 8, 1.0
# A connection and its thread take three descriptors, and some more until it has ended. Beyond this many connections the
# oldest one that watches nothing is dropped, whatever it requests: a viewer watches within a second.
DESCRIPTORS, RESERVED, LEAST, MOST = 5, 256, 16, 1000
LAG_S = 1.0  # a TCP viewer that lags by more is disconnected
WATCH_MS = 200
BLOCKED_S = 0.4  # a camera that should send but does not for this long and three frame intervals is blocked
LEFT_S = 10.0  # how long a camera is monitored after a viewer has left
SESSIONS_EVERY_S = 1.0
GIVE_BACK_S = 10.0  # interval at which memory of ended pipelines and of replaced encoders is returned to the system
METHODS = ("options", "describe", "setup", "play", "pause", "get-parameter", "set-parameter", "teardown")
OK, FORBIDDEN, REFUSED, UNAVAILABLE, MOVED, NOT_NOW = (
    GstRtsp.RTSPStatusCode.OK,
    GstRtsp.RTSPStatusCode.FORBIDDEN,
    GstRtsp.RTSPStatusCode.NOT_ENOUGH_BANDWIDTH,
    GstRtsp.RTSPStatusCode.SERVICE_UNAVAILABLE,
    GstRtsp.RTSPStatusCode.MOVED_PERMANENTLY,
    GstRtsp.RTSPStatusCode.METHOD_NOT_VALID_IN_THIS_STATE,
)

# Default reasons for refusing a client that has not authenticated.
NO_CERTIFICATE, NO_PASSWORD, WRONG_PASSWORD = (
    "it has not completed a TLS handshake with a certificate",
    "it has given no password",
    "its password is wrong",
)

MEDIA_ERROR = "handle-message::error"  # signal of a media

# From 1.24 on a factory returns its media locked. The same change of the library added this method.
CONSTRUCTS_LOCKED = hasattr(GstRtspServer.RTSPMedia, "can_be_shared")


class _Stage(Enum):
    """State of a camera's pipeline."""

    NONE = auto()
    BUILT = auto()  # has delivered nothing yet
    OPEN = auto()
    ENDING = auto()


class _Opening:
    """An attempt to open a camera, in a separate thread.

    held     set when a client holds the opened camera
    problem  the first error of its pipeline
    """

    def __init__(self) -> None:
        self.since, self.problem = time.monotonic(), ""
        self.held = threading.Event()
        self.over = self.failed = False


class _Camera:
    """One mount point and its pipeline, if built."""

    def __init__(self, plan: Plan, factory: CameraFactory, url: str) -> None:
        self.plan, self.factory = plan, factory
        self.name = plan.camera.name
        self.url = GstRtsp.RTSPUrl.parse(url)[1]
        self.media: GstRtspServer.RTSPMedia | None = None
        self.stage = _Stage.NONE
        self.prepared = False  # the library has received data from it
        self.bus: Gst.Bus | None = None
        self.opening: _Opening | None = None

    @property
    def is_open(self) -> bool:
        return self.stage is _Stage.OPEN


class CameraServer:
    """RTSP server with one mount point per camera, and a second one with feedback, which our own receivers use.

    build      makes a `CameraPipeline` from each new pipeline
    lost       cameras that do not open: each is opened again when that is due
    on_report  called when pipelines start and stop, and when viewers are disconnected
    keyring    of this vehicle; None: anyone may watch, and nothing is encrypted
    refusal    returns why a camera must not be opened now; None: it may

    `controller` is the operator in control, "" for none: see `runner.gst.viewers`.
    """

    def __init__(
        self,
        plans: Sequence[Plan],
        media: Media,
        build: Build,
        lost: LostCameras,
        on_report: OnReport,
        keyring: Keyring | None = None,
        refusal: Callable[[str], str | None] = lambda _: None,
    ) -> None:
        check_port_free(media)
        self._viewers: ViewerCheck | None = None
        self._keys_fault = ""  # the last one reported
        if keyring:
            from runner.gst.secure import ViewerCheck

            self._viewers = ViewerCheck(keyring, lambda what: on_report("keys", what), self._on_refused)
        self._report_refusal = LimitedReports(lambda what: on_report("keys", what))
        self._media, self._build, self._lost, self._on_report = media, build, lost, on_report
        self.controller, self._refusal = "", refusal
        self.pipelines: dict[str, CameraPipeline] = {}
        self._changed = threading.Condition()  # a camera's stage; also guards the state shared by clients' threads
        self._connections: dict[GstRtspServer.RTSPClient, RtspConnection] = {}
        self._most = min(MOST, max(LEAST, (resource.getrlimit(resource.RLIMIT_NOFILE)[0] - RESERVED) // DESCRIPTORS))
        self._holds: list[tuple[float, GstRtspServer.RTSPClient, GstRtspServer.RTSPMedia]] = []
        self._left: dict[str, float] = {}  # cameras that a viewer has left, and until when they are monitored
        self._progress: dict[str, tuple[int, float]] = {}  # by such a camera, frame count and when it last changed
        self._stopped = threading.Event()
        self._server = GstRtspServer.RTSPServer()
        self._server.set_address(ip_address_of(media.host))  # of a name with several, IPv4
        self._server.set_service(str(media.port))
        self._server.set_backlog(BACKLOG)
        self._server.set_content_length_limit(MAX_BODY_BYTES)
        self._threads = GstRtspServer.RTSPThreadPool()
        self._threads.set_max_threads(-1)  # one per client
        self._server.set_thread_pool(self._threads)
        if self._viewers:
            self._server.set_auth(self._viewers.auth)
        self._server.connect("client-connected", self._on_connected)
        self._server.set_session_pool(SessionPool())
        self._server.get_session_pool().connect("session-removed", _on_session_removed)
        self._addresses = address_pool(media)
        self._cameras = {plan.camera.name: self._camera(plan) for plan in plans}
        for name, camera in self._cameras.items():
            for path in (name, f"{name}/{FEEDBACK}"):
                self._server.get_mount_points().add_factory(f"/{path}", camera.factory)
        self._attached = self._server.attach(None)
        if not self._attached:
            raise RunError(f"the RTSP server cannot listen on {media}; choose another media.port")
        watches = (self._watch_connections, *((self._watch_keys,) if self._viewers else ()))
        self._watches = [every(WATCH_MS, watch, lambda what: on_report("viewers", what)) for watch in watches]
        threading.Thread(target=self._expire_sessions, name="rtsp-sessions", daemon=True).start()

    def stop(self) -> None:
        """Accept no more clients, and end every connection in its own thread.

        `client_filter` would close them from this thread. During a request, the library (1.22) then reads forever from
        a stream that no longer exists.
        """
        self._stopped.set()
        for source in (*self._watches, self._attached):
            GLib.source_remove(source)
        with self._changed:
            for connection in self._connections.values():
                connection.close()
            self._changed.notify_all()
            self._changed.wait_for(lambda: not self._connections, CLOSE_S)

    # --- cameras ------------------------------------------------------------------------------------------------------

    def _camera(self, plan: Plan) -> _Camera:
        factory = CameraFactory(plan, self._addresses, self._viewers and self._viewers.permissions)
        camera = _Camera(plan, factory, rtsp_url(self._media, plan.camera.name))
        camera.factory.connect("media-configure", self._on_configure, camera)
        return camera

    def _on_configure(self, _factory: object, media: GstRtspServer.RTSPMedia, camera: _Camera) -> None:
        element = media.get_element()
        pipeline = element.get_parent()
        bus = pipeline.get_bus()
        bus.enable_sync_message_emission()  # the library watches the bus itself and reports nothing
        bus.connect("sync-message::error", self._on_error, camera)
        built = self._build(element, camera.plan)
        pipeline.connect("deep-element-added", on_element, weakref.ref(built))
        with self._changed:
            camera.media, camera.bus, camera.stage, camera.prepared = media, bus, _Stage.BUILT, False
            self.pipelines[camera.name] = built
        built.catch_up()
        media.connect(MEDIA_ERROR, _on_media_error, camera)
        media.connect("prepared", self._on_prepared, camera)
        media.connect("target-state", self._on_target_state, camera)
        # After the factory's own handler, which drops the media: only then is another one built.
        media.connect_after("unprepared", self._on_unprepared, camera, built)
        self._on_report(camera.name, "pipeline built")

    def _on_prepared(self, media: GstRtspServer.RTSPMedia, camera: _Camera) -> None:
        with self._changed:
            if camera.media is media:
                camera.prepared = True
                if camera.stage is _Stage.BUILT:  # it has not failed in the meantime
                    camera.stage = _Stage.OPEN
                    self._lost.open(camera.name)
                self._changed.notify_all()

    def _on_target_state(self, media: GstRtspServer.RTSPMedia, state: int, camera: _Camera) -> None:
        with self._changed:
            if camera.media is media and state == Gst.State.NULL:
                camera.stage = _Stage.ENDING
                self._changed.notify_all()

    def _on_unprepared(self, media: GstRtspServer.RTSPMedia, camera: _Camera, pipeline: CameraPipeline) -> None:
        with self._changed:
            if camera.media is media:
                camera.media = camera.bus = None
            if self.pipelines.get(camera.name) is pipeline:
                del self.pipelines[camera.name]
                camera.stage = _Stage.NONE
                self._changed.notify_all()
        self._on_report(camera.name, "pipeline stopped")

    def _on_error(self, bus: Gst.Bus, message: Gst.Message, camera: _Camera) -> None:
        if concerns_file(message):
            return  # only the file ends, not the stream
        with self._changed:
            if camera.bus is not bus or camera.stage is _Stage.ENDING:
                return  # elements fail while the pipeline is being stopped, and after the one that has failed first
            camera.stage = _Stage.ENDING
            if camera.opening and not camera.opening.problem:
                camera.opening.problem = message.parse_error()[0].message
            affected = [c for c in self._connections.values() if camera.name in (c.described, *c.cameras)]
        self._on_report(camera.name, message.parse_error()[0].message)
        # The library ends the pipeline when the last of them has left; until then no new viewer is admitted.
        for connection in affected:
            connection.close()

    def _hold(self, client: GstRtspServer.RTSPClient, camera: _Camera) -> bool:
        """Keep a camera open for a client until its DESCRIBE is answered; False if it delivers nothing within OPEN_S.

        The library would open it in the client's thread and answer only after 20 s. Here it is opened in a separate
        thread, so that a camera that is slow to start is open when the client retries.
        """
        if not camera.is_open and self._is_waiting(camera):
            self._note_slow(camera)
            return False
        deadline = time.monotonic() + OPEN_S
        while True:
            with self._changed:
                if not camera.is_open and camera.opening is None:
                    camera.opening = _Opening()
                    threading.Thread(target=self._open, args=(camera, camera.opening), daemon=True).start()
                opening = camera.opening
                left = max(0.0, deadline - time.monotonic())
                self._changed.wait_for(lambda o=opening: self._is_settled(camera, o), left)  # type: ignore[misc]
                media = camera.media if camera.is_open else None
            if media is not None and media.prepare(None):
                with self._changed:
                    self._holds.append((time.monotonic(), client, media))
                if opening:
                    opening.held.set()
                return True
            self._note_slow(camera)
            if (opening and opening.failed) or self._stopped.is_set() or time.monotonic() >= deadline:
                return False
            # Otherwise its last viewer has just left, and it is ending.

    def _is_waiting(self, camera: _Camera) -> bool:
        """Whether it is known that a camera cannot be opened within OPEN_S."""
        pipeline = self.pipelines.get(camera.name)
        waited = self._refusal(camera.name) is not None or (pipeline is not None and pipeline.has_waited(OPEN_S))
        return waited or not (camera.opening or self._lost.may_open(camera.name))

    def _note_slow(self, camera: _Camera) -> None:
        """Let the other cameras have the share of one that takes long to open."""
        with self._changed:  # it may be opening just now
            opening = None if camera.is_open else camera.opening
            if opening and not opening.over and time.monotonic() - opening.since > SLOW_S:
                self._lost.delay(camera.name, f"it has delivered nothing for {SLOW_S:g} s")

    def _is_settled(self, camera: _Camera, opening: _Opening | None) -> bool:
        """Whether waiting for a camera to open is over."""
        return camera.is_open or opening is None or opening.over or self._stopped.is_set()

    def _release(self, wanted: Callable[[float, GstRtspServer.RTSPClient], bool]) -> None:
        """Release the holds that `wanted` selects by their start and client."""
        with self._changed:
            released = [media for since, client, media in self._holds if wanted(since, client)]
            self._holds = [hold for hold in self._holds if not wanted(*hold[:2])]
        for media in released:
            media.unprepare()

    def _open(self, camera: _Camera, opening: _Opening) -> None:
        """Build a camera's pipeline, wait until it delivers, and keep it until a client holds it."""
        try:
            with self._changed:
                self._changed.wait_for(lambda: camera.stage is not _Stage.ENDING, TEARDOWN_S)
            thread = self._threads.get_thread(GstRtspServer.RTSPThreadType.MEDIA, GstRtspServer.RTSPContext())
            media = camera.factory.construct(camera.url)
            if media is not None and CONSTRUCTS_LOCKED:
                media.unlock()
            opening.failed = media is None or not self._prepare(media, thread, camera)
            if opening.failed:
                self._lost.fail(camera.name, opening.problem or "it delivers nothing")
            if media is not None and not opening.failed:
                if camera.is_open:
                    opening.held.wait(HELD_S)
                media.unprepare()
        finally:
            with self._changed:
                opening.over, camera.opening = True, None
                self._changed.notify_all()

    def _prepare(self, media: PatientMedia, thread: GstRtspServer.RTSPThread, camera: _Camera) -> bool:
        """Start a new pipeline and wait until it delivers."""
        pipeline = self.pipelines.get(camera.name)

        def wait() -> bool:
            while pipeline and pipeline.is_opening and camera.stage is _Stage.BUILT:
                if self._stopped.wait(OPENING_S):
                    return False
            return True

        opened = media.open(thread, wait)
        if opened:
            self._on_prepared(media, camera)
        return opened

    # --- clients ------------------------------------------------------------------------------------------------------

    def _on_connected(self, _server: object, client: GstRtspServer.RTSPClient) -> None:
        with suppress(OSError):  # it has already disconnected, or no descriptor is left: SETUP will be refused
            self._add(client, RtspConnection(client, self._media.session_timeout_s))
        client.connect("closed", self._on_closed)
        client.connect("new-session", self._on_session)
        for method in METHODS:
            client.connect(f"{method}-request", self._on_answered)
        client.connect("pre-describe-request", self._on_describe)
        client.connect("describe-request", self._on_described)
        client.connect("pre-setup-request", self._on_setup)
        client.connect("setup-request", self._on_set_up)
        client.connect("play-request", self._on_playing)
        client.connect("teardown-request", self._on_teardown)

    def _add(self, client: GstRtspServer.RTSPClient, connection: RtspConnection) -> None:
        if self._viewers:
            connection.refusal = NO_CERTIFICATE
        with self._changed:
            others = list(self._connections.items())
            self._connections[client] = connection
            if self._stopped.is_set():
                connection.close()
        if len(others) >= self._most:  # now: the library aborts the process without descriptors
            idle = [other for each, other in others if not (other.closed or _watches(each, other))]
            min(idle, key=lambda other: (other.opening, other.viewer.since), default=connection).close()

    def _on_closed(self, client: GstRtspServer.RTSPClient) -> None:
        with self._changed:
            connection = self._connections.pop(client, None)
            if connection:
                self._note_left(connection.cameras)
                connection.release()
                self._changed.notify_all()
        if connection and connection.refusal:
            address = connection.viewer.address
            self._report_refusal(f"refused an RTSP client at {address}: {connection.refusal}", address)

    def _on_refused(self, peer: tuple[str, int], why: str) -> None:
        """A client's certificate is not accepted: its connection ends."""
        with self._changed:
            for connection in self._connections.values():
                if connection.peer == peer:
                    connection.refusal = why

    def _on_session(self, _client: object, session: GstRtspServer.RTSPSession) -> None:
        session.set_timeout(self._media.session_timeout_s)

    def _on_answered(self, client: GstRtspServer.RTSPClient, _context: object) -> None:
        connection = self._connection(client)
        if connection:
            if self._viewers:
                connection.read_certificate(client)
            connection.note_request()
            if connection.refusal == NO_CERTIFICATE:
                connection.refusal = NO_PASSWORD

    def _on_describe(
        self, client: GstRtspServer.RTSPClient, context: GstRtspServer.RTSPContext
    ) -> GstRtsp.RTSPStatusCode:
        name, _, kind = _path(context).partition("/")
        camera, connection = self._cameras.get(name) if kind in ("", FEEDBACK) else None, self._connection(client)
        if connection and self._viewers:
            connection.read_certificate(client)
        withdrawn = self._viewers.withdrawn(connection and connection.certificate) if self._viewers else None
        if connection:
            connection.note_request()
            connection.refusal = withdrawn or ""
        if withdrawn:
            return FORBIDDEN
        if camera is None:
            return OK  # the library answers 404
        if _has_query(context):
            self._redirect(client, context)
            return MOVED
        if connection:
            connection.opening = True
        is_held = self._hold(client, camera)
        if connection:
            connection.opening = False
        if not is_held:
            return UNAVAILABLE
        if connection:
            connection.described = camera.name
            if self._viewers:  # until the library has accepted its password
                connection.refusal = WRONG_PASSWORD if _has_password(context) else NO_PASSWORD
        describe_for(_path(context))
        return OK

    def _redirect(self, client: GstRtspServer.RTSPClient, context: GstRtspServer.RTSPContext) -> None:
        """Answer with the correct URL: with a query the library would find the camera here, but not in PLAY."""
        uri = context.uri
        _, message = GstRtsp.rtsp_message_new_response(MOVED, GstRtsp.rtsp_status_as_text(MOVED), context.request)
        own = rtsp_url(replace(self._media, host=uri.host, port=uri.port), _path(context))
        message.add_header(GstRtsp.RTSPHeaderField.LOCATION, own)
        message.add_header(GstRtsp.RTSPHeaderField.CONNECTION, "close")
        client.send_message(None, message)
        connection = self._connection(client)
        if connection:
            connection.close()  # the library would also answer, without a Location

    def _on_described(self, client: GstRtspServer.RTSPClient, _context: object) -> None:
        connection = self._connection(client)
        if connection:
            connection.refusal = ""
        self._release(lambda _, holder: holder is client)

    def _on_setup(self, client: GstRtspServer.RTSPClient, context: GstRtspServer.RTSPContext) -> GstRtsp.RTSPStatusCode:
        """Admit a viewer, or refuse it for its keys, or because its copy of the stream would overload the uplink."""
        camera = next((c for c in self._cameras.values() if c.media is context.media), None)
        connection = self._connection(client)
        if self._viewers and connection:
            connection.read_certificate(client)
            if refusal := self._viewers.refusal(connection.certificate, context.token):
                connection.refusal = refusal
                return FORBIDDEN
        if not _end_other(client, context):
            return NOT_NOW
        # The library ends a media whose UDP it refuses, but its client then asks for TCP.
        if camera and camera.is_open and _wants_udp(context) and context.media.prepare(None):
            with self._changed:
                self._holds.append((time.monotonic(), client, context.media))
        with self._changed:
            new_viewer = self._connections.get(client)
            if camera is None or new_viewer is None or not camera.is_open:
                return UNAVAILABLE
            operator = (
                self._viewers.viewer(new_viewer.certificate) if self._viewers else operator_of(_user_agent(context))
            )
            new_viewer.identify(operator)
            current = [c for c in self._connections.values() if camera.name in c.cameras]
            viewers = [c.viewer for c in current]
            is_admitted = new_viewer in current
            leaving = [] if is_admitted else admit(viewers, new_viewer.viewer, self._media.max_viewers, self.controller)
            if leaving is None:
                return REFUSED
            new_viewer.cameras.setdefault(camera.name, None)
            if _wants_udp(context):
                new_viewer.refused_udp.add(camera.name)  # until it is set up
        for connection in current:
            if connection.viewer in leaving:
                self._close(connection, f"the operator in control watches from {new_viewer.viewer.address}")
        return OK

    def _on_set_up(self, client: GstRtspServer.RTSPClient, context: GstRtspServer.RTSPContext) -> None:
        connection = self._connection(client)
        self._release(lambda _, holder: holder is client)
        if connection is None:
            return
        name = _camera_name(context)
        connection.cameras[name] = context.trans
        if context.trans.get_transport().lower_transport & GstRtsp.RTSPLowerTrans.TCP:
            connection.carry_video(self._cameras[name].plan.camera.graph.settings.dscp)
            if name in connection.refused_udp:
                first, last = self._media.rtp_ports
                is_ipv4_at_ipv6 = "." in connection.viewer.address and ":" in ip_address_of(self._media.host)
                fault = "IPv6 only" if is_ipv4_at_ipv6 else "in use"
                self._on_report(name, f"over TCP, UDP ports {first}-{last} are {fault}")
        connection.refused_udp.discard(name)

    def _on_playing(self, client: GstRtspServer.RTSPClient, context: GstRtspServer.RTSPContext) -> None:
        name = _camera_name(context)
        self._wake({name})
        # Players without feedback cannot request a key frame, and show nothing before they have seen a whole wave.
        pipeline, joins = self.pipelines.get(name), len(self._watching(name)) > 1
        if joins and pipeline and not wants_feedback(_path(context)) and pipeline.requests.grant_key_unit():
            pipeline.send_key_frame()

    def _wake(self, cameras: Iterable[str]) -> None:
        """Make the library recheck which interleaved viewers are ready.

        It stops a camera's interleaved stream while none is ready, and rechecks when one of them has accepted data, but
        not when the viewer that it waits for leaves or a ready one joins.
        """
        for name in cameras:
            for connection in self._watching(name):
                transport = connection.cameras.get(name)  # None if its client's thread has meanwhile torn it down
                if transport:
                    transport.message_sent()

    def _unblock(self, name: str, now: float) -> None:
        """Unblock a camera whose last interleaved viewer has left: its next packet still waits and blocks all others.

        Only while nothing is sent: a packet that the library is about to send must not be dropped.
        """
        pipeline, watching = self.pipelines.get(name), self._watching(name)
        if not pipeline or not watching or any(connection.interleaved for connection in watching):
            self._progress.pop(name, None)
            return
        frames, since = pipeline.counters()[0], now
        if self._progress.get(name, (-1, now))[0] == frames and not (pipeline.paused or pipeline.source_fault):
            since = self._progress[name][1]
        if now - since > BLOCKED_S + 3 * pipeline.frame_s:
            pipeline.drop_queued_packet()
            since = now
        self._progress[name] = (frames, since)

    def _on_teardown(self, client: GstRtspServer.RTSPClient, context: GstRtspServer.RTSPContext) -> None:
        connection = self._connection(client)
        if connection:
            is_held = _is_held(client, context.sessmedia)  # the session that ended may be another connection's
            with self._changed:
                if not is_held:
                    connection.cameras.pop(_camera_name(context), None)
                self._note_left((_camera_name(context),))

    def _note_left(self, cameras: Iterable[str]) -> None:
        self._left |= dict.fromkeys(cameras, time.monotonic() + LEFT_S)

    def _connection(self, client: GstRtspServer.RTSPClient) -> RtspConnection | None:
        with self._changed:
            return self._connections.get(client)

    def _watching(self, camera: str) -> list[RtspConnection]:
        with self._changed:
            return [connection for connection in self._connections.values() if camera in connection.cameras]

    def copies(self) -> dict[str, int]:
        """By camera, the number of viewers outside the vehicle; cameras without any are omitted. From any thread."""
        with self._changed:
            watched = [c.cameras for c in self._connections.values() if over_uplink(c.viewer.address)]
            return dict(Counter(name for cameras in watched for name in tuple(cameras)))

    def _close(self, connection: RtspConnection, why: str) -> None:
        for camera in sorted(connection.cameras):
            self._on_report(camera, f"disconnected the viewer at {connection}: {why}")
        connection.close()

    def _watch_connections(self) -> None:
        """Close readers that lag, and connections without a complete request or with one that does not end."""
        with self._changed:
            connections = list(self._connections.items())
            lags = {connection: self._lag(connection) for _, connection in connections if connection.interleaved}
            endless = {each for _, each in connections if each.unanswered_bytes() > MAX_REQUEST_BYTES}
            now = time.monotonic()
            self._left = {name: until for name, until in self._left.items() if now < until}
            left = tuple(self._left)
        self._wake(left)
        for name in left:
            self._unblock(name, now)
        for name, pipeline in tuple(self.pipelines.items()):
            viewers = [each for each in self._watching(name) if over_uplink(each.viewer.address)]
            pipeline.requests.viewers = sum(not each.interleaved for each in viewers)
        if self._viewers:
            self._drop_silent([connection for _, connection in connections], now)
        for client, connection in connections:
            if lags.get(connection, 0) > LAG_S:
                self._close(connection, f"it lags by more than {LAG_S:g} s")
            elif connection in endless:
                self._close(connection, f"it sends a request of more than {MAX_REQUEST_BYTES} bytes")
            elif now - connection.last_request > self._media.session_timeout_s and not client.session_filter(None):
                connection.close()

    def _watch_keys(self) -> None:
        """Load new key files, which may arrive one by one, and close connections of holders that may no longer watch.

        Apart from the other checks, so that no fault of theirs lets a revoked holder go on watching.
        """
        assert self._viewers
        self._refresh_keys(self._viewers)
        with self._changed:
            connections = list(self._connections.values())
        for connection in connections:
            # Before a first request it may be in the handshake, where no certificate has been verified.
            if not connection.unused_s(time.monotonic()) and (why := self._viewers.withdrawn(connection.certificate)):
                connection.refusal = "" if connection.cameras else why  # `_close` reports a viewer
                self._close(connection, why)

    def _drop_silent(self, connections: Iterable[RtspConnection], now: float) -> None:
        """Close those whose client makes no request, to free threads for other handshakes."""
        silent = [each for connection in connections if (each := (connection.unused_s(now), connection))[0] > 0]
        for idle_s, connection in silent:
            if idle_s > (CROWDED_S if len(silent) > CROWD else FIRST_REQUEST_S):
                connection.close()

    def _refresh_keys(self, viewers: ViewerCheck) -> None:
        try:
            viewers.refresh()
        except RunError as error:
            if self._keys_fault != str(error):
                self._on_report("keys", str(error))
            self._keys_fault = str(error)

    def _lag(self, connection: RtspConnection) -> float:
        others = (other for other in self._connections.values() if other is not connection)
        shared = any(other.cameras.keys() & connection.cameras.keys() for other in others)
        pipelines = [pipeline for name in connection.cameras if (pipeline := self.pipelines.get(name))]
        return connection.lag(sum(pipeline.kbps for pipeline in pipelines), shared)

    def _expire_sessions(self) -> None:
        """End sessions whose viewer no longer sends requests or RTCP.

        In a separate thread, since the end of the last session tears the pipeline down.
        """
        pool, given_back = self._server.get_session_pool(), time.monotonic()
        while not self._stopped.wait(SESSIONS_EVERY_S):
            if time.monotonic() - given_back > GIVE_BACK_S:
                give_back()
                given_back = time.monotonic()
            self._keep_paused_sessions()
            pool.cleanup()
            # A DESCRIBE that is refused later does not release its hold.
            old = time.monotonic() - OPEN_S
            self._release(lambda since, _, old=old: since < old)  # type: ignore[misc]

    def _keep_paused_sessions(self) -> None:
        """Keep sessions from expiring on a camera that is paused, or whose source is being replaced.

        Nothing is sent then, and players such as ffmpeg send nothing in return. TCP detects viewers that have left.
        """
        with self._changed:
            watching = [(client, list(connection.cameras)) for client, connection in self._connections.items()]
        for client, cameras in watching:
            if cameras and all(map(self._is_silent, cameras)):
                for session in client.session_filter(None):
                    session.touch()

    def _is_silent(self, camera: str) -> bool:
        pipeline = self.pipelines.get(camera)
        return pipeline is not None and (pipeline.paused or bool(pipeline.source_fault))


def _on_media_error(media: GstRtspServer.RTSPMedia, message: Gst.Message, camera: _Camera) -> bool:
    """Let the library see only errors of a stream that is being opened, which then fails.

    For a later error, it (1.22) would leave the viewers' transports and the stream's elements behind, and end a second
    time what has ended meanwhile.
    """
    if camera.media is not media or camera.prepared or concerns_file(message):
        GObject.signal_stop_emission_by_name(media, MEDIA_ERROR)
    return True


def _watches(client: GstRtspServer.RTSPClient, connection: RtspConnection) -> bool:
    """Whether a connection holds a camera or a session."""
    return bool(connection.cameras or client.session_filter(None))


def _end_other(client: GstRtspServer.RTSPClient, context: GstRtspServer.RTSPContext) -> bool:
    """End what a connection has set up of the requested camera elsewhere; False if it is being sent a copy.

    Elsewhere is in another session, or in the same one by the camera's other path.

    The library would not end that copy: it would go on after the viewer has left, and nobody would count it. A camera
    that is not being sent may be set up again: ffmpeg does so in a new session when it pauses UDP to try TCP.
    """
    held = [(session, media) for session, media in _set_up(client) if media.get_media() is context.media]
    own = context.session and context.session.get_media(context.uri.abspath)[0]
    sent = context.stream.transport_filter(None)
    if any(transport in sent for _, media in held for transport in _transports(media)):
        return False
    for session, media in held:
        if session is not context.session or media is not own:
            _end(session, media)
    return True


def _is_held(client: GstRtspServer.RTSPClient, ended: GstRtspServer.RTSPSessionMedia) -> bool:
    """Whether a connection has set up the same camera as what has just ended, in a session of its own."""
    return any(media is not ended and media.get_media() is ended.get_media() for _, media in _set_up(client))


def _set_up(client: GstRtspServer.RTSPClient) -> list[tuple[GstRtspServer.RTSPSession, GstRtspServer.RTSPSessionMedia]]:
    """What a connection has set up, with the session of each."""
    return [(session, media) for session in client.session_filter(None) for media in session.filter(None)]


def _transports(media: GstRtspServer.RTSPSessionMedia) -> list[GstRtspServer.RTSPStreamTransport]:
    each = (media.get_transport(number) for number in range(media.get_media().n_streams()))
    return [transport for transport in each if transport is not None]


def _end(session: GstRtspServer.RTSPSession, media: GstRtspServer.RTSPSessionMedia) -> None:
    """End what a session has set up, as TEARDOWN does."""
    media.set_state(Gst.State.NULL)
    session.release_media(media)


class SessionPool(GstRtspServer.RTSPSessionPool):  # type: ignore[misc]  # PyGObject has no types
    """Sessions with identifiers from the system's generator.

    Whoever knows an identifier can end or pause that session, from any connection. The library's identifiers come from
    GLib's generator, of which the digest nonces reveal the state.
    """

    def do_create_session_id(self) -> str:
        return secrets.token_hex(16)


def _on_session_removed(_pool: object, session: GstRtspServer.RTSPSession) -> None:
    """A session ends its media only in its finalizer, and the library (1.22) leaks one when it refuses a SETUP."""
    for media in session.filter(None):
        _end(session, media)


def _camera_name(context: GstRtspServer.RTSPContext) -> str:
    """First component of the path of a request's URL: the camera, if valid; `FEEDBACK` and a stream may follow it."""
    return _path(context).partition("/")[0]


def _path(context: GstRtspServer.RTSPContext) -> str:
    """The path of a request's URL without leading and trailing slashes; "" if path or host is not text."""
    try:
        return str(context.uri.abspath).strip("/") if isinstance(context.uri.host, str) else ""
    except UnicodeDecodeError:
        return ""


def _has_query(context: GstRtspServer.RTSPContext) -> bool:
    try:
        return context.uri.query is not None
    except UnicodeDecodeError:
        return True


def _has_password(context: GstRtspServer.RTSPContext) -> bool:
    """Whether a request gives a password, right or wrong."""
    try:
        return bool(context.request.get_header(GstRtsp.RTSPHeaderField.AUTHORIZATION, 0)[0] == GstRtsp.RTSPResult.OK)
    except UnicodeDecodeError:
        return True


def _wants_udp(context: GstRtspServer.RTSPContext) -> bool:
    """Whether a SETUP requests packets over UDP, to this client alone."""
    try:
        wanted = context.request.get_header(GstRtsp.RTSPHeaderField.TRANSPORT, 0)[1] or ""
    except UnicodeDecodeError:
        return False
    return "client_port" in wanted


def _user_agent(context: GstRtspServer.RTSPContext) -> str | None:
    try:
        agent: str | None = context.request.get_header(GstRtsp.RTSPHeaderField.USER_AGENT, 0)[1]
    except UnicodeDecodeError:
        return None
    return agent
