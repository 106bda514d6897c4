"""What `doctor` finds about the uplinks of a vehicle."""

from __future__ import annotations

import socket
from collections.abc import Iterator, Mapping
from ipaddress import ip_address
from typing import NamedTuple

from runner.errors import RunError, suggest
from runner.settings import Uplink
from runner.system.devices import addresses_by_device, device_towards

Devices = Mapping[str, tuple[str, ...]]  # addresses by name


class Diagnosis(NamedTuple):
    """The result of one check."""

    fine: bool
    what: str


def check_uplinks(uplinks: Mapping[str, Uplink], control_host: str) -> Iterator[Diagnosis]:
    """Whether each has its device, an address and a route to the control link's host, and no two have one device."""
    if not uplinks:
        return
    try:
        devices = addresses_by_device()
    except RunError as error:
        yield Diagnosis(False, str(error))
        return
    host, used = _remote(control_host), dict[str, list[str]]()
    for name, uplink in uplinks.items():
        problem = _absent(uplink, devices)
        device = None if problem else _leaves_by(uplink, devices, host)
        if device is None:
            problem = problem or f"no route from {uplink.interface or uplink.address} to the control link's host {host}"
        else:
            used.setdefault(device, []).append(name)
        address = uplink.address or ", ".join(devices.get(uplink.interface or "", ()))
        route = f", has a route to {host}" if host else ""
        yield Diagnosis(problem is None, f"uplink {name}: {problem or f'{device}, {address}{route}'}")
    for device, names in used.items():
        if names[1:]:
            yield Diagnosis(False, f"uplinks {' and '.join(names)} leave through one device, {device}")


def _absent(uplink: Uplink, devices: Devices) -> str | None:
    """Why an uplink has no device or address; None: it has both."""
    interface, address = uplink.interface, uplink.address
    if interface and interface not in devices:
        return f"there is no interface {interface}{suggest(interface, devices)}"
    own = devices[interface] if interface else [each for known in devices.values() for each in known]
    if address and address not in own:
        where = interface or "this machine"
        return f"{address} is no address of {where}; it has {', '.join(own) or 'none'}"
    return None if own else f"{interface} has no address: is its modem connected?"


def _leaves_by(uplink: Uplink, devices: Devices, host: str | None) -> str | None:
    """The device by which an uplink leaves, towards the host if it is known; None: there is no route."""
    if host:
        return device_towards(host, source=uplink.address, device=uplink.interface)
    return uplink.interface or next(name for name, known in devices.items() if uplink.address in known)


def _remote(host: str) -> str | None:
    """The address of a host; None: it is this machine, or its name is not known here."""
    try:
        found = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)[0][4][0]
    except OSError:
        return None
    return None if ip_address(found).is_loopback else str(found)
