"""Addresses of network devices."""

from __future__ import annotations

import socket

from runner.system.interfaces import addresses_of


def test_a_device_has_its_own_addresses_and_one_that_is_missing_none() -> None:
    assert (addresses_of("lo"), addresses_of("missing0")) == (("127.0.0.1",), ())


def test_its_address_is_the_one_that_it_sends_from() -> None:
    """Of the device of the default route, if there is one."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect(("127.0.0.1", 9))
        assert probe.getsockname()[0] in addresses_of("lo")
