"""Opens the RTSP server's cameras when they are watched: their pipelines, from the first request to the end.

The server library calls back in any of its threads.
"""

from __future__ import annotations

import threading
import time
import weakref
from collections.abc import Callable, Sequence
from enum import Enum, auto
from typing import TYPE_CHECKING

from gi.repository import GObject, Gst, GstRtsp, GstRtspServer

from runner.graph import Plan, rtsp_url
from runner.gst.camera_media import CameraFactory, address_pool, on_element
from runner.gst.clients import Clients
from runner.gst.pipeline import CameraPipeline, Openings
from runner.gst.video_files import concerns_file
from runner.settings import Media

if TYPE_CHECKING:
    from runner.gst.patient_media import PatientMedia
    from runner.gst.sound_pipeline import SoundPipeline
    from runner.gst.uplinks import CameraUplinks
    from runner.sound import SoundPlan

OPEN_S = 0.9  # a request for a camera that delivers nothing within this is answered 503; the camera continues to open
OPENING_S = 0.02  # between two looks whether an IP camera has answered
SLOW_S = 3.0  # a camera that has delivered nothing this long after a viewer's request counts as lost until it does
HELD_S = 5.0  # how long an open camera then waits for the next request
TEARDOWN_S = 5.0  # how long a camera that is reopened waits for the end of its previous pipeline

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


class ServedCamera:
    """One mount point and its pipeline, if built."""

    def __init__(self, plan: Plan | SoundPlan, factory: CameraFactory, url: str) -> None:
        self.plan, self.factory = plan, factory
        self.name = plan.name
        self.url = GstRtsp.RTSPUrl.parse(url)[1]
        self.media: GstRtspServer.RTSPMedia | None = None
        self.stage = _Stage.NONE
        self.prepared = False  # the library has received data from it
        self.bus: Gst.Bus | None = None
        self.opening: _Opening | None = None

    @property
    def is_open(self) -> bool:
        return self.stage is _Stage.OPEN


