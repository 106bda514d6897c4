"""The ways by which a camera's stream leaves the vehicle: the same packets, encrypted once, over any of its uplinks.

The RTSP server's library sends to all viewers from one socket, which leaves by the default route. Here its sinks keep
the viewers on the vehicle alone. For the others each uplink has sinks behind the same tees, with sockets of its own:

    rtpbin ! tee ! library's sink
             tee ! valve ! queue ! multiudpsink   for each uplink; the valve is open while it carries the camera
    udpsrc ! funnel ! rtpbin                      for each uplink; RTCP of viewers, by the library's funnel
"""

from __future__ import annotations

import itertools
import socket
import threading
import time
import weakref
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterator, Mapping

from gi.repository import Gio, GObject, Gst

from runner.gst.probes import IdleProbe, PassingBuffer, PassProbe, TypeProbe
from runner.gst.sender_filter import SenderFilter
from runner.gst.uplink_sockets import device_of, open_socket, sharing_ports
from runner.gst.viewers import over_uplink
from runner.records.reception import UplinkSent
from runner.settings import Uplink
from runner.system.interfaces import addresses_by

FAMILIES = {"socket": socket.AF_INET, "socket-v6": socket.AF_INET6}  # by property of a multiudpsink
COPIED = ("qos-dscp", "buffer-size", "send-duplicates")  # of the library's sink
LOOK_S = 1.0  # between two looks at the devices
REMEMBERED = 64  # RTCP packets of all viewers of a camera: more than they send while one is on a slow way
OWN = "uplink-"  # how names of sinks begin that are not the library's
RTP = "send_rtp_src"  # how rtpbin's pad of RTP begins; the other one is of RTCP
OnFault = Callable[[str, str], None]
Destination = tuple[str, int]  # address and port of a viewer
_numbers = itertools.count()
# A valve that opens makes what is above negotiate again, in the middle of a turn.
_KEEPS_CAPS = TypeProbe(Gst.PadProbeType.EVENT_UPSTREAM, {Gst.EventType.RECONFIGURE: Gst.PadProbeReturn.DROP})
Sockets = Mapping[str, Gio.Socket]  # by property of a multiudpsink


class VehicleUplinks:
    """The uplinks of a vehicle, and which of them carry each camera: all, until `carry` says otherwise.

    may_listen  returns whether viewers may connect at an address
    on_report  called, from any thread, with an uplink that cannot be used, and why, and when it can be again
    """

    def __init__(
        self,
        uplinks: Mapping[str, Uplink],
        on_report: Callable[[str, str], None],
        may_listen: Callable[[str], bool] = lambda address: False,
    ) -> None:
        self._uplinks, self._on_report, self._may_listen = uplinks, on_report, may_listen
        self._faults, self._lock = dict.fromkeys(uplinks, ""), threading.Lock()
        self._looked = 0.0
        self._carrying: dict[str, frozenset[str]] = {}
        self._cameras: weakref.WeakValueDictionary[str, CameraUplinks] = weakref.WeakValueDictionary()

    def of(self, camera: str) -> CameraUplinks:
        """Those of a camera's new pipeline."""
        self._cameras[camera] = made = CameraUplinks(self._uplinks, lambda: self.carrying(camera), self._note)
        return made

    def _note(self, uplink: str, fault: str) -> None:
        """All cameras find the same fault; "": there is none."""
        with self._lock:
            before, self._faults[uplink] = self._faults[uplink], fault
        if fault != before:
            self._on_report(f"uplink {uplink}", fault or "works again")

    def carrying(self, camera: str) -> Collection[str]:
        return self._carrying.get(camera, self._uplinks)

    def carry(self, placed: Mapping[str, Collection[str]]) -> None:
        """Set which uplinks carry these cameras, from their next packets on. From any thread."""
        self._carrying |= {camera: frozenset(names) for camera, names in placed.items()}
        for camera in placed:
            if made := self._cameras.get(camera):
                made.turn()

    def listening(self) -> dict[str, str]:
        """The addresses at which viewers may connect now, each with its device; "": its uplink names none."""
        found = ((address, each.interface or "") for each in self._uplinks.values() for address in addresses_by(each))
        return {address: device for address, device in found if self._may_listen(address)}

    def look(self) -> None:
        """Make sockets anew for devices that have come back; many times a second, from one thread."""
        if time.monotonic() - self._looked < LOOK_S:
            return
        self._looked = time.monotonic()
        for made in list(self._cameras.values()):
            made.look()

    def counts(self) -> dict[str, dict[str, UplinkSent]]:
        """By camera and uplink, what was sent since the camera's pipeline was built; no camera without one."""
        return {camera: made.counts() for camera, made in list(self._cameras.items())}


