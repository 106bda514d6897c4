"""What shows that the two sides do not understand each other, with the version of GStreamer on both.

The vehicle states its version in the description of a stream.
"""

from __future__ import annotations

from collections.abc import Callable

from gi.repository import Gst, GstSdp

VERSION = ".".join(map(str, Gst.version()[:3]))
ATTRIBUTE = "x-gstreamer"  # of a description
PACKETS, REQUESTS = 50, 40  # fewer prove nothing
SAME = "install the same tod-runner on both sides"


def state_version(sdp: GstSdp.SDPMessage) -> None:
    sdp.add_attribute(ATTRIBUTE, VERSION)


class Understanding:
    """Of one receiver, across its pipelines.

    on_report  called once with each fault
    """

    def __init__(self, on_report: Callable[[str], None]) -> None:
        self._on_report, self._reported = on_report, set[str]()
        self._vehicle = "unknown"  # its version
        self._decoders: list[Gst.Element] = []

    def begin(self) -> None:
        """Begin anew, with another pipeline."""
        self._decoders = []

    def read(self, sdp: GstSdp.SDPMessage) -> None:
        """Note the vehicle's version, from the description of a stream."""
        self._vehicle = sdp.get_attribute_val(ATTRIBUTE) or "unknown"

    def add(self, decoder: Gst.Element) -> None:
        """Watch an srtpdec. From any thread."""
        self._decoders.append(decoder)

    def look(self, received: int, unanswered: int) -> None:
        """A few times a second.

        received    packets of this pipeline
        unanswered  requests for lost packets, if none was answered in time
        """
        dropped = sum(decoder.get_property("stats").get_value("recv-drop-count") for decoder in self._decoders)
        if not received and dropped >= PACKETS:
            self._report("packets arrive, but none can be decrypted", SAME)
        if unanswered >= REQUESTS:
            fault = "nothing that was lost is repaired: the vehicle has answered no request in time"
            self._report(fault, f"unless the round trip is too long, {SAME}")

    def _report(self, fault: str, cure: str) -> None:
        if fault not in self._reported:
            self._reported.add(fault)
            versions = f"GStreamer {VERSION} here, {self._vehicle} on the vehicle"
            self._on_report(f"{fault}; {versions}; {cure}")
