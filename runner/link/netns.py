"""A link through the kernel: the vehicle in its own network namespace.

    vehicle's namespace link0 ---- runner.link.tunnel ---- tod-N this machine's namespace

A link of lanes has such a pair, with a process, for each of them. In the vehicle's namespace each is a device with the
lane's name and an address of its own; all reach this machine's one address. A socket that is bound to such a device or
address uses that lane or none: packets of a lane that is down never leave by another. Other sockets use the first lane
that is up.

Both devices are TUN devices of one process, which limits, delays and drops packets of any protocol in both directions.
Sizes are those of IP packets. The operator, its page and the broker stay in this machine's namespace, where Linux would
answer at the link's address to whoever is on any network of this machine: rules of routing limit that to the vehicle.
"""

from __future__ import annotations

import fcntl
import ipaddress
import json
import os
import random
import signal
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from runner.errors import RunError
from runner.link.child import Child, ChildShaper
from runner.link.ends import Ends, overrides
from runner.link.iproute import ALTERNATIVE, find, run, succeeds
from runner.link.lane import Lane, LaneShaper
from runner.link.limit import Limit, Shaper, TcpFlows
from runner.settings import Endpoint
from runner.system import children
from runner.system.signals import urgent

LOCKS = Path("/run/tod-runner-links")  # files that stand for the links of running processes
NETWORK = ipaddress.IPv4Network("10.77.0.0/16")  # split into a network per link
PREFIX = 28  # of that: room for this machine's address and MOST_ADDRESSES of the vehicle
LINK = "link0"  # the vehicle's device
RUN = Path("/run/netns")  # where ip keeps namespaces by name
TO_VEHICLE, TO_OTHERS = 7700, 7701  # priorities of the rules for packets from this machine's address of the link
CAP_NET_ADMIN, CAP_SYS_ADMIN = 12, 21  # linux/capability.h


@contextmanager
def namespaced(limits: Mapping[str, Limit], media: Endpoint, control: Endpoint, dials: bool = False) -> Iterator[Ends]:
    """The link, for the duration of the block; processes still running in its namespace at the end are killed.

    limits          by lane; "": that of a link without lanes
    media, control  their ports are used, on addresses of the link
    dials           whether the vehicle dials the operator for media, as with SRT
    raises          RunError with the remedy
    """
    ip = check_possible()
    with _claimed_network(ip) as (name, network), urgent(lambda: _remove(ip, name, network)), ExitStack() as stack:
        stack.callback(_remove, ip, name, network)
        lanes = list(_lanes(limits, name, network))
        tunnels = [stack.enter_context(_tunnel(*each)) for each in zip(lanes, limits.values(), strict=True)]
        ports = [tunnel.answer()["port"] for tunnel in tunnels]
        _connect(ip, name, lanes, has_lanes="" not in limits)
        machine, vehicle = lanes[0].machine, lanes[0].addresses[0]
        broker = Endpoint(machine, control.port)
        # As safe as loopback: only the two ends reach these addresses.
        ends = overrides(Endpoint(machine if dials else vehicle, media.port), broker)
        both = (*ends, f"insecure={network}")
        inside = (ip, "netns", "exec", name)
        flows = next(iter(limits.values())).tcp
        tcp, notes = stack.enter_context(_competing_flows(flows, (machine, ports[0]), inside))
        plain = [ChildShaper(tunnels[0], tcp), *map(ChildShaper, tunnels[1:])]
        shapers: dict[str, Shaper] = {
            key: LaneShaper(shaper, lane, (ip, "-netns", name)) if key else shaper
            for key, shaper, lane in zip(limits, plain, lanes, strict=True)
        }
        yield Ends(inside, both, both, broker, shapers, notes)


def _lanes(limits: Mapping[str, Limit], name: str, network: ipaddress.IPv4Network) -> Iterator[Lane]:
    """The lanes of a link, each with as many addresses as it will use."""
    machine, *free = map(str, network.hosts())
    for number, (device, limit) in enumerate(limits.items()):
        needed = 1 + limit.moves()
        own, free = free[:needed], free[needed:]
        here, far = (f"{name}-{number}", f"{name}-far{number}") if number else (name, f"{name}-far")
        yield Lane(number, device or LINK, here, far, machine, own)


