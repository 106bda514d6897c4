"""Limits what viewers may request over RTCP (RFC 4585): each request costs the uplink that all cameras share."""

from __future__ import annotations

import time
import weakref
from collections import OrderedDict
from collections.abc import Callable

from gi.repository import Gst

from runner.gst.probes import RequestProbe

# Packets resent, at most, per packet sent. Up to 15 % loss an operator's side requests each missing packet, and again
# after a round trip. If there are several viewers, each gets fewer: all receive what one of them has requested, and one
# whose own link is narrow requests most packets, which takes the uplink from the others.
REPEATED, SHARED = 0.5, 1 / 15
AT_ONCE = 300  # packets resent at once, as after a short outage: 0.4 s of 8 Mbit/s
SHARED_AT_ONCE = 50  # to each of several viewers
STORED = 0x8000  # packets that may be asked for: an older number is that of a newer one
REMEMBERED = 16  # viewers, the latest ones
KEY_UNIT_S = 1.0  # between two requests for a key frame


class _Allowance:
    """Packets that may be resent.

    sent  RTP sequence number of the newest packet
    """

    def __init__(self, sent: int, packets: float) -> None:
        self._sent, self.packets = sent, packets

    def earn(self, sent: int, share: float, most: int = AT_ONCE) -> None:
        """Add a share of the packets that were sent since the last request."""
        self.packets = min(most, self.packets + share * ((sent - self._sent) % 65536))
        self._sent = sent


class RequestLimit:
    """Drops requests of viewers beyond a limit.

    One viewer could otherwise make the vehicle resend every stored packet with each request, which multiplies the
    traffic a hundredfold and slows the video of all.

    packets    source pad of the payloader
    on_report  called, from a streaming thread, when the limit is first exceeded
    viewers    number of viewers over the uplink that may request packets
    """

    viewers = 1

    def __init__(self, packets: Gst.Pad, on_report: Callable[[str], None]) -> None:
        self._payloader, self._on_report = packets.get_parent_element(), on_report
        self._has_payloader = self._payloader.find_property("seqnum") is not None  # else nothing counts the packets
        self._all = _Allowance(0, AT_ONCE)
        self._by_viewer: OrderedDict[int, _Allowance] = OrderedDict()  # by SSRC
        self._new = _Allowance(0, AT_ONCE)  # of all new viewers: each may change its SSRC
        self._asking = 0  # SSRC of the viewer whose request is being handled
        self._key_unit: float | None = None  # when the last one was granted
        self._reported = False
        self._given_up: int | None = None  # number of the last packet that is not resent; None: there is none
        self._retransmissions = RequestProbe("GstRTPRetransmissionRequest", self._grant_retransmission)  # NACK
        self._key_units = RequestProbe("GstForceKeyUnit", self.grant_key_unit)  # PLI, FIR
        self._key_units.add_to(packets)

    def add_store(self, element: Gst.Element) -> None:
        """The element that keeps packets, and answers requests for them."""
        if self._has_payloader:
            self._retransmissions.add_to(element.get_static_pad("src"))

    def add_session(self, element: Gst.Element) -> None:
        """The RTP session by which viewers request packets."""
        element.get_property("internal-session").connect("on-feedback-rtcp", _on_feedback, weakref.ref(self))

    def begin_anew(self) -> None:
        """Resend none of the packets that have been sent. From any thread."""
        if self._has_payloader:
            self._given_up = self._payloader.get_property("seqnum")

    def _grant_retransmission(self, number: int | None) -> bool:
        sent: int = self._payloader.get_property("seqnum")
        if self._is_given_up(number, sent):
            return False
        share, most = (SHARED, SHARED_AT_ONCE) if self.viewers > 1 else (REPEATED, AT_ONCE)
        self._all.earn(sent, REPEATED)
        self._new.earn(sent, share)
        viewer = self._by_viewer.pop(self._asking, None) or self._admit(sent, most)
        viewer.earn(sent, share, most)
        self._by_viewer[self._asking] = viewer
        if min(self._all.packets, viewer.packets) < 1:
            self._report_limit()
            return False
        self._all.packets -= 1
        viewer.packets -= 1
        return True

    def _is_given_up(self, number: int | None, sent: int) -> bool:
        given_up = self._given_up  # another thread may set it
        if given_up is None or number is None:
            return False
        since = (sent - given_up) % 65536
        if since > STORED:  # it is not stored any more; the numbers will come round again
            self._given_up = None
        return since <= (sent - number) % 65536 <= STORED

    def _admit(self, sent: int, most: int) -> _Allowance:
        """A new viewer."""
        first = min(most, self._new.packets)
        self._new.packets -= first
        if len(self._by_viewer) == REMEMBERED:
            self._by_viewer.popitem(last=False)
        return _Allowance(sent, first)

    def grant_key_unit(self, _number: int | None = None) -> bool:
        """Whether a viewer may have a key frame now, which all others receive too."""
        now = time.monotonic()
        if self._key_unit is not None and now - self._key_unit < KEY_UNIT_S:
            return False
        self._key_unit = now
        return True

    def _report_limit(self) -> None:
        if not self._reported:
            self._reported = True
            self._on_report("viewers request too many packets again; some requests are ignored")


def _on_feedback(
    _session: object, _kind: int, _format: int, sender: int, _media: int, _fci: object, limit: weakref.ref[RequestLimit]
) -> None:
    """Called in the streaming thread, right before the requests of an RTCP packet go upstream as events."""
    if own := limit():
        own._asking = sender
