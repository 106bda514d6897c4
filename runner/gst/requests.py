"""Limits what viewers may request over RTCP (RFC 4585): each request costs the uplink that all cameras share."""

from __future__ import annotations

import time
from collections.abc import Callable

from gi.repository import Gst

from runner.gst.probes import RequestProbe

REPEATED = 0.25  # packets sent again, at most, per packet sent; above 15 % loss an operator's side requests none
AT_ONCE = 200  # packets sent again at once: an IDR picture of the highest bitrates
KEY_UNIT_S = 1.0  # between two requests for a key frame, which the encoder answers with one, or with a refresh wave


class RequestLimit:
    """Drops requests of viewers beyond a limit.

    One viewer could otherwise have every stored packet sent again for each of its own, a hundred times what it asks
    with, and slow the video of all.

    packets    source pad of the payloader
    on_report  called, from a streaming thread, when the limit is first exceeded
    """

    def __init__(self, packets: Gst.Pad, on_report: Callable[[str], None]) -> None:
        self._payloader, self._on_report = packets.get_parent_element(), on_report
        self._allowance = float(AT_ONCE)
        self._sent = 0  # RTP sequence number at the last request
        self._key_unit: float | None = None  # when the last one was granted
        self._reported = False
        self._retransmissions = RequestProbe("GstRTPRetransmissionRequest", self._grant_retransmission)  # NACK
        self._key_units = RequestProbe("GstForceKeyUnit", self._grant_key_unit)  # PLI, FIR
        self._key_units.add_to(packets)

    def add_store(self, element: Gst.Element) -> None:
        """The element that keeps packets, and answers requests for them."""
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
                f"viewers request more than {100 * REPEATED:.0f} % of the packets again; further requests are ignored"
            )
