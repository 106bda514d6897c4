"""A link in the kernel: the vehicle in its own network namespace, behind a router whose egress is limited by tbf.

    vehicle's namespace link0 ---- in0 router's namespace out0 (tbf) ---- tod-N this machine's namespace

The operator, its page and the broker stay in this machine's namespace. Everything that the vehicle sends shares the
limit: RTP, retransmissions, RTCP, RTSP, MQTT; the other direction is unlimited. tbf counts Ethernet frames, i.e. the IP
packet plus 14 bytes. Each rate change refills tbf's bucket: up to two frames more pass than the rate allows.

Without the router a queued packet would count against the send buffer of its socket: once that is full (some 90
packets) the camera's pipeline would block, whereas behind a modem packets are lost.
"""

from __future__ import annotations

import errno
import ipaddress
import json
import os
import shutil
import signal
import socket
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from runner.core.model import Endpoint
from runner.errors import RunError
from runner.link.child import Child
from runner.link.ends import Ends, overrides
from runner.link.limit import Limit, LinkCounters, burst_bytes, queue_bytes
from runner.system.signals import urgent

NETWORK = ipaddress.IPv4Network("10.77.0.0/16")  # split into two pairs of addresses per link
LINK, IN, OUT = "link0", "in0", "out0"  # devices of vehicle and router
RUN = Path("/run/netns")  # where ip keeps namespaces by name
CAP_NET_ADMIN, CAP_SYS_ADMIN = 12, 21  # linux/capability.h
DELAYED_PACKETS = 100_000  # netem drops beyond this; only tbf's queue is meant to drop
COMMAND_S = 10.0  # how long a command of iproute2 may take
OTHERWISE = "or choose link=relay"


@contextmanager
def namespaced(limit: Limit, media: Endpoint, control: Endpoint) -> Iterator[Ends]:
    """The link, for the duration of the block; processes still running in its namespace at the end are killed.

    media, control  their ports are used, on addresses of the link
    raises          RunError with the remedy
    """
    _check_supported(limit)
    ip, tc = _find("ip"), _find("tc")
    _check_allowed()
    with _claimed(ip) as (name, network), urgent(lambda: _remove(ip, name)):
        try:
            machine, vehicle = _connect(ip, name, network)
            shaper = _Tbf(tc, _router(name), limit)
            try:
                broker = Endpoint(machine, control.port)
                both = overrides(Endpoint(vehicle, media.port), broker)
                yield Ends((ip, "netns", "exec", name), both, both, broker, shaper)
            finally:
                shaper.end()
        finally:
            _remove(ip, name)


def _check_supported(limit: Limit) -> None:
    """raises RunError for what only the relay does"""
    for key, given in (("loss", limit.loss), ("reverse", limit.reverse)):
        if given:
            raise RunError(f"link=netns: {key} is not supported, {OTHERWISE}")


class _Tbf:
    """tbf on the router's egress, behind netem if there is a delay. One tc process runs all the time."""

    def __init__(self, tc: str, name: str, limit: Limit) -> None:
        self._queue_ms, self._kbps = limit.queue_ms, 0.0
        self._parent = "parent 1:1" if limit.delay_ms else "root"
        if limit.delay_ms:
            _delay(tc, name, limit.delay_ms)
        self._tc = Child("tc", (tc, "-netns", name, "-statistics", "-json", "-force", "-batch", "-"))
        try:
            self._set("add", limit.kbps(0))
        except RunError as error:
            self.end()
            raise RunError(f"link=netns: {error}; use a kernel that has tbf (module sch_tbf), {OTHERWISE}") from None

    def limit(self, kbps: float) -> LinkCounters:
        return self._set("change", kbps)

    def check(self) -> None:
        self._tc.check()

    def end(self) -> None:
        self._tc.end()

    def _set(self, verb: str, kbps: float) -> LinkCounters:
        lines = [f"qdisc show dev {OUT}"]
        if kbps != self._kbps:
            size, most = burst_bytes(kbps), queue_bytes(kbps, self._queue_ms)
            tbf = f"tbf rate {round(1000 * kbps)}bit burst {size} limit {most}"
            lines.insert(0, f"qdisc {verb} dev {OUT} {self._parent} handle 2: {tbf}")
            self._kbps = kbps
        counts = next(qdisc for qdisc in self._tc.ask(*lines) if qdisc["kind"] == "tbf")
        return LinkCounters(8 * counts["backlog"] / kbps, counts["bytes"], counts["packets"], counts["drops"])


def _delay(tc: str, name: str, delay_ms: float) -> None:
    netem = ("root", "handle", "1:", "netem", "delay", f"{delay_ms}ms", "limit", str(DELAYED_PACKETS))
    try:
        _run(tc, "-netns", name, "qdisc", "add", "dev", OUT, *netem)
    except RunError:
        rule = "which the kernel of this machine has not (module sch_netem): set it to 0"
        raise RunError(f"link=netns with delay_ms={delay_ms:g} needs netem, {rule}, {OTHERWISE}") from None


