"""The recipes of docs/deployment.md between two machines: network namespaces with addresses, firewalls and NAT."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import time
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from machines import AWAY_S, Mobile, Modems, Routers, cable, machines, mobile, two_uplinks
from recipes import (
    FIREWALLS,
    SERVICE,
    SHORT,
    SRT,
    TWO_MACHINES,
    TWO_MODEMS,
    TWO_UPLINKS,
    WIREGUARD,
    Site,
    files,
    lines,
    watched,
)

from rig import needs_root, process, until
from runner.drive.read import read_drive
from runner.records.operator import Sample

pytestmark = needs_root
VEHICLE, OPERATOR = "10.0.0.2", "10.0.0.1"
BACK_S = 3.0
CLOSED = 9999  # not mentioned in the document
LISTEN = f"import socket; s = socket.create_server(('', {CLOSED})); print(flush=True)\nwhile True: s.accept()"
CONNECT = "import socket, sys; socket.create_connection((sys.argv[1], int(sys.argv[2])), timeout=2)"


@pytest.fixture
def site(tmp_path):
    """Two machines next to each other."""
    with machines("vehicle", "operator") as (vehicle, operator):
        cable(vehicle, "eth0", operator, "eth0")
        vehicle.run(f"ip addr add {VEHICLE}/24 dev eth0")
        operator.run(f"ip addr add {OPERATOR}/24 dev eth0")
        yield Site(vehicle, operator, tmp_path)


def connects(site, where, host, port):
    """Whether a TCP connection from one machine to the other can be established."""
    command = [*site.machines[where].command, sys.executable, "-c", CONNECT, host, str(port)]
    return subprocess.run(command, capture_output=True, timeout=20, check=False).returncode == 0


def listening(machine):
    """A process that accepts connections on a port that no rule admits."""
    child = subprocess.Popen([*machine.command, sys.executable, "-c", LISTEN], stdout=subprocess.PIPE, text=True)
    assert child.stdout.readline() == "\n"
    return child


@contextmanager
def both_driving(site, vehicle, operator, **options):
    """Both sides, in the homes of their users, once pictures of every camera and their bitrates have arrived."""
    homes, sides = site.homes, site.machines
    started = []
    with ExitStack() as stack:
        for verb, words in (("operator", [*operator, "log=drive"]), ("vehicle", vehicle)):
            env = {"HOME": str(homes[verb])} | options.get("env", {})
            before = sides[verb].inside(homes[verb])
            started.append(
                stack.enter_context(process(verb, *words, before=before, stdout=subprocess.DEVNULL, env=env))
            )
        until(lambda: has_arrived(homes["operator"] / "drive"), every_s=0.5)
        yield started[0]


def test_two_bare_machines_drive_after_eight_commands_at_most(site):
    given = lines(TWO_MACHINES)
    assert {line.where for line in given} == {"operator", "vehicle"}
    assert len([part for line in given for part in re.split("&&|;", line.text)]) <= 8
    words = site.prepare(TWO_MACHINES)
    with both_driving(site, words["vehicle"], words["operator"]) as operator:
        (broker,) = site.shell("operator", f"pgrep -P {operator.pid} mosquitto").split()
    until(lambda: not Path(f"/proc/{broker}/exe").exists())


def test_site_files_take_the_overrides(site):
    site.prepare(TWO_MACHINES)
    for file in files(TWO_MACHINES):
        path = site.homes[file.where] / file.path.removeprefix("~/")
        path.parent.mkdir(parents=True)
        path.write_text(file.text)
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("TOD_SITE")
        with both_driving(site, SHORT, SHORT, env={"XDG_CONFIG_HOME": ""}):
            pass


def test_the_broker_runs_at_the_vehicle_if_that_is_the_one_reached(site):
    site.shell(
        "operator", f"tod-runner keys output=keys vehicle=tum_q7 host={VEHICLE} controller=alice broker={VEHICLE}"
    )
    site.shell("operator", f"rsync -a --chmod=D700,F600 keys/tum_q7 keys/broker {VEHICLE}:tod-keys/")
    common = [f"media.host={VEHICLE}", f"control.host={VEHICLE}", "control.port=8883", *SHORT]
    vehicle = ["keys=tod-keys/tum_q7", "control.broker=embedded", *common]
    with both_driving(site, vehicle, ["keys=keys/alice", *common]):
        pass


def test_two_machines_with_a_broker_as_a_service_drive_behind_their_firewalls(site):
    words = site.prepare(SERVICE)
    assert site.shell("operator", "stat -c '%U %a' /etc/mosquitto/tod /etc/mosquitto/tod/own.key").split() == [
        *("mosquitto", "700"),
        *("mosquitto", "600"),
    ]
    modes = site.shell("vehicle", "stat -c %a tod-keys tod-keys/*").split()
    assert (modes[0], set(modes[1:])) == ("700", {"600"})
    others = {"vehicle": OPERATOR, "operator": VEHICLE}
    for machine in site.machines.values():
        listening(machine)
    assert all(connects(site, where, host, CLOSED) for where, host in others.items())
    for file in files(FIREWALLS):
        site.write(file)
        site.shell(file.where, f"sudo nft -f {file.path}")
    assert not any(connects(site, where, host, CLOSED) for where, host in others.items())
    home = site.homes["operator"]
    before = site.machines["operator"].inside(home)
    with (
        site.driving(words["vehicle"]),
        process("operator", *words["operator"], "log=drive", before=before, stdout=subprocess.DEVNULL),
    ):
        until(lambda: has_arrived(home / "drive"), every_s=0.5)
        assert connects(site, "vehicle", OPERATOR, 8883)
        assert connects(site, "operator", VEHICLE, 8554)
        assert not any(connects(site, where, host, CLOSED) for where, host in others.items())


def has_arrived(drive):
    """Whether pictures of every camera have arrived, and the control link has reported their bitrates."""
    log = drive / "operator.jsonl"
    found = list(read_drive(drive).sides["operator"].of(Sample)) if log.exists() and log.stat().st_size else []
    return found and all(camera.frames > 20 and camera.allocated_kbps > 0 for camera in found[-1].cameras.values())


# --- behind NAT -------------------------------------------------------------------------------------------------------

INSIDE, OUTSIDE = 40, 60  # bytes that a packet of video gets inside the tunnel, at most, and any packet outside it
COUNTERS = """
table inet lengths {{
  counter video {{ }}
  counter longer {{ }}
  counter fragments {{ }}
  chain prerouting {{
    type filter hook prerouting priority -500;
    iifname tod meta l4proto udp meta length {rtp}-{longest} counter name video
    iifname tod meta l4proto udp meta length > {longest} counter name longer
    iifname eth0 ip frag-off & 0x3fff != 0 counter name fragments
  }}
}}
"""


def counted(machine):
    listed = json.loads(machine.run("nft -j list counters"))["nftables"]
    return {each["counter"]["name"]: each["counter"]["packets"] for each in listed if "counter" in each}


def fragments(machine):
    """Packets that a machine has cut into fragments, could not cut, or put together again."""
    names, values = (line.split()[1:] for line in machine.run("cat /proc/net/snmp").splitlines() if line[:3] == "Ip:")
    found = dict(zip(names, values, strict=True))
    return {name: int(found[name]) for name in ("FragCreates", "FragFails", "ReasmReqds")}


@pytest.mark.parametrize(("path", "mtu", "rtp"), [(1340, 1280, 1200), (1280, 1220, 1180)])
@pytest.mark.soak
def test_through_wireguard_nothing_is_fragmented(path, mtu, rtp, tmp_path):
    """By the MTU of the document, and by the smaller ones that it states for a path of 1280."""
    assert (mtu + OUTSIDE, rtp + INSIDE <= mtu) == (path, True)
    with mobile(translated=True) as network:
        site = Site(network.vehicle, network.operator, tmp_path)
        site.other["MTU = 1280"] = f"MTU = {mtu}"
        for machine, device in ((network.carrier, "out0"), (network.operator, "eth0")):
            machine.run(f"ip link set dev {device} mtu {path}")
        network.operator.run("nft -f -", COUNTERS.format(rtp=rtp, longest=rtp + INSIDE))
        with watched(site, WIREGUARD, f"graph.mtu_bytes={rtp}"):
            until(lambda: counted(network.operator)["video"] > 200, every_s=0.2)
            packets = counted(network.operator)
            assert (packets["longer"], packets["fragments"]) == (0, 0), packets
        none = {"FragCreates": 0, "FragFails": 0, "ReasmReqds": 0}
        assert [fragments(machine) for machine in (network.vehicle, network.carrier, network.operator)] == [none] * 3


# --- two uplinks ------------------------------------------------------------------------------------------------------

REDUNDANT = "front_center"
SPREAD = ("modes=safe", f"cameras.{REDUNDANT}.redundant=true")


def await_sending(machine, device):
    """Until pictures have left by a device."""

    def sent():
        return json.loads(machine.run(f"ip -json -statistics link show dev {device}"))[0]["stats64"]["tx"]["bytes"]

    before = sent()
    until(lambda: sent() > before + 20_000, every_s=0.1)


@pytest.mark.parametrize("number", [0, 1])
@pytest.mark.parametrize(
    ("heading", "kind", "devices"),
    [(TWO_MODEMS, Modems, ("wg-a", "wg-b")), (TWO_UPLINKS, Routers, ("eth1", "eth2"))],
    ids=["modems", "routers"],
)
@pytest.mark.soak
def test_a_redundant_camera_goes_on_when_one_of_two_uplinks_is_cut(heading, kind, devices, number, tmp_path):
    """Both machines are behind the firewalls of the document."""
    with two_uplinks(kind) as network:
        site = Site(network.vehicle, network.operator, tmp_path)
        for file in files(FIREWALLS):
            site.write(file)
            site.shell(file.where, f"sudo nft -f {file.path}")
        with watched(site, heading, *SPREAD) as watch:
            for device in devices:
                await_sending(network.vehicle, device)
            changed = time.monotonic()
            network.unplug(number)
            time.sleep(BACK_S)
            back = watch.back(changed)
            was_back = back[REDUNDANT] < AWAY_S and max(back.values()) < BACK_S
            assert was_back, (back, watch.notes, site.output.read_text())
            network.plug_in(number)
            await_sending(network.vehicle, devices[number])


# --- roaming ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("heading", "translated", "change"),
    [(SRT, False, Mobile.move), (SRT, True, Mobile.rebind), (WIREGUARD, False, Mobile.move)],
    ids=["srt", "srt behind NAT", "wireguard"],
)
@pytest.mark.soak
def test_a_roaming_vehicle_reconnects(heading, translated, change, tmp_path):
    """Twice; ten times in tests/soak."""
    with mobile(translated) as network:
        site = Site(network.vehicle, network.operator, tmp_path)
        with watched(site, heading) as watch:
            for _ in range(2):
                changed = time.monotonic()
                change(network)
                time.sleep(BACK_S)
                back = watch.back(changed)
                assert max(back.values()) < BACK_S, (back, watch.notes, site.output.read_text())
