"""State for the service manager: systemd's sd_notify(3) protocol, which others also support."""

from __future__ import annotations

import os
import socket
from contextlib import suppress


def is_managed() -> bool:
    """Whether a service manager runs this process, and will start it again whenever it ends."""
    return bool(os.environ.get("NOTIFY_SOCKET"))


def notify(state: str) -> None:
    """Send a state to the service manager; without one nothing happens.

    state  READY=1 once the service works, WATCHDOG=1 while it does, STOPPING=1 when shutdown begins
    """
    address = os.environ.get("NOTIFY_SOCKET")
    if not address:
        return
    with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as manager:
        manager.sendto(state.encode(), address.replace("@", "\0", 1) if address.startswith("@") else address)
