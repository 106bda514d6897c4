"""The vehicle's RTSP server: one shared factory per camera, its settings written again whenever it is built anew."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from gi.repository import Gst, GstRtsp, GstRtspServer

from runner.errors import RunError
from runner.graph import Plan
from runner.gst.pipeline import Build, CameraPipeline
from runner.gst.video_files import concerns_file
from runner.model import Endpoint
from runner.ports import check_port_free

Report = Callable[[str, str], None]  # camera, what happened


class CameraServer:
    """RTSP server with one mount point per camera.

    build   makes a `CameraPipeline` of each that was built
    report  told of pipelines that come and go
    """

    def __init__(self, plans: Sequence[Plan], media: Endpoint, build: Build, report: Report) -> None:
        check_port_free(media)
        self._build, self._report = build, report
        self.pipelines: dict[str, CameraPipeline] = {}
        self._server = GstRtspServer.RTSPServer()
        self._server.set_address(media.host)
        self._server.set_service(str(media.port))
        for plan in plans:
            self._server.get_mount_points().add_factory(f"/{plan.camera.name}", self._factory(plan))
        self._attached = self._server.attach(None)
        if not self._attached:
            raise RunError(f"the RTSP server cannot listen on {media.host}:{media.port}; choose another media.port")

    def stop(self) -> None:
        from gi.repository import GLib

        self._server.client_filter(lambda *_: GstRtspServer.RTSPFilterResult.REMOVE)
        GLib.source_remove(self._attached)

    def _factory(self, plan: Plan) -> GstRtspServer.RTSPMediaFactory:
        settings = plan.camera.graph.settings
        factory = GstRtspServer.RTSPMediaFactory()
        factory.set_launch(plan.server)
        factory.set_shared(True)  # else a second viewer takes the pipeline from the first
        factory.set_latency(0)
        if int(settings.get("dscp", -1)) >= 0:
            factory.set_dscp_qos(int(settings["dscp"]))
        if int(settings.get("retransmission_ms", 0)):
            factory.set_retransmission_time(int(settings["retransmission_ms"]) * Gst.MSECOND)
            factory.set_do_retransmission(True)
            factory.set_profiles(GstRtsp.RTSPProfile.AVPF | GstRtsp.RTSPProfile.AVP)
        factory.connect("media-configure", self._on_configure, plan)
        return factory

    def _on_configure(self, _factory: object, media: GstRtspServer.RTSPMedia, plan: Plan) -> None:
        name = plan.camera.name
        element = media.get_element()
        element.get_parent().connect("deep-element-added", _on_element)
        bus = element.get_parent().get_bus()
        bus.enable_sync_message_emission()  # the library watches the bus itself and tells nobody
        bus.connect("sync-message::error", self._on_error, name)
        self.pipelines[name] = self._build(element, plan)
        media.connect("unprepared", self._on_unprepared, name, self.pipelines[name])
        self._report(name, "pipeline built")

    def _on_error(self, _bus: Gst.Bus, message: Gst.Message, name: str) -> None:
        if not concerns_file(message):  # that ends the file, and not the stream
            self._report(name, message.parse_error()[0].message)

    def _on_unprepared(self, _media: object, name: str, pipeline: CameraPipeline) -> None:
        if self.pipelines.get(name) is pipeline:
            del self.pipelines[name]
        self._report(name, "pipeline gone")


def _on_element(_bin: Gst.Bin, _parent: Gst.Bin, element: Gst.Element) -> None:
    """Settle what the server library makes by itself around a pipeline."""
    if element.find_property("processing-deadline"):
        # Sinks of a live pipeline hold packets back for 20 ms: here pure latency.
        element.set_property("processing-deadline", 0)
    if element.find_property("rtcp-sync-send-time"):
        # Packets state when their frame was captured, not when they leave.
        element.set_property("rtcp-sync-send-time", False)