def _connect(ip: str, name: str, network: ipaddress.IPv4Network) -> tuple[str, str]:
    """Create and connect both namespaces; returns the addresses of this machine's end and of the vehicle's."""
    near, far = network.subnets(prefixlen_diff=1)
    (machine, out), (into, vehicle) = (map(str, pair.hosts()) for pair in (near, far))
    router = _router(name)
    at_machine, at_router, at_vehicle = (ip,), (ip, "-netns", router), (ip, "-netns", name)
    for namespace in (name, router):
        _run(ip, "netns", "add", namespace)
        _run(ip, "-netns", namespace, "link", "set", "dev", "lo", "up")
    _run(*at_machine, "link", "add", name, "type", "veth", "peer", "name", OUT, "netns", router)
    _run(*at_router, "link", "add", IN, "type", "veth", "peer", "name", LINK, "netns", name)
    _join((at_machine, name, machine), (at_router, OUT, out))
    _join((at_router, IN, into), (at_vehicle, LINK, vehicle))
    _run(ip, "netns", "exec", router, "sh", "-c", "echo 1 > /proc/sys/net/ipv4/ip_forward")
    _run(*at_machine, "route", "add", str(far), "via", out)
    _run(*at_vehicle, "route", "add", str(near), "via", into)
    return machine, vehicle


_End = tuple[tuple[str, ...], str, str]  # ip in the right namespace, device, address


def _join(one: _End, other: _End) -> None:
    """Let two ends of a pair reach each other."""
    for command, device, address in (one, other):
        with suppress(RunError):  # a kernel without IPv6 has no such setting, and sends nothing unprompted
            _run(*command, "link", "set", "dev", device, "addrgenmode", "none")
        _run(*command, "link", "set", "dev", device, "address", _mac(address), "up")
        _run(*command, "addr", "add", f"{address}/30", "dev", device)
    # Static entries make ARP unnecessary: a dropped reply would stop all traffic for a second.
    for (command, device, _), (_, _, peer) in ((one, other), (other, one)):
        _run(*command, "neigh", "replace", peer, "lladdr", _mac(peer), "dev", device, "nud", "permanent")


def _remove(ip: str, name: str) -> None:
    """Remove a link and kill the processes still running in it; missing parts are skipped."""
    _output_of(ip, "link", "delete", "dev", name)  # it would also go with the namespace, but some time later
    for namespace in (name, _router(name)):
        try:
            identity = (RUN / namespace).stat().st_ino
        except FileNotFoundError:
            continue
        _output_of(ip, "netns", "delete", namespace)  # first, so that no process can enter any more
        for pid in _inside(identity):
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)


def _inside(identity: int) -> Iterator[int]:
    """Processes in a network namespace, identified by its inode; none if that is this process's own."""
    if identity == Path("/proc/self/ns/net").stat().st_ino:
        return
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # it has ended meanwhile
            if (process / "ns" / "net").stat().st_ino == identity:
                yield int(process.name)


def _router(name: str) -> str:
    """The router's namespace."""
    return f"{name}-router"


@contextmanager
def _claimed(ip: str) -> Iterator[tuple[str, ipaddress.IPv4Network]]:
    """A name and addresses that are not in use elsewhere.

    The claim is a bound abstract socket: the kernel releases it with the process, so anything that still bears a
    claimed name was left behind by a run that was killed, and is removed.
    """
    for number, network in enumerate(NETWORK.subnets(new_prefix=29)):
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as claim:
            try:
                claim.bind(f"\0tod-runner/{network}")
            except OSError as error:
                if error.errno != errno.EADDRINUSE:
                    raise
                continue
            _remove(ip, f"tod-{number}")
            if not any(address in network for address in _addresses(ip)):
                yield f"tod-{number}", network
                return
    raise RunError(f"link=netns: every address of {NETWORK} is in use; end other runs, {OTHERWISE}")


def _addresses(ip: str) -> list[ipaddress.IPv4Address]:
    """IPv4 addresses of this machine."""
    devices = json.loads(_run(ip, "-json", "-4", "addr", "show"))
    addresses = (address["local"] for device in devices for address in device.get("addr_info", ()))
    return [ipaddress.IPv4Address(address) for address in addresses]


def _mac(address: str) -> str:
    """A locally administered Ethernet address derived from an IPv4 address."""
    return ":".join(["02", "00", *(f"{byte:02x}" for byte in ipaddress.IPv4Address(address).packed)])


def _find(program: str) -> str:
    """Path of a program of iproute2, which Debian installs in a directory that is only in root's PATH."""
    path = shutil.which(program, path=f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin")
    if path is None:
        raise RunError(f"link=netns needs {program}; on Debian: apt-get install iproute2, {OTHERWISE}")
    return path


def _check_allowed() -> None:
    status = Path("/proc/self/status").read_text()
    effective = next(int(line.split()[1], 16) for line in status.splitlines() if line.startswith("CapEff:"))
    if not all(effective >> capability & 1 for capability in (CAP_NET_ADMIN, CAP_SYS_ADMIN)):
        rule = "run as root (CAP_NET_ADMIN and CAP_SYS_ADMIN)"
        raise RunError(f"link=netns may not make a network namespace: {rule}, {OTHERWISE}")


def _run(*command: str) -> str:
    """Standard output of a command. raises RunError with its error output if it fails"""
    done = _done(command)
    if done.returncode:
        message = " ".join(done.stderr.split()) or f"status {done.returncode}"
        raise RunError(f"link=netns: {Path(command[0]).name} {' '.join(command[1:])}: {message}; {OTHERWISE[3:]}")
    return done.stdout


def _output_of(*command: str) -> str:
    """Standard output of a command that may fail."""
    return _done(command).stdout


def _done(command: Sequence[str]) -> subprocess.CompletedProcess[str]:
    try:
        return subprocess.run(command, capture_output=True, text=True, check=False, timeout=COMMAND_S)
    except subprocess.TimeoutExpired:
        raise RunError(f"link=netns: {' '.join(command)}: has not ended within {COMMAND_S:g} s") from None