class CameraUplinks:
    """The uplinks of one camera's pipeline.

    carrying  returns the names of the uplinks that carry the camera
    on_fault  called, from any thread, with an uplink and why it cannot be used; "": it can
    """

    def __init__(
        self, uplinks: Mapping[str, Uplink], carrying: Callable[[], Collection[str]], on_fault: OnFault
    ) -> None:
        self._uplinks, self._carrying, self._on_fault = uplinks, carrying, on_fault
        self._channels: list[_Channel] = []

    def take_over(self, sink: Gst.Element) -> None:
        """Take over the viewers of a sink that has been added to the pipeline and not been linked yet."""
        if sink.get_name().startswith(OWN):
            return
        channel = _Channel(sink, self._uplinks, self._carrying, self._on_fault)
        self._channels.append(channel)
        for action in ("add", "remove"):
            sink.connect(action, _on_viewer, action, weakref.ref(channel))

    def end(self) -> None:
        """The pipeline has ended: free its ports."""
        channels, self._channels = self._channels, []
        for channel in channels:
            channel.end()

    def turn(self) -> None:
        """Send by the uplinks that carry the camera now; all change between the same two packets."""
        for channel in tuple(self._channels):
            channel.turn()

    def look(self) -> None:
        """See `VehicleUplinks.look`."""
        for channel in tuple(self._channels):
            channel.renew()

    def note_error(self, sink: Gst.Element) -> None:
        """A sink could not send a packet."""
        for channel in tuple(self._channels):
            channel.note_error(sink)

    def counts(self) -> dict[str, UplinkSent]:
        """By uplink, what was sent since the pipeline was built."""
        found = {name: UplinkSent() for name in self._uplinks}
        for channel in tuple(self._channels):
            for name, counts in channel.counts().items():
                found[name] = found[name].plus(counts)
        return found


def _on_viewer(sink: Gst.Element, host: str, port: int, action: str, channel: weakref.ref[_Channel]) -> None:
    """The library adds or removes a viewer; before its sink does."""
    own = channel()
    if own and own.serves(host):
        GObject.signal_stop_emission_by_name(sink, action)
        own.change(action, (host, port))


