"""What `doctor` says of uplinks, on a machine with two modems."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Mapping

import pytest
from machines import Machine, machines

from rig import WAIT_S, needs_root

pytestmark = needs_root

HOST = "10.9.0.1"  # of the control link
CHECK = """
import json, sys
from runner.settings import Uplink
from runner.verbs.doctor_uplinks import check_uplinks
host, uplinks = json.loads(sys.argv[1])
print(json.dumps([*check_uplinks({name: Uplink(**keys) for name, keys in uplinks.items()}, host)]))
"""


def found(machine: Machine, host: str, **uplinks: Mapping[str, str]) -> list[list[object]]:
    command = [*machine.command, "python", "-c", CHECK, json.dumps([host, uplinks])]
    return list(json.loads(subprocess.run(command, capture_output=True, check=True, timeout=WAIT_S).stdout))


@pytest.fixture(scope="module")
def modems():
    """wwan0 with two addresses and the only route, wwan1 without an address, wwan2 and Ethernet with one."""
    with machines("modems") as (machine,):
        for device in ("wwan0", "wwan1", "wwan2"):
            machine.run(f"ip tuntap add dev {device} mode tun")
            machine.run(f"ip link set {device} up")
        for address, device in (("10.1.0.2/24", "wwan0"), ("10.1.0.3/24", "wwan0"), ("10.2.0.2/24", "wwan2")):
            machine.run(f"ip address add {address} dev {device}")
        machine.run("ip link add eth0 type veth peer name router")
        machine.run("ip link set eth0 up")
        machine.run("ip address add 10.3.0.2/24 dev eth0")
        machine.run("ip route add 10.9.0.0/24 dev wwan0")
        yield machine


def test_devices_and_addresses(modems: Machine) -> None:
    given = {"a": {"interface": "wwan0"}, "b": {"interface": "wwan3"}, "c": {"interface": "wwan1"}}
    assert found(modems, "127.0.0.1", **given, d={"address": "10.1.0.9"}) == [
        [True, "uplink a: wwan0, 10.1.0.2, 10.1.0.3"],
        [False, "uplink b: there is no interface wwan3, did you mean wwan2?"],
        [False, "uplink c: wwan1 has no address: is its modem connected?"],
        [False, "uplink d: 10.1.0.9 is no address of this machine; it has 10.1.0.2, 10.1.0.3, 10.2.0.2, 10.3.0.2"],
    ]


def test_routes(modems: Machine) -> None:
    """Packets of a bound socket leave by its device, by Ethernet if a route does; others by the system's routes."""
    route = f"has a route to {HOST}"
    assert found(modems, HOST, a={"interface": "wwan0"}, b={"interface": "wwan2"}) == [
        [True, f"uplink a: wwan0, 10.1.0.2, 10.1.0.3, {route}"],
        [True, f"uplink b: wwan2, 10.2.0.2, {route}"],
    ]
    assert found(modems, HOST, a={"interface": "eth0"}) == [
        [False, f"uplink a: no route from eth0 to the control link's host {HOST}"],
    ]
    assert found(modems, HOST, a={"address": "10.1.0.2"}, b={"address": "10.2.0.2"}) == [
        [True, f"uplink a: wwan0, 10.1.0.2, {route}"],
        [True, f"uplink b: wwan0, 10.2.0.2, {route}"],
        [False, "uplinks a and b leave through one device, wwan0"],
    ]
    assert found(modems, "10.8.0.1", a={"address": "10.1.0.2"}) == [
        [False, "uplink a: no route from 10.1.0.2 to the control link's host 10.8.0.1"]
    ]
