"""Network devices and routes of this machine, as `ip` of iproute2 lists them. For checks only."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from typing import Any

from runner.errors import RunError

COMMAND_S = 10.0  # how long a command may take
LOOPBACK = "lo"


def addresses_by_device() -> dict[str, tuple[str, ...]]:
    """All addresses of each device except the loopback's; those of its link alone are left out.

    raises  RunError if `ip` is not installed
    """
    found = _ip("address", "show") or []
    return {
        each["ifname"]: tuple(info["local"] for info in each["addr_info"] if info["scope"] == "global")
        for each in found
        if each["ifname"] != LOOPBACK
    }


def device_towards(host: str, *, source: str | None = None, device: str | None = None) -> str | None:
    """By which device packets to an address leave; None: there is no route.

    source  their own address
    device  that they are bound to
    raises  RunError if `ip` is not installed
    """
    given = [*(("from", source) if source else ()), *(("oif", device) if device else ())]
    found = _ip("route", "get", host, *given)
    if device and not _ip("route", "get", "fibmatch", host, *given) and _asks_neighbours(device):
        return None  # the kernel takes every host for a neighbour then, and none answers
    return str(found[0]["dev"]) if found else None


def _asks_neighbours(device: str) -> bool:
    """Whether a device, such as one of Ethernet, needs the hardware address of the next host."""
    (found,) = _ip("link", "show", "dev", device) or [{"flags": []}]
    return "NOARP" not in found["flags"]


def _ip(*words: str) -> list[dict[str, Any]] | None:
    """What a command lists; None: it failed."""
    # Debian installs it in a directory that is only in root's PATH.
    path = shutil.which("ip", path=f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin")
    if path is None:
        raise RunError("program ip, which lists network devices: on Debian, apt-get install iproute2")
    done = subprocess.run(
        [path, "-json", *words],
        capture_output=True,
        text=True,
        check=False,
        timeout=COMMAND_S,
        stdin=subprocess.DEVNULL,
    )
    return None if done.returncode else json.loads(done.stdout)
