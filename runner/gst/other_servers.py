"""RTSP servers at the addresses of the vehicle's uplinks: a viewer may connect by any of them, and one may be cut."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Mapping
from dataclasses import replace

from gi.repository import GLib, GstRtspServer

from runner.errors import RunError
from runner.settings import Endpoint
from runner.system.ports import check_port_free

LOOK_S = 1.0  # between two looks at the addresses
EVERYWHERE = ("0.0.0.0", "::")


class OtherServers:
    """Those beside the first one, while their addresses exist. To be used in one thread.

    make       returns a server for an address, which serves the same as the first one
    addresses  returns those at which viewers may connect now, each with the device by which they do, and are answered:
               without it ("") the routes decide, and may lead to another uplink
    first      where the first one listens
    on_report  called with "uplinks", and why a server cannot listen; once for each address
    """

    def __init__(
        self,
        make: Callable[[str], GstRtspServer.RTSPServer],
        addresses: Callable[[], Mapping[str, str]],
        first: Endpoint,
        on_report: Callable[[str, str], None],
    ) -> None:
        self._make, self._addresses, self._first, self._on_report = make, addresses, first, on_report
        self._attached: dict[str, int] = {}  # by address, the source by which its server accepts viewers
        self._failed: set[str] = set()
        self._looked = 0.0

    def look(self, now: float) -> None:
        """Follow the addresses; a few times a second. now: s by any steady clock."""
        if now - self._looked < LOOK_S or self._first.host in EVERYWHERE:
            return
        self._looked = now
        wanted = {address: device for address, device in self._addresses().items() if address != self._first.host}
        for address in self._attached.keys() - wanted.keys():
            GLib.source_remove(self._attached.pop(address))  # it lives as long as its viewers
        self._failed &= wanted.keys()
        for address in sorted(wanted.keys() - self._attached.keys() - self._failed):
            self._listen(address, wanted[address])

    def _listen(self, address: str, device: str) -> None:
        try:
            check_port_free(replace(self._first, host=address))
            self._attached[address] = _attach(self._make(address), device)
        except (RunError, OSError, GLib.Error) as error:
            self._failed.add(address)
            self._on_report("uplinks", f"viewers cannot connect to {address}: {error}")

    def stop(self) -> None:
        """Accept no more viewers."""
        for source in self._attached.values():
            GLib.source_remove(source)
        self._attached.clear()


def _attach(server: GstRtspServer.RTSPServer, device: str) -> int:
    """As `RTSPServer.attach`, with a socket that is bound to a device; returns the source by which it accepts viewers.

    raises  OSError, GLib.Error
    """
    listening = server.create_socket(None)
    if device:
        with socket.socket(fileno=os.dup(listening.get_fd())) as duplicate:
            duplicate.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, device.encode())

    def accept(_fd: int, condition: GLib.IOCondition) -> bool:
        return bool(GstRtspServer.RTSPServer.io_func(listening, condition, server))

    source: int = GLib.unix_fd_add_full(GLib.PRIORITY_DEFAULT, listening.get_fd(), GLib.IOCondition.IN, accept)
    return source
