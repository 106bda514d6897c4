"""A camera's uplinks as its receiver sees them: merges what comes by them, and sends feedback to all of them."""

from __future__ import annotations

import itertools
import os
import socket
import threading
import time
from collections.abc import Collection, Mapping
from contextlib import suppress
from itertools import chain

from gi.repository import Gst

from runner.gst.arriving import FIXED_BYTES, HEADER_BYTES, RTP_HZ, ArrivingFrames, read_packet
from runner.gst.merge import Merge
from runner.gst.packet_senders import PacketSenders
from runner.gst.packet_times import received_at
from runner.gst.probes import PassingBuffer, PassProbe
from runner.records.reception import UplinkArrivals, UplinkReceived

# Firewalls forget what they have let through: 30 s after the only packet that went out.
OPEN_S = 10.0
REPLAYED = 8192  # packets whose numbers an srtpdec remembers: 4 s at 20 Mbit/s, by default 128

Addresses = Mapping[str, Collection[str]]  # IP addresses by uplink


class ReceivedUplinks:
    """For one receiver, across its pipelines.

    addresses  of the vehicle, by uplink; none while they are unknown
    has_keys   whether packets are encrypted
    hz         of the RTP timestamps
    """

    def __init__(self, addresses: Addresses, *, has_keys: bool, hz: int = RTP_HZ) -> None:
        self._addresses, self._has_keys, self._hz = addresses, has_keys, hz
        self._lock = threading.Lock()  # elements are added in the client's thread
        self._attempts = itertools.count()
        self.begin()

    def begin(self) -> None:
        """The receiver has built a new pipeline."""
        self.merge = Merge(is_authentic=not self._has_keys, hz=self._hz)
        self._counted: dict[str, tuple[int, int]] = {}
        self._source: _Source | None = None
        self._sinks: list[tuple[Gst.Element, socket.AddressFamily]] = []
        self._opened = 0.0

    def direct(self, client: Gst.Element) -> None:
        """Let a new pipeline's client connect by another uplink than the one before, first to where it would anyway."""
        uri = Gst.Uri.from_string(client.get_property("location"))
        # With keys, an IPv6 address cannot be the server's name: see `runner.security.exposure`.
        others = _of_family(self.hosts, socket.AF_INET) if self._has_keys else self.hosts
        hosts = [uri.get_host(), *(host for host in others if host != uri.get_host())]
        uri.set_host(hosts[next(self._attempts) % len(hosts)])
        client.set_property("location", uri.to_string())

    @property
    def hosts(self) -> list[str]:
        """All addresses of the vehicle; none while they are unknown."""
        return list(chain.from_iterable(self._addresses.values()))

    def admit(self, addresses: Addresses) -> bool:
        """Receive from these addresses, and send to them; returns whether they are others. From any thread."""
        with self._lock:
            if addresses == self._addresses:
                return False
            before, self._addresses = self.hosts, addresses
            if self._source:
                self._source.name(self._names)
            for sink, family in self._sinks:
                for action, hosts, others in (("remove", before, self.hosts), ("add", self.hosts, before)):
                    for host in _of_family(hosts, family):
                        if host not in others:
                            sink.emit(action, host, sink.get_property("port"))
            self._opened = 0.0
            return True

    @property
    def _names(self) -> dict[str, str]:
        return {host: name for name, hosts in self._addresses.items() for host in hosts}

    def add(self, factory: str, element: Gst.Element, *, kernel_times: bool) -> None:
        """Use an element of the client, if it receives or sends."""
        if factory == "udpsrc" and (used := element.get_property("used-socket")):
            if used.get_local_address().get_port() % 2:  # RTCP (RFC 3550, section 11)
                element.set_property("retrieve-sender-address", False)
            else:
                with self._lock:
                    self._source = _Source(element, self.merge, kernel_times=kernel_times)
                    self._source.name(self._names)
        if factory == "udpsink":  # of RTCP, or of what opens a firewall for RTP
            self._add_sink(element)
        if factory == "srtpdec":
            element.set_property("replay-window-size", REPLAYED)

    def _add_sink(self, sink: Gst.Element) -> None:
        first, port = sink.get_property("host"), sink.get_property("port")
        family = _family(first)
        with self._lock:
            self._sinks.append((sink, family))
            for host in _of_family(self.hosts, family):
                if host != first:
                    sink.emit("add", host, port)

    def look(self) -> None:
        """Let firewalls know that packets are expected; a few times a second."""
        now = time.monotonic()
        if self._source:
            self._source.look()
        if now - self._opened < OPEN_S:
            return
        self._opened = now
        for sink, family in tuple(self._sinks):
            if used := sink.get_property("used-socket"):
                with socket.socket(fileno=os.dup(used.get_fd())) as duplicate:
                    for host in _of_family(self.hosts, family):
                        with suppress(OSError):  # no route to it now
                            duplicate.sendto(b"", (host, sink.get_property("port")))

    def take(self) -> dict[str, UplinkArrivals]:
        """By uplink, what it has delivered since the last call. From any one thread."""
        now = time.monotonic()
        return {name: self._take(name, frames, now) for name, frames in self.merge.frames.items()}

    def _take(self, name: str, frames: ArrivingFrames, now: float) -> UplinkArrivals:
        received, missing = self._counted.get(name, (0, 0))
        self._counted[name] = frames.received, max(missing, frames.missing)  # it drops if packets were only reordered
        lost = self._counted[name][1] - missing
        return UplinkArrivals(frames.take(now), frames.take_packets(), frames.received - received, lost)

    def counts(self) -> dict[str, UplinkReceived]:
        """By uplink, since the pipeline was built."""
        return self.merge.counts()


class _Source:
    """Where the packets of one pipeline arrive."""

    def __init__(self, element: Gst.Element, merge: Merge, *, kernel_times: bool) -> None:
        self._element, self._merge, self._kernel_times = element, merge, kernel_times
        self._senders = PacketSenders()
        self._base_time = 0  # ns; 0: not known yet
        self._probe = PassProbe(element.get_static_pad("src"), self._on_packet)

    def name(self, uplinks: Mapping[str, str]) -> None:
        """The uplinks by address are these now."""
        self._senders.name(uplinks)

    def look(self) -> None:
        self._base_time = self._element.get_base_time()

    def _on_packet(self, _pad: Gst.Pad, buffer: PassingBuffer) -> bool:
        now, header, uplink = time.monotonic(), buffer.extract(0, HEADER_BYTES), self._senders.take(buffer)
        if len(header) < FIXED_BYTES:
            return True  # the session drops it
        arrived = None
        if self._base_time and self._kernel_times and (dts := buffer.dts) is not None:
            arrived = received_at(dts, self._base_time, now)
        return self._merge.passes(header, read_packet(header, buffer.size), uplink, now, arrived)


def _family(host: str) -> socket.AddressFamily:
    return socket.AF_INET6 if ":" in host else socket.AF_INET


def _of_family(hosts: Collection[str], family: socket.AddressFamily) -> list[str]:
    return [host for host in hosts if _family(host) is family]
