"""Limits what viewers may request over RTCP (RFC 4585): each request costs the uplink that all cameras share."""

from __future__ import annotations

import time
from collections.abc import Callable

from gi.repository import Gst

from runner.gst.probes import RequestProbe

# Packets resent, at most, per packet sent. Up to 15 % loss an operator's side requests each missing packet, and again
# after a round trip; there may be several viewers.
REPEATED = 0.5
AT_ONCE = 300  # packets resent at once, as after a short outage: 0.4 s of 8 Mbit/s
KEY_UNIT_S = 1.0  # between two requests for a key frame


class RequestLimit:
    """Drops requests of viewers beyond a limit.

    One viewer could otherwise make the vehicle resend every stored packet with each request, which multiplies the
    traffic a hundredfold and slows the video of all.

    packets    source pad of the payloader
    on_report  called, from a streaming thread, when the limit is first exceeded
    """

    def __init__(self, packets: Gst.Pad, on_report: Callable[[str], None]) -> None:
        self._payloader, self._on_report = packets.get_parent_element(), on_report
        self._has_payloader = self._payloader.find_property("seqnum") is not None  # else nothing counts the packets
        self._allowance = float(AT_ONCE)
        self._sent = 0  # RTP sequence number at the last request
        self._key_unit: float | None = None  # when the last one was granted
        self._reported = False
        self._retransmissions = RequestProbe("GstRTPRetransmissionRequest", self._grant_retransmission)  # NACK
        self._key_units = RequestProbe("GstForceKeyUnit", self._grant_key_unit)  # PLI, FIR
        self._key_units.add_to(packets)

    def add_store(self, element: Gst.Element) -> None:
        """The element that keeps packets, and answers requests for them."""
        if self._has_payloader:
            self._retransmissions.add_to(element.get_static_pad("src"))

    def _grant_retransmission(self) -> bool:
        sent: int = self._payloader.get_property("seqnum")
        self._allowance = min(AT_ONCE, self._allowance + REPEATED * ((sent - self._sent) % 65536))
        self._sent = sent
        if self._allowance < 1:
            self._report_limit()
            return False
        self._allowance -= 1
        return True

    def _grant_key_unit(self) -> bool:
        now = time.monotonic()
        if self._key_unit is not None and now - self._key_unit < KEY_UNIT_S:
            return False
        self._key_unit = now
        return True

    def _report_limit(self) -> None:
        if not self._reported:
            self._reported = True
            self._on_report(
                f"viewers request more than {100 * REPEATED:.0f} % of the packets again; some requests are ignored"
            )