class _Channel:
    """RTP or RTCP of a camera: the library's sink, and a branch for each uplink, once there is a viewer."""

    def __init__(
        self,
        library: Gst.Element,
        uplinks: Mapping[str, Uplink],
        carrying: Callable[[], Collection[str]],
        on_fault: OnFault,
    ) -> None:
        self._library, self._uplinks, self._carrying, self._on_fault = library, uplinks, carrying, on_fault
        self._are_loopback = all(each.address and not over_uplink(each.address) for each in uplinks.values())
        self._idle = IdleProbe(self._on_idle)
        self._tee: Gst.Element | None = None
        self._is_rtp = False
        self._viewers: Counter[Destination] = Counter()
        self._is_watched = False
        self._branches: dict[str, _Branch] = {}
        self._retired: list[_Branch] = []
        self._before = dict.fromkeys(uplinks, UplinkSent())  # of former branches and viewers; all errors
        self._feedback = Feedback()
        self._lock = threading.RLock()

    def serves(self, host: str) -> bool:
        """Whether the uplinks reach a viewer; one on the vehicle itself only if they begin and end there, too."""
        return over_uplink(host) or self._are_loopback

    def change(self, action: str, viewer: Destination) -> None:
        """Add or remove a viewer."""
        with self._lock:
            if self._tee is None:
                self._begin(_tee_above(self._library))
            self._viewers[viewer] += 1 if action == "add" else -1
            self._is_watched = bool(+self._viewers)
            for name, branch in self._branches.items():
                if action == "remove":
                    self._count(name, branch.sent_to(viewer))
                branch.change(action, viewer)
                branch.senders.admit(*self._hosts)
        self.renew()

    def _begin(self, tee: Gst.Element) -> None:
        self._tee, self._entry = tee, tee.get_static_pad("sink")
        self._is_rtp = self._entry.get_peer().get_name().startswith(RTP)

    def end(self) -> None:
        with self._lock:
            self._tee = None
            for branch in (*self._branches.values(), *self._retired):
                branch.close()

    def turn(self) -> None:
        if self._tee:
            self._idle.add_to(self._entry)

    def _on_idle(self) -> None:
        """Between two packets, for which it must not wait: without the lock."""
        open_ones = self._carrying() if self._is_rtp else self._uplinks
        for name, branch in tuple(self._branches.items()):
            branch.set_open(self._is_watched and name in open_ones)
        for branch in tuple(self._retired):
            branch.leave()

    def renew(self) -> None:
        """Make the branches of uplinks that have none, or whose device is another one now."""
        with self._lock:
            if self._tee is None:
                return
            for branch in [each for each in self._retired if each.has_left]:
                self._retired.remove(branch)
                branch.end()
            for name, uplink in self._uplinks.items():
                device, known = device_of(uplink), self._branches.get(name)
                if known is None or known.device != device:
                    self._replace(name, uplink, device)
        self.turn()

    def _replace(self, name: str, uplink: Uplink, device: int) -> None:
        former = self._branches.get(name)
        try:
            sockets = self._open_sockets(uplink, former.sockets.values() if former else ())
            senders = SenderFilter(*self._hosts)
            for own in sockets.values():
                senders.attach(own.get_fd())
        except OSError as error:
            self._on_fault(name, f"{uplink.interface or uplink.address}: {error.strerror}")
            return
        self._on_fault(name, "")
        assert self._tee
        self._branches[name] = _Branch(self._library, self._tee, sockets, senders, device, self._viewers.elements())
        if not self._is_rtp:
            self._branches[name].receive(self._sockets, self._feedback)
        if former:
            self._count(name, former.sent())
            self._retired.append(former)

    @property
    def _hosts(self) -> set[str]:
        """Of its viewers."""
        return {host for host, _ in +self._viewers}

    @property
    def _sockets(self) -> Sockets:
        """Of the library."""
        return {kind: used for kind in FAMILIES if (used := self._library.get_property(kind))}

    def _open_sockets(self, uplink: Uplink, former: Collection[Gio.Socket]) -> Sockets:
        """An uplink's sockets, with the ports of the library's: viewers' firewalls expect packets from these."""
        library = self._sockets
        with sharing_ports([*library.values(), *former]):
            opened = {
                kind: open_socket(uplink, FAMILIES[kind], used.get_local_address().get_port())
                for kind, used in library.items()
            }
        return {kind: own for kind, own in opened.items() if own}

    def note_error(self, sink: Gst.Element) -> None:
        for name, branch in tuple(self._branches.items()):
            if branch.sink is sink:
                self._count(name, UplinkSent(errors=1))

    def _count(self, name: str, counts: UplinkSent) -> None:
        with self._lock:
            self._before[name] = self._before[name].plus(counts)

    def counts(self) -> Mapping[str, UplinkSent]:
        with self._lock:
            if not self._is_rtp:
                return {name: UplinkSent(errors=each.errors) for name, each in self._before.items()}
            now = {name: branch.sent() for name, branch in self._branches.items()}
            return {name: before.plus(now.get(name, UplinkSent())) for name, before in self._before.items()}


class Feedback:
    """Lets each RTCP packet of a viewer pass once, who sends it by all uplinks: a request would be granted twice."""

    def __init__(self) -> None:
        self._passed: deque[tuple[Gst.Pad, bytes]] = deque(maxlen=REMEMBERED)

    def merge(self, exit: Gst.Pad) -> PassProbe:
        """Add what comes out of a pad."""
        return PassProbe(exit, self._passes)

    def _passes(self, exit: Gst.Pad, packet: PassingBuffer) -> bool:
        data = packet.extract(0, packet.size)
        if any(other is not exit and known == data for other, known in tuple(self._passed)):
            return False
        self._passed.append((exit, data))
        return True