class ServedCameras:
    """The cameras of the server by name, and the sound, each with its pipeline, if built.

    permissions  of viewers; None: anyone may watch, and nothing is encrypted
    stopped      set when the server stops
    """

    def __init__(
        self,
        plans: Sequence[Plan | SoundPlan],
        media: Media,
        openings: Openings,
        permissions: GstRtspServer.RTSPPermissions | None,
        clients: Clients,
        stopped: threading.Event,
    ) -> None:
        self._build, self._lost, self._on_report, self._refusal, _ = openings
        self._clients, self._changed, self._stopped = clients, clients.changed, stopped  # notified of a new stage, too
        self.threads = GstRtspServer.RTSPThreadPool()
        self.threads.set_max_threads(-1)  # one per client
        self.pipelines: dict[str, CameraPipeline | SoundPipeline] = {}
        self._holds: list[tuple[float, GstRtspServer.RTSPClient, GstRtspServer.RTSPMedia]] = []
        self.addresses = address_pool(media)
        self.named = {
            plan.name: ServedCamera(plan, CameraFactory(plan, self.addresses, permissions), rtsp_url(media, plan.name))
            for plan in plans
        }
        for camera in self.named.values():
            camera.factory.connect("media-configure", self._on_configure, camera)

    def of(self, media: GstRtspServer.RTSPMedia) -> ServedCamera | None:
        """The camera that a media is of."""
        return next((camera for camera in self.named.values() if camera.media is media), None)

    def _on_configure(self, _factory: object, media: GstRtspServer.RTSPMedia, camera: ServedCamera) -> None:
        element = media.get_element()
        pipeline = element.get_parent()
        bus = pipeline.get_bus()
        bus.enable_sync_message_emission()  # the library watches the bus itself and reports nothing
        bus.connect("sync-message::error", self._on_error, camera)
        built = self._build(element, camera.plan)
        if built.uplinks:
            bus.connect("sync-message::warning", _on_warning, weakref.ref(built.uplinks))
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

    def _on_prepared(self, media: GstRtspServer.RTSPMedia, camera: ServedCamera) -> None:
        with self._changed:
            if camera.media is media:
                camera.prepared = True
                if camera.stage is _Stage.BUILT:  # it has not failed in the meantime
                    camera.stage = _Stage.OPEN
                    self._lost.open(camera.name)
                self._changed.notify_all()

    def _on_target_state(self, media: GstRtspServer.RTSPMedia, state: int, camera: ServedCamera) -> None:
        with self._changed:
            if camera.media is media and state == Gst.State.NULL:
                camera.stage = _Stage.ENDING
                self._changed.notify_all()

    def _on_unprepared(
        self, media: GstRtspServer.RTSPMedia, camera: ServedCamera, pipeline: CameraPipeline | SoundPipeline
    ) -> None:
        with self._changed:
            if camera.media is media:
                camera.media = camera.bus = None
            if self.pipelines.get(camera.name) is pipeline:
                del self.pipelines[camera.name]
                camera.stage = _Stage.NONE
                self._changed.notify_all()
        if pipeline.uplinks:
            pipeline.uplinks.end()
        self._on_report(camera.name, "pipeline stopped")

    def _on_error(self, bus: Gst.Bus, message: Gst.Message, camera: ServedCamera) -> None:
        if concerns_file(message):
            return  # only the file ends, not the stream
        with self._changed:
            if camera.bus is not bus or camera.stage is _Stage.ENDING:
                return  # elements fail while the pipeline is being stopped, and after the one that has failed first
            camera.stage = _Stage.ENDING
            if camera.opening and not camera.opening.problem:
                camera.opening.problem = message.parse_error()[0].message
            affected = self._clients.using(camera.name)
        self._on_report(camera.name, message.parse_error()[0].message)
        # The library ends the pipeline when the last of them has left; until then no new viewer is admitted.
        for connection in affected:
            connection.close()

    def hold(self, client: GstRtspServer.RTSPClient, camera: ServedCamera) -> bool:
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
                self._keep(client, media)
                if opening:
                    opening.held.set()
                return True
            self._note_slow(camera)
            if (opening and opening.failed) or self._stopped.is_set() or time.monotonic() >= deadline:
                return False
            # Otherwise its last viewer has just left, and it is ending.

    def _is_waiting(self, camera: ServedCamera) -> bool:
        """Whether it is known that a camera cannot be opened within OPEN_S."""
        pipeline = self.pipelines.get(camera.name)
        waited = self._refusal(camera.name) is not None or (pipeline is not None and pipeline.has_waited(OPEN_S))
        return waited or not (camera.opening or self._lost.may_open(camera.name))

    def _note_slow(self, camera: ServedCamera) -> None:
        """Let the other cameras have the share of one that takes long to open."""
        with self._changed:  # it may be opening just now
            opening = None if camera.is_open else camera.opening
            if opening and not opening.over and time.monotonic() - opening.since > SLOW_S:
                self._lost.delay(camera.name, f"it has delivered nothing for {SLOW_S:g} s")

    def _is_settled(self, camera: ServedCamera, opening: _Opening | None) -> bool:
        """Whether waiting for a camera to open is over."""
        return camera.is_open or opening is None or opening.over or self._stopped.is_set()

    def keep(self, client: GstRtspServer.RTSPClient, media: GstRtspServer.RTSPMedia) -> None:
        """Hold what is open for a client, if it still is."""
        if media.prepare(None):
            self._keep(client, media)

    def _keep(self, client: GstRtspServer.RTSPClient, media: GstRtspServer.RTSPMedia) -> None:
        with self._changed:
            self._holds.append((time.monotonic(), client, media))

    def release(self, client: GstRtspServer.RTSPClient) -> None:
        """Release what a client holds."""
        self._release(lambda _, holder: holder is client)

    def release_old(self) -> None:
        """Release what is held for requests that were refused later: these do not release it."""
        old = time.monotonic() - OPEN_S
        self._release(lambda since, _: since < old)

    def _release(self, wanted: Callable[[float, GstRtspServer.RTSPClient], bool]) -> None:
        with self._changed:
            released = [media for since, client, media in self._holds if wanted(since, client)]
            self._holds = [hold for hold in self._holds if not wanted(*hold[:2])]
        for media in released:
            media.unprepare()

    def _open(self, camera: ServedCamera, opening: _Opening) -> None:
        """Build a camera's pipeline, wait until it delivers, and keep it until a client holds it."""
        try:
            with self._changed:
                self._changed.wait_for(lambda: camera.stage is not _Stage.ENDING, TEARDOWN_S)
            thread = self.threads.get_thread(GstRtspServer.RTSPThreadType.MEDIA, GstRtspServer.RTSPContext())
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

    def _prepare(self, media: PatientMedia, thread: GstRtspServer.RTSPThread, camera: ServedCamera) -> bool:
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


def _on_warning(_bus: Gst.Bus, message: Gst.Message, uplinks: weakref.ref[CameraUplinks]) -> None:
    if own := uplinks():
        own.note_error(message.src)


def _on_media_error(media: GstRtspServer.RTSPMedia, message: Gst.Message, camera: ServedCamera) -> bool:
    """Let the library see only errors of a stream that is being opened, which then fails.

    For a later error, it (1.22) would leave the viewers' transports and the stream's elements behind, and end a second
    time what has ended meanwhile.
    """
    if camera.media is not media or camera.prepared or concerns_file(message):
        GObject.signal_stop_emission_by_name(media, MEDIA_ERROR)
    return True
