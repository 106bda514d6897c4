"""UDP sockets that send by one uplink, whatever the routes say."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager

from gi.repository import Gio

from runner.settings import Uplink
from runner.system.interfaces import number_of

ANY = {socket.AF_INET: "0.0.0.0", socket.AF_INET6: "::"}


def device_of(uplink: Uplink) -> int:
    """Number of an uplink's device, 0 while there is none.

    Sockets that are bound to an address alone need not be made anew.
    """
    return -1 if uplink.interface is None else number_of(uplink.interface)


def open_socket(uplink: Uplink, family: int, port: int) -> Gio.Socket | None:
    """A socket of an uplink; None if its address is of the other family. Others may be bound to the port meanwhile.

    raises  OSError
    """
    if uplink.address and (":" in uplink.address) != (family == socket.AF_INET6):
        return None
    with ExitStack() as failing:
        own = failing.enter_context(socket.socket(family, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC))
        own.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if family == socket.AF_INET6:
            own.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
        if uplink.interface:
            own.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, uplink.interface.encode())
        own.bind((uplink.address or ANY[socket.AddressFamily(family)], port))
        own.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 0)
        return Gio.Socket.new_from_fd(own.detach())


@contextmanager
def sharing_ports(sockets: Iterable[Gio.Socket]) -> Iterator[None]:
    """Let other sockets be bound to the same ports, for the duration of the block: not those of other programs."""
    with ExitStack() as stack:
        duplicates = [stack.enter_context(socket.socket(fileno=os.dup(each.get_fd()))) for each in sockets]
        for value in (1, 0):
            for duplicate in duplicates:
                duplicate.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, value)
            if value:
                yield
