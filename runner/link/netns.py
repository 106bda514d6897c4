"""A link in the kernel: the vehicle in a network namespace of its own, its end of a veth pair limited by tbf.

The operator, its page and the broker stay in this machine's namespace. Everything that the vehicle sends shares the
limit: RTP, retransmissions, RTCP, RTSP, MQTT; the other way is free. tbf counts Ethernet frames, which is the IP packet
and 14 bytes. Each change of the rate fills tbf's bucket again: up to two frames more pass than the rate allows.
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
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from runner.errors import RunError
from runner.link.child import Child
from runner.link.ends import Ends, overrides
from runner.link.limit import Counters, Limit, burst_bytes, queue_bytes
from runner.model import Endpoint

NETWORK = ipaddress.IPv4Network("10.77.0.0/16")  # cut into pairs of addresses, one per link
DEVICE = "link0"  # the vehicle's end, in its namespace
CAP_NET_ADMIN, CAP_SYS_ADMIN = 12, 21  # linux/capability.h
DELAYED_PACKETS = 100_000  # netem drops what is more; the queue that may drop is tbf's
OTHERWISE = "or choose link=relay"


@contextmanager
def namespaced(limit: Limit, media: Endpoint, control: Endpoint) -> Iterator[Ends]:
    """The link while it is needed; what still runs in its namespace at the end is killed.

    media, control  their ports are used, on addresses of the link
    raises          RunError with what to do
    """
    ip, tc = _find("ip"), _find("tc")
    _check_allowed()
    with _claimed(ip) as (name, operator, vehicle):
        try:
            _connect(ip, name, operator, vehicle)
            shaper = _Tbf(tc, name, limit)
            try:
                both = overrides(Endpoint(vehicle, media.port), Endpoint(operator, control.port))
                yield Ends((ip, "netns", "exec", name), both, both, Endpoint(operator, control.port), shaper)
            finally:
                shaper.end()
        finally:
            _remove(ip, name)


class _Tbf:
    """tbf on the vehicle's end, behind netem where there is a delay. One tc runs all the time."""

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

    def limit(self, kbps: float) -> Counters:
        return self._set("change", kbps)

    def end(self) -> None:
        self._tc.end()

    def _set(self, verb: str, kbps: float) -> Counters:
        lines = [f"qdisc show dev {DEVICE}"]
        if kbps != self._kbps:
            size, most = burst_bytes(kbps), queue_bytes(kbps, self._queue_ms)
            tbf = f"tbf rate {round(1000 * kbps)}bit burst {size} limit {most}"
            lines.insert(0, f"qdisc {verb} dev {DEVICE} {self._parent} handle 2: {tbf}")
            self._kbps = kbps
        said = next(qdisc for qdisc in self._tc.ask(*lines) if qdisc["kind"] == "tbf")
        return Counters(8 * said["backlog"] / kbps, said["bytes"], said["packets"], said["drops"])


def _delay(tc: str, name: str, delay_ms: float) -> None:
    netem = ("root", "handle", "1:", "netem", "delay", f"{delay_ms}ms", "limit", str(DELAYED_PACKETS))
    try:
        _run(tc, "-netns", name, "qdisc", "add", "dev", DEVICE, *netem)
    except RunError:
        rule = "which the kernel of this machine has not (module sch_netem): set it to 0"
        raise RunError(f"link=netns with delay_ms={delay_ms:g} needs netem, {rule}, {OTHERWISE}") from None


def _connect(ip: str, name: str, operator: str, vehicle: str) -> None:
    """Make the namespace and the pair; afterwards both ends reach each other."""
    inside = (ip, "-netns", name)
    _run(ip, "netns", "add", name)
    _run(ip, "link", "add", name, "type", "veth", "peer", "name", DEVICE, "netns", name)
    _run(*inside, "link", "set", "dev", "lo", "up")
    for command, device, address in (((ip,), name, operator), (inside, DEVICE, vehicle)):
        with suppress(RunError):  # a kernel without IPv6 has no such setting, and nothing to say unasked
            _run(*command, "link", "set", "dev", device, "addrgenmode", "none")
        _run(*command, "link", "set", "dev", device, "address", _mac(address), "up")
        _run(*command, "addr", "add", f"{address}/30", "dev", device)
    # Nobody has to ask for addresses: an answer that is dropped would stop everything for a second.
    for command, device, other in (((ip,), name, vehicle), (inside, DEVICE, operator)):
        _run(*command, "neigh", "replace", other, "lladdr", _mac(other), "dev", device, "nud", "permanent")


def _remove(ip: str, name: str) -> None:
    """Remove a link and whatever still runs in it; what is not there need not be removed."""
    for pid in _said(ip, "netns", "pids", name).split():
        with suppress(ProcessLookupError):
            os.kill(int(pid), signal.SIGKILL)
    _said(ip, "link", "delete", "dev", name)  # with the namespace it would go, too, but some time later
    _said(ip, "netns", "delete", name)


@contextmanager
def _claimed(ip: str) -> Iterator[tuple[str, str, str]]:
    """A name and two addresses that nobody else uses: operator's end, vehicle's end.

    The claim is a bound abstract socket: the kernel lets go of it with the process, so whatever still bears a claimed
    name was left behind by a run that was killed, and is removed.
    """
    for number, network in enumerate(NETWORK.subnets(new_prefix=30)):
        operator, vehicle = map(str, network.hosts())
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as claim:
            try:
                claim.bind(f"\0tod-runner/{network}")
            except OSError as error:
                if error.errno != errno.EADDRINUSE:
                    raise
                continue
            _remove(ip, f"tod-{number}")
            if not {operator, vehicle} & _addresses(ip):
                yield f"tod-{number}", operator, vehicle
                return
    raise RunError(f"link=netns: every address of {NETWORK} is in use; end other runs, {OTHERWISE}")


def _addresses(ip: str) -> set[str]:
    """IPv4 addresses of this machine."""
    devices = json.loads(_run(ip, "-json", "-4", "addr", "show"))
    return {address["local"] for device in devices for address in device.get("addr_info", ())}


def _mac(address: str) -> str:
    """A locally administered Ethernet address made from an IPv4 address."""
    return ":".join(["02", "00", *(f"{byte:02x}" for byte in ipaddress.IPv4Address(address).packed)])


def _find(program: str) -> str:
    """Path of a program of iproute2, which Debian puts where only root looks."""
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
    """Standard output of a command. raises RunError with what it says where it fails"""
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        said = " ".join(done.stderr.split()) or f"status {done.returncode}"
        raise RunError(f"link=netns: {Path(command[0]).name} {' '.join(command[1:])}: {said}; {OTHERWISE[3:]}")
    return done.stdout


def _said(*command: str) -> str:
    """Standard output of a command that may fail."""
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout
