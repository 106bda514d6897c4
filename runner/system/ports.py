"""Addresses of servers, and whether one may listen at its own."""

from __future__ import annotations

import socket

from runner.errors import RunError, os_errors_as
from runner.settings import Endpoint


def ip_address_of(host: str) -> str:
    """The address of a name, IPv4 if it has both kinds; raises OSError."""
    found = sorted((family, address[0]) for family, *_, address in socket.getaddrinfo(host, None))  # AF_INET is first
    return str(found[0][1])


def check_port_free(endpoint: Endpoint, key: str = "port") -> None:
    """Check that this process could listen there.

    key     of the configuration that states the port
    raises  RunError if another process already listens there, or the address is not one of this machine
    """
    with os_errors_as(lambda why: RunError(f"cannot listen on {endpoint}: {why}; choose another {key}")):
        address = ip_address_of(endpoint.host)
        with socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((address, endpoint.port))
