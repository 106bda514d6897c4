"""The filter on the operator's UDP sockets, with plain sockets."""

from __future__ import annotations

import ipaddress
import socket
import struct
from contextlib import ExitStack

import pytest

from runner.gst.sender_filter import SenderFilter, program

pytestmark = pytest.mark.gst  # the package runner.gst loads it


def bound(family, address):
    taken = socket.socket(family, socket.SOCK_DGRAM)
    if family == socket.AF_INET6:
        taken.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 0)
    taken.bind((address, 0))
    taken.setblocking(False)
    return taken


def waiting(taken):
    received = []
    while True:
        try:
            received.append(taken.recv(2000))
        except BlockingIOError:
            return received


@pytest.mark.parametrize(("family", "everywhere"), [(socket.AF_INET, "0.0.0.0"), (socket.AF_INET6, "::")])
def test_only_one_sender_is_received_and_the_others_are_counted(family, everywhere):
    with (
        bound(family, everywhere) as ours,
        bound(socket.AF_INET, "127.0.0.1") as vehicle,
        bound(socket.AF_INET, "127.0.0.2") as stranger,
    ):
        there = ("127.0.0.1", ours.getsockname()[1])
        stranger.sendto(b"early", there)
        senders = SenderFilter("127.0.0.1")
        senders.attach(ours.fileno())
        senders.attach(ours.fileno())  # the same socket once more
        for number in range(5):
            vehicle.sendto(b"%d" % number, there)
            stranger.sendto(b"late", there)
        assert waiting(ours) == [b"0", b"1", b"2", b"3", b"4"]
        assert senders.dropped() == 5
        senders.close()
        assert senders.dropped() == 5


def test_the_senders_may_change_and_be_several():
    with ExitStack() as stack:
        ours, *senders = (stack.enter_context(bound(socket.AF_INET, f"127.0.0.{number}")) for number in (1, 2, 3, 4))
        there = ("127.0.0.1", ours.getsockname()[1])
        admitted = SenderFilter("127.0.0.2", "127.0.0.3")
        admitted.attach(ours.fileno())
        for number, hosts in enumerate((("127.0.0.2", "127.0.0.3"), ("127.0.0.3", "127.0.0.4"), ("127.0.0.4",))):
            admitted.admit(*hosts)
            for name, sender in zip("abc", senders, strict=True):
                sender.sendto(f"{name}{number}".encode(), there)
        assert waiting(ours) == [b"a0", b"b0", b"b1", b"c1", b"c2"]
        assert admitted.dropped() == 4
        admitted.close()


def test_packets_of_the_vehicle_dropped_at_a_full_buffer_are_not_counted():
    with bound(socket.AF_INET, "0.0.0.0") as ours, bound(socket.AF_INET, "127.0.0.1") as vehicle:
        senders = SenderFilter("127.0.0.1")
        senders.attach(ours.fileno())
        for _ in range(2000):
            vehicle.sendto(bytes(1200), ("127.0.0.1", ours.getsockname()[1]))
        assert senders.dropped() == 0
        assert len(waiting(ours)) < 2000
        assert senders.dropped() == 0
        senders.close()


def test_ipv6_senders_are_distinguished():
    with (
        bound(socket.AF_INET6, "::") as ours,
        bound(socket.AF_INET6, "::1") as vehicle,
        bound(socket.AF_INET, "127.0.0.1") as stranger,
    ):
        senders = SenderFilter("::1")
        senders.attach(ours.fileno())
        port = ours.getsockname()[1]
        vehicle.sendto(b"six", ("::1", port))
        stranger.sendto(b"four", ("127.0.0.1", port))
        assert waiting(ours) == [b"six"]
        assert senders.dropped() == 1
        senders.close()


def run(steps, packet):
    """Run a filter as the kernel does; packet from the IP header on."""
    net, held, at = 0xFFF00000, 0, 0
    while True:
        code, if_true, if_false, operand = steps[at]
        at += 1
        if code == 0x30:
            held = packet[operand - net]
        elif code == 0x20:
            (held,) = struct.unpack_from(">I", packet, operand - net)
        elif code == 0x74:
            held >>= operand
        elif code == 0x15:
            at += if_true if held == operand else if_false
        elif code == 0x05:
            at += operand
        else:
            return operand != 0


def test_many_addresses_of_both_kinds():
    senders = [ipaddress.ip_address(f"10.0.{n // 100}.{n % 100}") for n in range(300)]
    senders += [ipaddress.ip_address(f"2001:db8::{n:x}") for n in range(300)]
    steps = program(senders)

    def packet(address):
        if address.version == 4:
            return bytes([0x45]) + bytes(11) + address.packed + bytes(4)
        return bytes([0x60]) + bytes(7) + address.packed + bytes(16)

    assert all(run(steps, packet(sender)) for sender in senders)
    for stranger in ("10.0.9.9", "10.0.3.0", "2001:db8::12c", "2001:db9::1", "::"):
        assert not run(steps, packet(ipaddress.ip_address(stranger)))
