"""UDP sockets that accept packets from the vehicle only: a kernel filter, which also counts the packets it drops.

An RTSP client binds its RTP and RTCP sockets to all addresses, so any host that reaches the machine could inject
packets. No Python runs per packet.
"""

from __future__ import annotations

import ctypes
import ipaddress
import os
import socket
import struct
import time
from collections.abc import Iterable, Sequence
from pathlib import Path

IpAddress = ipaddress.IPv4Address | ipaddress.IPv6Address

PROC_NET = Path("/proc/self/net")  # /proc/net is hidden from services with ProcSubset=pid
SO_ATTACH_FILTER, SO_MEMINFO = 26, 55  # asm-generic/socket.h
MAX_WAITING = 100_000  # packets in a socket before its filter is attached; more than any buffer holds
MEMINFO_QUEUED, MEMINFO_BUFFER, MEMINFO_DROPS, MEMINFO_VALUES = 0, 1, 8, 9  # linux/sock_diag.h
PROMPT_S = 0.5  # a client's buffer holds more than what arrives in this time
# Classic BPF (linux/filter.h, bpf_common.h). Load offsets from NET on start at the IP header.
LOAD_BYTE, LOAD_WORD, SHIFT_RIGHT, JUMP_EQUAL, JUMP, RETURN = 0x30, 0x20, 0x74, 0x15, 0x05, 0x06
NET = 0xFFF00000
IPV4_SOURCE, IPV6_SOURCE = NET + 12, NET + 8
Instruction = tuple[int, int, int, int]  # code, jump if true, jump if false, operand


class SenderFilter:
    """The filter on all sockets of one client, for the client's lifetime.

    hosts   the only accepted senders, names or addresses
    raises  OSError if a name cannot be resolved
    """

    def __init__(self, *hosts: str) -> None:
        self._program = _program_for(hosts)
        self._sockets: dict[int, socket.socket] = {}  # by inode: duplicates, which outlive an element's own
        self._dropped = self._seen = 0
        self._overflows, self._checked = _overflows(), time.monotonic()

    def attach(self, descriptor: int) -> None:
        """Filter a bound socket; packets already waiting in it are discarded.

        raises  OSError if the system lacks such filters
        """
        inode = os.fstat(descriptor).st_ino
        if inode in self._sockets:
            return
        duplicate = socket.socket(fileno=os.dup(descriptor))
        self._sockets[inode] = duplicate
        _attach(duplicate, self._program)
        for _ in range(MAX_WAITING):
            if not _discard_packet(duplicate):
                break

    def admit(self, *hosts: str) -> None:
        """Accept these senders and no others from now on.

        raises  OSError
        """
        self._program = _program_for(hosts)
        for sock in tuple(self._sockets.values()):
            _attach(sock, self._program)

    def dropped(self) -> int:
        """Packets from other senders dropped so far; to be called a few times a second.

        The kernel's counter includes packets dropped at a full socket buffer. If that may have happened, for example
        after the process was stalled, all overflows on this machine since the last call are subtracted.
        """
        now, overflows = time.monotonic(), _overflows()
        infos = [_memory_info(sock) for sock in list(self._sockets.values())]
        seen = sum(info[MEMINFO_DROPS] for info in infos)
        full = any(2 * info[MEMINFO_QUEUED] > info[MEMINFO_BUFFER] for info in infos)
        other = overflows - self._overflows if full or now - self._checked > PROMPT_S else 0
        self._dropped += max(0, seen - self._seen - other)
        self._seen, self._overflows, self._checked = seen, overflows, now
        return self._dropped

    def close(self) -> None:
        """Close the duplicates when the client ends; the count is kept."""
        self.dropped()
        for sock in self._sockets.values():
            sock.close()
        self._sockets.clear()
        self._seen = 0


def _program_for(hosts: Iterable[str]) -> list[Instruction]:
    found = {str(entry[4][0]).partition("%")[0] for host in hosts for entry in socket.getaddrinfo(host, None)}
    return program(sorted(map(ipaddress.ip_address, found), key=str))


def program(senders: Iterable[IpAddress]) -> list[Instruction]:
    """A filter that accepts packets from these senders, over IPv4 and IPv6, and drops all others."""
    senders = list(senders)
    four = [step for sender in senders if sender.version == 4 for step in _accept_steps(sender, IPV4_SOURCE)]
    six = [step for sender in senders if sender.version == 6 for step in _accept_steps(sender, IPV6_SOURCE)]
    drop = (RETURN, 0, 0, 0)
    version = [(LOAD_BYTE, 0, 0, NET), (SHIFT_RIGHT, 0, 0, 4), (JUMP_EQUAL, 1, 0, 4), (JUMP, 0, 0, len(four) + 1)]
    return [*version, *four, drop, (JUMP_EQUAL, 1, 0, 6), drop, *six, drop]


def _accept_steps(sender: IpAddress, offset: int) -> list[Instruction]:
    """Accept a packet from this address, otherwise continue after these steps."""
    words = struct.unpack(f">{len(sender.packed) // 4}I", sender.packed)
    steps: list[Instruction] = []
    for index, word in enumerate(words):
        rest = 2 * (len(words) - index - 1) + 1  # steps to skip if this word differs
        steps += [(LOAD_WORD, 0, 0, offset + 4 * index), (JUMP_EQUAL, 0, rest, word)]
    return [*steps, (RETURN, 0, 0, 0xFFFFFFFF)]


def _attach(sock: socket.socket, steps: Sequence[Instruction]) -> None:
    code = ctypes.create_string_buffer(b"".join(struct.pack("HBBI", *step) for step in steps))
    sock.setsockopt(socket.SOL_SOCKET, SO_ATTACH_FILTER, struct.pack("HP", len(steps), ctypes.addressof(code)))


def _discard_packet(sock: socket.socket) -> bool:
    """Discard one waiting packet of a socket; returns whether there was one."""
    try:
        sock.recv(1, socket.MSG_DONTWAIT)
    except BlockingIOError:
        return False
    return True


def _memory_info(sock: socket.socket) -> tuple[int, ...]:
    return struct.unpack(f"{MEMINFO_VALUES}I", sock.getsockopt(socket.SOL_SOCKET, SO_MEMINFO, 4 * MEMINFO_VALUES))


def _overflows() -> int:
    """UDP packets dropped at full receive buffers on this machine so far, over IPv4 and IPv6; 0 if unknown."""
    try:
        names, values = (
            line.split() for line in (PROC_NET / "snmp").read_text().splitlines() if line.startswith("Udp:")
        )
        six = dict(line.split() for line in (PROC_NET / "snmp6").read_text().splitlines()) if _has_ipv6() else {}
    except OSError:
        return 0
    return int(dict(zip(names, values, strict=True))["RcvbufErrors"]) + int(six.get("Udp6RcvbufErrors", 0))


def _has_ipv6() -> bool:
    return (PROC_NET / "snmp6").exists()
