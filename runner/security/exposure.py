"""Refuse to serve or to connect beyond this machine without keys."""

from __future__ import annotations

from ipaddress import ip_address
from pathlib import Path

from runner.core.model import Vehicle
from runner.errors import UserError
from runner.security.keyring import Keyring


def keyring_of(vehicle: Vehicle, *needed: str) -> Keyring | None:
    """The keys that a side's configuration names; None: it names none and needs none.

    needed  files that this side needs beyond those that every holder has
    raises  UserError if keys are missing although video or control leave this machine, or are incomplete
    """
    if vehicle.keys is not None:
        return Keyring.of(Path(vehicle.keys), *needed)
    reached = {"media.host": vehicle.media.host, "control.host": vehicle.control.host}
    exposed = [f"{key} {host}" for key, host in reached.items() if not is_loopback(host)]
    if exposed and not vehicle.insecure:
        rule = "are reached over a network: give keys=DIR, made by `tod-runner keys`, or insecure=true"
        raise UserError("command line", "keys", None, f"{' and '.join(exposed)} {rule}")
    return None


def is_loopback(host: str) -> bool:
    """Whether an address or name is of this machine only."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
