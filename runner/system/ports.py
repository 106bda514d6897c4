"""Whether a server may listen at its configured address."""

from __future__ import annotations

import socket

from runner.core.model import Endpoint
from runner.errors import RunError


def check_port_free(endpoint: Endpoint) -> None:
    """raises RunError if another process already listens there, or the address is not one of this machine"""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((endpoint.host, endpoint.port))
        except OSError as error:
            what = error.strerror.lower() if error.strerror else str(error)
            raise RunError(f"cannot listen on {endpoint.host}:{endpoint.port}: {what}; choose another port") from None
