"""A link through the kernel: the vehicle in its own network namespace.

    vehicle's namespace link0 ---- runner.link.tunnel ---- tod-N this machine's namespace

Both devices are TUN devices of one process, which limits, delays and drops packets of any protocol in both directions.
Sizes are those of IP packets. The operator, its page and the broker stay in this machine's namespace, where Linux would
answer at the link's address to whoever is on any network of this machine: rules of routing limit that to the vehicle.
"""

from __future__ import annotations

import errno
import ipaddress
import json
import os
import random
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from runner.errors import RunError
from runner.link.child import Child, ChildShaper
from runner.link.ends import Ends, overrides
from runner.link.limit import Limit, TcpFlows
from runner.settings import Endpoint
from runner.system import children
from runner.system.signals import urgent

NETWORK = ipaddress.IPv4Network("10.77.0.0/16")  # split into a pair of addresses per link
LINK = "link0"  # the vehicle's device
RUN = Path("/run/netns")  # where ip keeps namespaces by name
TO_VEHICLE, TO_OTHERS = 7700, 7701  # priorities of the rules for packets from this machine's address of the link
CAP_NET_ADMIN, CAP_SYS_ADMIN = 12, 21  # linux/capability.h
COMMAND_S = 10.0  # how long a command of iproute2 may take
ALTERNATIVE = "or choose link=relay"


@contextmanager
def namespaced(limit: Limit, media: Endpoint, control: Endpoint, dials: bool = False) -> Iterator[Ends]:
    """The link, for the duration of the block; processes still running in its namespace at the end are killed.

    media, control  their ports are used, on addresses of the link
    dials           whether the vehicle dials the operator for media, as with SRT
    raises          RunError with the remedy
    """
    ip = check_possible()
    with _claimed_network(ip) as (name, network), urgent(lambda: _remove(ip, name, network)):
        machine, vehicle = map(str, network.hosts())
        devices = (name, f"{name}-far")
        inside = (ip, "netns", "exec", name)
        settings = {"devices": devices, "host": machine, **limit.directions()}
        try:
            with _child("tunnel", settings) as tunnel:
                port = tunnel.answer()["port"]
                _connect(ip, devices, (machine, vehicle))
                broker = Endpoint(machine, control.port)
                # As safe as loopback: only the two ends reach these addresses.
                ends = overrides(Endpoint(machine if dials else vehicle, media.port), broker)
                both = (*ends, f"insecure={network}")
                with _competing_flows(limit.tcp, (machine, port), inside) as (tcp, notes):
                    yield Ends(inside, both, both, broker, ChildShaper(tunnel, tcp), notes)
        finally:
            _remove(ip, name, network)


@contextmanager
def _child(module: str, settings: Mapping[str, Any], before: Sequence[str] = ()) -> Iterator[Child]:
    """A module of this package as a child process."""
    command = (*before, sys.executable, "-m", f"runner.link.{module}", json.dumps(settings))
    child = Child(module, command, children.environment())
    try:
        yield child
    finally:
        child.end()


@contextmanager
def _competing_flows(
    flows: TcpFlows | None, to: tuple[str, int], inside: Sequence[str]
) -> Iterator[tuple[Child | None, tuple[str, ...]]]:
    """The TCP flows from the vehicle's namespace, if any, and notes about them."""
    if flows is None:
        yield None, ()
        return
    with _child("tcp", {"to": to, **asdict(flows)}, inside) as tcp:
        congestion = tcp.answer()["congestion"]
        yield (
            tcp,
            (f"competing TCP flows: {flows.flows}, congestion control {congestion}",),
        )


def _connect(ip: str, devices: tuple[str, str], addresses: tuple[str, str]) -> None:
    """Create the namespace, and set up this machine's device and the vehicle's, which moves there."""
    (name, far), (machine, vehicle) = devices, addresses
    in_namespace = (ip, "-netns", name)
    _run(ip, "netns", "add", name)
    _run(*in_namespace, "link", "set", "dev", "lo", "up")
    _run(ip, "link", "set", "dev", far, "netns", name, "name", LINK)
    for command, device, own, peer in (((ip,), name, machine, vehicle), (in_namespace, LINK, vehicle, machine)):
        with suppress(RunError):  # a kernel without IPv6 lacks this setting, and sends nothing unprompted
            _run(*command, "link", "set", "dev", device, "addrgenmode", "none")
        _run(*command, "addr", "add", own, "peer", peer, "dev", device)
        _run(*command, "link", "set", "dev", device, "up")
    _run(ip, "rule", "add", "priority", str(TO_VEHICLE), "from", machine, "to", vehicle, "lookup", "main")
    _run(ip, "rule", "add", "priority", str(TO_OTHERS), "from", machine, "unreachable")