def _tunnel(lane: Lane, limit: Limit) -> AbstractContextManager[Child]:
    return _child("tunnel", {"devices": (lane.here, lane.far), "host": lane.machine, **limit.directions()})


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


def _connect(ip: str, name: str, lanes: Sequence[Lane], *, has_lanes: bool) -> None:
    """Create the namespace, and set up devices, routes and rules on both sides.

    has_lanes  whether packets choose one by their source address
    """
    inside = (ip, "-netns", name)
    run(ip, "netns", "add", name)
    run(*inside, "link", "set", "dev", "lo", "up")
    for lane in lanes:
        lane.connect(ip, name)
        if has_lanes:
            lane.connect_routes(inside)
    own = f"from {lanes[0].machine}"
    for address in (address for lane in lanes for address in lane.addresses):
        run(ip, *f"rule add priority {TO_VEHICLE} {own} to {address} lookup main".split())
    run(ip, *f"rule add priority {TO_OTHERS} {own} unreachable".split())


def _remove(ip: str, name: str, network: ipaddress.IPv4Network) -> None:
    """Remove a namespace, if it exists, with the rules of its addresses, and kill the processes still running in it."""
    try:
        identity = (RUN / name).stat().st_ino
    except FileNotFoundError:
        return
    for priority in (TO_VEHICLE, TO_OTHERS):
        while succeeds(ip, "rule", "delete", "priority", str(priority), "from", str(network[1])):
            pass
    succeeds(ip, "netns", "delete", name)  # first, so that no more processes can enter
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

    The search is random, and takes what a killed run has left last: connections of an earlier link whose other
    end no longer exists send to its addresses for minutes, and would enter a new link with the same ones.
    """
    networks = {f"tod-{number}": network for number, network in enumerate(NETWORK.subnets(new_prefix=PREFIX))}
    removed = set(_remove_left_behind(ip, networks))
    for name in sorted(networks, key=lambda name: (name in removed, random.random())):
        with _claim(name) as is_free:
            if is_free and not any(address in networks[name] for address in _addresses(ip)):
                yield name, networks[name]
                return
    raise RunError(f"link=netns: every address of {NETWORK} is in use; end other runs, {ALTERNATIVE}")


def _remove_left_behind(ip: str, networks: Mapping[str, ipaddress.IPv4Network]) -> Iterator[str]:
    """Remove the namespaces of runs that were killed: those whose name is not claimed. Yields their names."""
    for name in networks.keys() & {path.name for path in RUN.glob("tod-*")}:
        with _claim(name) as is_free:
            if is_free:
                _remove(ip, name, networks[name])
                yield name


@contextmanager
def _claim(name: str) -> Iterator[bool]:
    """Claim a name and its addresses machine-wide; yields whether they were free.

    The claim is a locked file, which the kernel unlocks with the process. The name of a socket would be known in one
    network namespace only, while all share the names of `ip netns`.
    """
    LOCKS.mkdir(exist_ok=True)
    with (LOCKS / name).open("w") as claim:
        try:
            fcntl.flock(claim, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield False
        else:
            yield True


def _addresses(ip: str) -> list[ipaddress.IPv4Address]:
    """IPv4 addresses of this machine."""
    devices = json.loads(run(ip, "-json", "-4", "addr", "show"))
    addresses = (address["local"] for device in devices for address in device.get("addr_info", ()))
    return [ipaddress.IPv4Address(address) for address in addresses]


def check_possible() -> str:
    """raises RunError if this machine or its user cannot set up such a link; returns the path of ip"""
    ip = find("ip")
    _check_allowed()
    return ip


def _check_allowed() -> None:
    status = Path("/proc/self/status").read_text()
    effective = next(int(line.split()[1], 16) for line in status.splitlines() if line.startswith("CapEff:"))
    if not all(effective >> capability & 1 for capability in (CAP_NET_ADMIN, CAP_SYS_ADMIN)):
        rule = "run as root (CAP_NET_ADMIN and CAP_SYS_ADMIN)"
        raise RunError(f"link=netns may not make a network namespace: {rule}, {ALTERNATIVE}")
