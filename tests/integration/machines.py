"""Machines with their own network: kernel namespaces with addresses, cables and NAT."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from bisect import bisect
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from itertools import count, pairwise
from math import inf
from pathlib import Path

from rig import CHECKOUT, WAIT_S
from runner.system import children

AWAY_S = 1.0  # without a picture or an answer, of more than ten a second; delays on a busy machine are shorter
# Changes of a machine in these directories are visible only to it, and vanish with it.
OWN = "mount -t tmpfs own /run; for own in etc var; do mkdir -p /run/own/$own /run/own/work.$own; " + (
    "mount -t overlay own -o lowerdir=/$own,upperdir=/run/own/$own,workdir=/run/own/work.$own /$own; done; "
)
VEHICLE, CARRIER, OPERATOR = "100.64.0.{}", "100.64.0.1", "198.51.100.10"  # RFC 6598 and RFC 5737
FORWARDING, STRICT = "sysctl -qw net.ipv4.ip_forward=1", "sysctl -qw net.ipv4.conf.all.rp_filter=1"
TRANSLATING = """\
table ip nat {
  chain postrouting {
    type nat hook postrouting priority srcnat;
    oifname out0 meta l4proto { tcp, udp } masquerade to :20000-60000 fully-random
  }
}
"""


class Machine:
    """A network namespace and a mount namespace, which the kernel removes with the last process in them.

    command  prefix of a command line that is to run there, in the checkout
    """

    def __init__(self, name: str) -> None:
        self.name = name
        enter = ("unshare", "--net", "--mount", "sh", "-ec", f"{OWN} echo; exec sleep infinity")
        self._holder = subprocess.Popen(children.bound(enter), stdout=subprocess.PIPE, text=True)
        assert self._holder.stdout
        assert self._holder.stdout.readline() == "\n"
        self.pid = self._holder.pid
        self.namespace = f"/proc/{self.pid}/ns/net"
        self._enter = ("nsenter", f"--target={self.pid}", "--net", "--mount")
        self.command = self.inside(CHECKOUT)
        self.run("ip link set dev lo up")

    def inside(self, directory: Path) -> Sequence[str]:
        """The prefix of a command line that is to run in a directory there; it finds `tod-runner`."""
        path = f"PATH={Path(sys.executable).parent}:{os.environ['PATH']}:/usr/sbin:/sbin"
        return (*self._enter, "env", "-C", str(directory), path)

    def run(self, words: str, given: str | None = None) -> str:
        """Standard output of a command. given: its standard input"""
        command = [*self.command, *words.split()]
        done = subprocess.run(command, capture_output=True, text=True, input=given, timeout=WAIT_S, check=False)
        assert done.returncode == 0, f"{self.name}: {words}: {done.stderr}"
        return done.stdout

    def end(self) -> None:
        own = os.stat(self.namespace).st_ino
        for namespace in Path("/proc").glob("[0-9]*/ns/net"):
            with suppress(OSError):  # it has ended meanwhile
                if namespace.stat().st_ino == own:
                    os.kill(int(namespace.parts[2]), signal.SIGKILL)
        self._holder.wait()


@contextmanager
def machines(*names: str) -> Iterator[list[Machine]]:
    with ExitStack() as stack:
        made = []
        for name in names:
            made.append(Machine(name))
            stack.callback(made[-1].end)
        yield made


def cable(one: Machine, device: str, other: Machine, other_device: str) -> None:
    """Connect two machines by devices without addresses."""
    peer = f"peer name {other_device} netns {other.namespace}"
    command = f"ip link add {device} netns {one.namespace} type veth {peer}"
    subprocess.run(command.split(), check=True, timeout=WAIT_S)
    for machine, name in ((one, device), (other, other_device)):
        machine.run(f"ip link set dev {name} up")


class Mobile:
    """A vehicle in a carrier's network, and an operator elsewhere.

    translated  whether the carrier hides the vehicle behind its own address (NAT); otherwise it routes
    """

    def __init__(self, vehicle: Machine, carrier: Machine, operator: Machine, translated: bool) -> None:
        self.vehicle, self.carrier, self.operator = vehicle, carrier, operator
        cable(vehicle, "wan0", carrier, "in0")
        cable(carrier, "out0", operator, "eth0")
        carrier.run(f"ip addr add {CARRIER}/24 dev in0")
        carrier.run("ip addr add 198.51.100.1/24 dev out0")
        carrier.run(FORWARDING)
        operator.run(f"ip addr add {OPERATOR}/24 dev eth0")
        if translated:
            carrier.run("nft -f -", TRANSLATING)
            # Once forgotten, a TCP connection is no longer answered, not even by a reset.
            carrier.run("sysctl -qw net.netfilter.nf_conntrack_tcp_loose=0")
        else:
            operator.run("ip route add 100.64.0.0/24 via 198.51.100.1")
        self._address = 1
        self.move()

    def move(self) -> None:
        """Give the vehicle an address that it did not have."""
        self._address += 1
        leave = f"addr del {VEHICLE.format(self._address - 1)}/24 dev wan0\n" if self._address > 2 else ""
        own = f"addr add {VEHICLE.format(self._address)}/24 dev wan0\n"
        self.vehicle.run("ip -batch -", f"{leave}{own}route add default via {CARRIER}\n")

    def rebind(self) -> None:
        """Let the carrier forget every connection; each gets a new port of its address with its next packet."""
        self.carrier.run("conntrack -F")


@contextmanager
def mobile(translated: bool) -> Iterator[Mobile]:
    with machines("vehicle", "carrier", "operator") as made:
        yield Mobile(*made, translated)


class Modems:
    """A vehicle with two modems, each of a carrier with NAT, and an operator with one address.

    Both carriers have the same network. The vehicle's kernel drops what comes by another device than answers leave by.
    """

    def __init__(self, vehicle: Machine, operator: Machine, *carriers: Machine) -> None:
        self.vehicle, self.operator, self._carriers = vehicle, operator, carriers
        self._addresses = count(2)
        vehicle.run(STRICT)
        for number, carrier in enumerate(carriers):
            cable(carrier, "out0", operator, f"eth{number}")
            carrier.run(f"ip addr add 203.0.113.{number + 1}/32 peer {OPERATOR} dev out0")
            operator.run(f"ip addr add {OPERATOR}/32 peer 203.0.113.{number + 1} dev eth{number}")
            carrier.run(FORWARDING)
            carrier.run("nft -f -", TRANSLATING)
            self.plug_in(number)

    def plug_in(self, number: int) -> None:
        """A modem connects, with an address that it did not have, and the vehicle's network manager sets it up."""
        device, metric = f"wwan{number}", 700 + number
        cable(self.vehicle, device, self._carriers[number], "in0")
        self._carriers[number].run(f"ip addr add {CARRIER}/24 dev in0")
        own = f"addr add {VEHICLE.format(next(self._addresses))}/24 dev {device} metric {metric}\n"
        self.vehicle.run("ip -batch -", f"{own}route add default via {CARRIER} dev {device} metric {metric}\n")

    def unplug(self, number: int) -> None:
        self.vehicle.run(f"ip link del dev wwan{number}")


