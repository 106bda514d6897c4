"""Network devices: their numbers and IP addresses."""

from __future__ import annotations

import socket
import struct
from contextlib import suppress
from fcntl import ioctl
from ipaddress import IPv6Address
from pathlib import Path

from runner.settings import Uplink

SIOCGIFADDR, IFREQ = 0x8915, "16s2xH4s16x"  # linux/sockios.h; struct ifreq with a struct sockaddr_in
IF_INET6, GLOBAL = Path("/proc/self/net/if_inet6"), "00"  # scope there


def number_of(interface: str) -> int:
    """Of a device; 0: there is none. One that comes back has another number."""
    try:
        return socket.if_nametoindex(interface)
    except OSError:
        return 0


def addresses_of(interface: str) -> tuple[str, ...]:
    """The address by which packets leave that are bound to the device alone: IPv4, then IPv6, as far as it has them."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe, suppress(OSError):
        answer = ioctl(probe, SIOCGIFADDR, struct.pack(IFREQ, interface.encode(), 0, bytes(4)))
        return (socket.inet_ntoa(struct.unpack(IFREQ, answer)[2]), *_ipv6_of(interface))
    return tuple(_ipv6_of(interface))


def addresses_by(uplink: Uplink) -> tuple[str, ...]:
    """From which packets may come that leave by an uplink: none while its device is missing or has none."""
    return (uplink.address,) if uplink.address else addresses_of(uplink.interface or "")


def _ipv6_of(interface: str) -> list[str]:
    with suppress(OSError):  # a kernel without IPv6
        lines = (line.split() for line in IF_INET6.read_text().splitlines())
        return [
            str(IPv6Address(bytes.fromhex(address)))
            for address, _index, _length, scope, _flags, device in lines
            if (device, scope) == (interface, GLOBAL)
        ]
    return []
