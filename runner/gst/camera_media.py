"""What the RTSP server's library is told about a camera: its factory, its addresses, and the elements around it."""

from __future__ import annotations

import weakref

from gi.repository import Gst, GstRtsp, GstRtspServer

from runner.core.model import Media
from runner.graph import Plan
from runner.gst.patient_media import PatientMedia
from runner.gst.pipeline import CameraPipeline
from runner.gst.srtp import set_master_key
from runner.system.ports import ip_address_of

QUEUE_BYTES = 2_000_000  # more than a viewer may lag at any bitrate


class CameraFactory(GstRtspServer.RTSPMediaFactory):  # type: ignore[misc]  # PyGObject has no types
    """A camera's factory, with one media for all URLs of the camera: another port, a trailing slash or a query.

    permissions  of viewers; None: anyone may watch, and nothing is encrypted
    """

    def __init__(
        self, plan: Plan, addresses: GstRtspServer.RTSPAddressPool, permissions: GstRtspServer.RTSPPermissions | None
    ) -> None:
        super().__init__()
        settings = plan.camera.graph.settings
        self.set_launch(plan.server)
        self.set_media_gtype(PatientMedia.__gtype__)
        self.set_shared(True)  # otherwise a second viewer takes the pipeline from the first
        self.set_latency(0)
        self.set_address_pool(addresses)
        if dscp_of(plan) >= 0:
            self.set_dscp_qos(dscp_of(plan))
        if permissions:
            self.set_permissions(permissions)
        plain, feedback = _profiles(permissions is not None)
        repairs = int(settings.get("retransmission_ms", 0))
        if repairs:
            self.set_retransmission_time(repairs * Gst.MSECOND)
            self.set_do_retransmission(True)
        self.set_profiles(plain | feedback if repairs else plain)

    def do_gen_key(self, _url: GstRtsp.RTSPUrl) -> str:
        return "media"


def dscp_of(plan: Plan) -> int:
    """DiffServ code point of a camera's packets; -1 leaves it to the system."""
    return int(plan.camera.graph.settings.get("dscp", -1))


def _profiles(secure: bool) -> tuple[GstRtsp.RTSPProfile, GstRtsp.RTSPProfile]:
    """Without feedback, for players that lack it, and with, for retransmission (RFC 4585); as SRTP (RFC 5124)."""
    profiles = GstRtsp.RTSPProfile
    return (profiles.SAVP, profiles.SAVPF) if secure else (profiles.AVP, profiles.AVPF)


def address_pool(media: Media) -> GstRtspServer.RTSPAddressPool:
    """Addresses for RTP and RTCP: the server's own, or all if it listens on all."""
    address = ip_address_of(media.host)
    first, last = media.rtp_ports
    pool = GstRtspServer.RTSPAddressPool()
    pool.add_range(address, address, first, last, 0)
    return pool


def on_element(pipeline: Gst.Bin, parent: Gst.Bin, element: Gst.Element, built: weakref.ref[CameraPipeline]) -> None:
    """Configure the elements that the server library adds around a pipeline."""
    factory = element.get_factory().get_name() if element.get_factory() else ""
    if parent is pipeline and factory == "queue":
        # In front of its sinks, if it has several: a sink that accepts nothing must not block the others. Not limited
        # by time: the first packet after a pause would seem as old as the pause, and be dropped for the second.
        element.set_property("leaky", "downstream")
        element.set_property("max-size-buffers", 0)
        element.set_property("max-size-time", 0)
        element.set_property("max-size-bytes", QUEUE_BYTES)
    if factory == "srtpenc":
        set_master_key(element)
    camera = built()
    if factory == "rtprtxsend":
        element.set_property("max-size-packets", 0)  # packets are kept by time alone; by default, the last 100 at most
    if camera and factory == "rtprtxsend":
        camera.requests.add_store(element)
    if camera and factory == "rtpsession":
        camera.requests.add_session(element)
    if element.find_property("processing-deadline"):
        # Sinks of a live pipeline hold packets until their time: pure latency, and retransmissions wait behind them.
        # For viewers over TCP the library turns this on again with each PLAY.
        element.connect("notify::sync", _never_wait)
        _never_wait(element)
    if element.find_property("rtcp-sync-send-time"):
        # Packets state when their frame was captured, not when they leave.
        element.set_property("rtcp-sync-send-time", False)


def _never_wait(sink: Gst.Element, _changed: object = None) -> None:
    if sink.get_property("sync"):
        sink.set_property("sync", False)