class Routers:
    """A vehicle behind two routers, 10.1.0.1 and 10.2.0.1, and an operator who reaches it by both.

    A router forwards nothing that comes from another address than the vehicle's in its network.
    """

    def __init__(self, vehicle: Machine, operator: Machine, *routers: Machine) -> None:
        self.vehicle, self.operator, self._routers = vehicle, operator, routers
        vehicle.run(STRICT)
        operator.run("ip addr add 10.0.0.1/32 dev lo")
        for number, router in enumerate(routers):
            own = number + 1
            cable(vehicle, f"eth{own}", router, "in0")
            cable(router, "out0", operator, f"eth{own}")
            router.run(f"ip addr add 10.{own}.0.1/24 dev in0")
            router.run("sysctl -qw net.ipv4.conf.in0.rp_filter=1")
            router.run(FORWARDING)
            operator.run(f"ip route add 10.{own}.0.0/24 via 10.{own}.0.1 dev eth{own} onlink src 10.0.0.1")
            vehicle.run(f"ip addr add 10.{own}.0.2/24 dev eth{own}")
            vehicle.run(f"ip route add default via 10.{own}.0.1 dev eth{own} metric {100 + own}")
            self.plug_in(number)

    def plug_in(self, number: int) -> None:
        self._routers[number].run("ip link set dev out0 up")
        self._routers[number].run("ip route replace 10.0.0.1 dev out0")

    def unplug(self, number: int) -> None:
        """A router is cut off: the vehicle's device does not tell."""
        self._routers[number].run("ip link set dev out0 down")


@contextmanager
def two_uplinks(kind: type[Modems | Routers]) -> Iterator[Modems | Routers]:
    with machines("vehicle", "operator", "first", "second") as made:
        yield kind(*made)


class Watch:
    """What `remote_operator.py` sees: times of the monotonic clock of each picture of a camera, and of `control`."""

    def __init__(self, operator: Machine, directory: Path, words: Sequence[str]) -> None:
        script = Path(__file__).with_name("remote_operator.py")
        self.times: dict[str, list[float]] = {}
        self.notes: list[str] = []
        self._process = subprocess.Popen(
            [*operator.inside(directory), sys.executable, str(script), *words],
            stdout=subprocess.PIPE,
            text=True,
            env=children.environment(),
        )
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self._process.stdout
        for line in self._process.stdout:
            message = json.loads(line)
            if note := message.get("note"):
                self.notes.append(f"{message['t']:.2f} {note}")
            else:
                self.times.setdefault(message["what"], []).append(message["t"])

    def back(self, since: float) -> dict[str, float]:
        """By camera, and for `control`: time from a moment until permanent recovery, s; inf: not recovered.

        That is the next picture or answer that no gap of AWAY_S follows.
        """
        now, found = time.monotonic(), {}
        for what, times in self.times.items():
            moments = [*times[bisect(times, since) - 1 :], now]
            gaps = [(a, b) for a, b in pairwise(moments) if b - a > AWAY_S]
            last = gaps[-1][1] if gaps else moments[1]
            found[what] = inf if last == now else last - since
        return found

    def end(self) -> None:
        self._process.kill()
        self._process.wait()