def _remove(ip: str, name: str, network: ipaddress.IPv4Network) -> None:
    """Remove a namespace, if it exists, with the rules of its addresses, and kill the processes still running in it."""
    try:
        identity = (RUN / name).stat().st_ino
    except FileNotFoundError:
        return
    machine, _ = map(str, network.hosts())
    for priority in (TO_VEHICLE, TO_OTHERS):
        _output_of(ip, "rule", "delete", "priority", str(priority), "from", machine)
    _output_of(ip, "netns", "delete", name)  # first, so that no more processes can enter
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


@contextmanager
def _claimed_network(ip: str) -> Iterator[tuple[str, ipaddress.IPv4Network]]:
    """A name and addresses that are not in use elsewhere.

    The search starts at random: connections of an earlier link whose other end no longer exists send to its addresses
    for minutes, and would enter a new link with the same ones.
    """
    networks = {f"tod-{number}": network for number, network in enumerate(NETWORK.subnets(new_prefix=30))}
    _remove_left_behind(ip, networks)
    names = [*networks]
    first = random.randrange(len(names))
    for name in names[first:] + names[:first]:
        with _claim(networks[name]) as is_free:
            if is_free and not any(address in networks[name] for address in _addresses(ip)):
                yield name, networks[name]
                return
    raise RunError(f"link=netns: every address of {NETWORK} is in use; end other runs, {ALTERNATIVE}")


def _remove_left_behind(ip: str, networks: Mapping[str, ipaddress.IPv4Network]) -> None:
    """Remove the namespaces of runs that were killed: those whose name is not claimed."""
    for name in networks.keys() & {path.name for path in RUN.glob("tod-*")}:
        with _claim(networks[name]) as is_free:
            if is_free:
                _remove(ip, name, networks[name])


@contextmanager
def _claim(network: ipaddress.IPv4Network) -> Iterator[bool]:
    """Claim addresses and the corresponding name machine-wide; yields whether they were free.

    The claim is a bound abstract socket, which the kernel releases with the process.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as claim:
        try:
            claim.bind(f"\0tod-runner/{network}")
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
            yield False
        else:
            yield True


def _addresses(ip: str) -> list[ipaddress.IPv4Address]:
    """IPv4 addresses of this machine."""
    devices = json.loads(_run(ip, "-json", "-4", "addr", "show"))
    addresses = (address["local"] for device in devices for address in device.get("addr_info", ()))
    return [ipaddress.IPv4Address(address) for address in addresses]


def check_possible() -> str:
    """raises RunError if this machine or its user cannot set up such a link; returns the path of ip"""
    ip = _find("ip")
    _check_allowed()
    return ip


def _find(program: str) -> str:
    """Path of a program of iproute2, which Debian installs in a directory that is only in root's PATH."""
    path = shutil.which(program, path=f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin")
    if path is None:
        raise RunError(f"link=netns needs {program}; on Debian: apt-get install iproute2, {ALTERNATIVE}")
    return path


def _check_allowed() -> None:
    status = Path("/proc/self/status").read_text()
    effective = next(int(line.split()[1], 16) for line in status.splitlines() if line.startswith("CapEff:"))
    if not all(effective >> capability & 1 for capability in (CAP_NET_ADMIN, CAP_SYS_ADMIN)):
        rule = "run as root (CAP_NET_ADMIN and CAP_SYS_ADMIN)"
        raise RunError(f"link=netns may not make a network namespace: {rule}, {ALTERNATIVE}")


def _run(*command: str) -> str:
    """Standard output of a command. raises RunError with its error output if it fails"""
    done = _done(command)
    if done.returncode:
        message = " ".join(done.stderr.split()) or f"status {done.returncode}"
        raise RunError(f"link=netns: {Path(command[0]).name} {' '.join(command[1:])}: {message}; {ALTERNATIVE[3:]}")
    return done.stdout


def _output_of(*command: str) -> str:
    """Standard output of a command that may fail."""
    return _done(command).stdout


def _done(command: Sequence[str]) -> subprocess.CompletedProcess[str]:
    try:
        return subprocess.run(command, capture_output=True, text=True, check=False, timeout=COMMAND_S)
    except subprocess.TimeoutExpired:
        raise RunError(f"link=netns: {' '.join(command)}: has not ended within {COMMAND_S:g} s") from None
