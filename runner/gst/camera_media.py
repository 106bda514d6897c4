"""What the RTSP server's library is told about a camera: its factory, its description, and the elements around it."""

from __future__ import annotations

import threading
import weakref
from typing import TYPE_CHECKING

from gi.repository import Gst, GstRtsp, GstRtspServer, GstSdp

from runner.graph import FEEDBACK, Plan
from runner.gst.patient_media import PatientMedia
from runner.gst.pipeline import CameraPipeline
from runner.gst.srtp import set_master_key, write_keys
from runner.settings import Media
from runner.system.ports import ip_address_of

if TYPE_CHECKING:
    from runner.gst.sound_pipeline import SoundPipeline
    from runner.sound import SoundPlan

QUEUE_BYTES = 2_000_000  # more than a viewer may lag at any bitrate


_SECURE = GstRtsp.RTSPProfile.SAVP | GstRtsp.RTSPProfile.SAVPF
# By thread, whether the client whose DESCRIBE it is answering wants feedback. The library tells a media neither the
# client nor the path, but answers each request in one thread.
_feedback: dict[int, bool] = {}


def describe_for(path: str) -> None:
    """Note the path of a DESCRIBE, without slashes at its ends, for the description that follows in this thread."""
    _feedback[threading.get_ident()] = wants_feedback(path)


def wants_feedback(path: str) -> bool:
    """Whether a path, without slashes at its ends, is that of clients which give feedback."""
    return path.endswith(f"/{FEEDBACK}")


class CameraMedia(PatientMedia):
    """A camera's media, described to each client with the one profile that it wants.

    The library would list the stream once for each of its profiles. Clients that set up whatever is listed then wait
    for a second stream, which stays empty: ffmpeg for 5 s before its first picture.
    """

    def do_setup_sdp(self, sdp: GstSdp.SDPMessage, info: GstRtspServer.SDPInfo) -> bool:
        from runner.gst.understanding import state_version

        stream, is_wanted = self.get_stream(0), _feedback.pop(threading.get_ident(), False)
        caps, offered = stream.get_caps(), stream.get_profiles()
        if caps is None:
            return False
        plain, feedback = _profiles(bool(offered & _SECURE))
        state_version(sdp)
        sdp.add_attribute("range", self.get_range_string(False, GstRtsp.RTSPRangeUnit.NPT))
        wanted = feedback if is_wanted and offered & feedback else plain
        if not GstRtspServer.rtsp_sdp_make_media(sdp, info, stream, caps, wanted):
            return False
        write_keys(sdp.get_media(0))
        return True


class CameraFactory(GstRtspServer.RTSPMediaFactory):  # type: ignore[misc]
    """A camera's factory, with one media for all URLs of the camera: another port, a trailing slash, or with feedback.

    permissions  of viewers; None: anyone may watch, and nothing is encrypted
    """

    def __init__(
        self,
        plan: Plan | SoundPlan,
        addresses: GstRtspServer.RTSPAddressPool,
        permissions: GstRtspServer.RTSPPermissions | None,
    ) -> None:
        super().__init__()
        settings = plan.settings
        self.set_media_gtype(CameraMedia.__gtype__)
        self.set_launch(plan.server)
        self.set_shared(True)  # otherwise a second viewer takes the pipeline from the first
        self.set_latency(0)
        self.set_address_pool(addresses)
        if settings.dscp >= 0:
            self.set_dscp_qos(settings.dscp)
        if permissions:
            self.set_permissions(permissions)
        plain, feedback = _profiles(permissions is not None)
        repairs = settings.retransmission_ms
        if repairs:
            self.set_retransmission_time(repairs * Gst.MSECOND)
            self.set_do_retransmission(True)
        self.set_profiles(plain | feedback if repairs else plain)

    def do_gen_key(self, _url: GstRtsp.RTSPUrl) -> str:
        return "media"


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


def on_element(
    pipeline: Gst.Bin, parent: Gst.Bin, element: Gst.Element, built: weakref.ref[CameraPipeline | SoundPipeline]
) -> None:
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
    if camera and camera.uplinks and factory == "multiudpsink":
        camera.uplinks.take_over(element)
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