class _Branch:
    """An uplink's sink behind a tee, closed at first.

    device   number of the device to which its sockets are bound
    senders  from which they receive: the viewers
    """

    def __init__(
        self,
        library: Gst.Element,
        tee: Gst.Element,
        sockets: Sockets,
        senders: SenderFilter,
        device: int,
        viewers: Iterator[Destination],
    ) -> None:
        self._pipeline, self._tee, self.sockets, self.device = tee.get_parent(), tee, sockets, device
        self.senders = senders
        self._valve, self._queue = map(Gst.ElementFactory.make, ("valve", "queue"))
        self.sink = Gst.ElementFactory.make("multiudpsink", f"{OWN}{next(_numbers)}")
        self._added = [self._valve, self._queue, self.sink]
        self._entries: list[Gst.Pad] = []  # of the library's funnel
        self._probes: list[PassProbe] = []
        for name, value in (("drop", True), ("drop-mode", "forward-sticky-events")):
            self._valve.set_property(name, value)
        copied = {name: library.get_property(name) for name in COPIED}
        for name, value in {**copied, **sockets, "async": False, "close-socket": False}.items():
            self.sink.set_property(name, value)
        for viewer in viewers:
            self.change("add", viewer)
        for element in self._added:
            self._pipeline.add(element)
        self._valve.link(self._queue)
        self._queue.link(self.sink)
        for element in reversed(self._added):
            element.sync_state_with_parent()
        _KEEPS_CAPS.add_to(self._valve.get_static_pad("sink"))
        self._exit = tee.request_pad_simple("src_%u")
        self._exit.link(self._valve.get_static_pad("sink"))

    def change(self, action: str, viewer: Destination) -> None:
        """Add or remove a viewer; without a socket of its family, it cannot be reached, and would end the pipeline."""
        if ("socket-v6" if ":" in viewer[0] else "socket") in self.sockets:
            self.sink.emit(action, *viewer)

    def set_open(self, is_open: bool) -> None:
        self._valve.set_property("drop", not is_open)

    def receive(self, library: Sockets, feedback: Feedback) -> None:
        """Receive at its sockets what the library receives at these, its own."""
        kinds = {used.get_fd(): kind for kind, used in library.items() if kind in self.sockets}
        for source in tuple(_elements(self._pipeline, "udpsrc")):
            kind = kinds.get(source.get_property("used-socket").get_fd())
            if kind:
                self._receive(self.sockets[kind], source)
                self._probes.append(feedback.merge(self._added[-1].get_static_pad("src")))

    def _receive(self, own: Gio.Socket, library: Gst.Element) -> None:
        source = Gst.ElementFactory.make("udpsrc")
        for name, value in (("socket", own), ("close-socket", False), ("caps", library.get_property("caps"))):
            source.set_property(name, value)
        entry = library.get_static_pad("src").get_peer().get_parent_element().request_pad_simple("sink_%u")
        self._pipeline.add(source)
        source.get_static_pad("src").link(entry)
        source.sync_state_with_parent()
        self._added.append(source)
        self._entries.append(entry)

    def sent_to(self, viewer: Destination) -> UplinkSent:
        stats = self.sink.emit("get-stats", *viewer)
        return UplinkSent(stats.get_value("packets-sent") or 0, stats.get_value("bytes-sent") or 0)

    def sent(self) -> UplinkSent:
        """To all its viewers."""
        total = UplinkSent()
        for each in filter(None, self.sink.get_property("clients").split(",")):
            host, _, port = each.rpartition(":")
            total = total.plus(self.sent_to((host, int(port))))
        return total

    @property
    def has_left(self) -> bool:
        return not self._exit.is_linked()

    def leave(self) -> None:
        """Take nothing more from the tee; between two packets, else one on its way would end the stream."""
        self._exit.unlink(self._valve.get_static_pad("sink"))

    def end(self) -> None:
        """Remove all elements, once it has left."""
        self._tee.release_request_pad(self._exit)
        for element in self._added:
            element.set_state(Gst.State.NULL)
            self._pipeline.remove(element)
        for entry in self._entries:
            entry.get_parent_element().release_request_pad(entry)
        self.close()

    def close(self) -> None:
        """Close its sockets, once nothing uses them."""
        self.senders.close()
        for own in self.sockets.values():
            own.close()


def _elements(pipeline: Gst.Bin, factory: str) -> Iterator[Gst.Element]:
    return (each for each in pipeline.children if each.get_factory() and each.get_factory().get_name() == factory)


def _tee_above(sink: Gst.Element) -> Gst.Element:
    """The tee in front of a sink of the library; between them is a queue if the library has several sinks."""
    element = sink
    while element.get_factory().get_name() != "tee":
        element = element.get_static_pad("sink").get_peer().get_parent_element()
    return element
