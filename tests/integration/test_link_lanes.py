"""A limited link of several lanes: devices of the vehicle with limits of their own, which are cut one at a time."""

from __future__ import annotations

import json
import re
import socket
import subprocess
import sys
import threading
import time
from contextlib import ExitStack, closing
from dataclasses import replace
from itertools import groupby
from math import inf
from typing import NamedTuple

import pytest
from msgspec import UNSET
from test_link import WIDE, _ends, _left, _python, full_rate

from rig import SMALL_ROBOT, free_port, needs_root, run, until
from runner.core.events import BitratePredicted, LinkMeasured
from runner.drive.read import Drive, read_drive
from runner.drive.series import series
from runner.drive.statistics import statistics
from runner.link import Limit, limited_link
from runner.link.limit import Cut
from runner.records.decisions import DecisionMade
from runner.records.lines import LinkSample, Note
from runner.records.operator import Sample
from runner.records.vehicle import Telemetry
from runner.settings import Endpoint

# Sends numbered packets over each way, and prints when each was sent, or why not, and what it received.
SENDER = """
import json, select, socket, sys, time
host, port, ways, bytes_, every_s, for_s = json.loads(sys.argv[1])
open_ways = {}
for name, way in ways.items():
    open_ways[name] = out = socket.socket(type=socket.SOCK_DGRAM)
    if way == name:
        out.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, way.encode())
    else:
        out.bind((way, 0))
    out.setblocking(False)
sent, received, began, number = [], [], time.monotonic(), 0
while (now := time.monotonic()) < began + for_s:
    if now >= began + number * every_s:
        number += 1
        for name, out in open_ways.items():
            try:
                out.sendto(json.dumps([name, number, now]).encode().ljust(bytes_), (host, port))
                sent.append([name, number, now, None])
            except OSError as error:
                sent.append([name, number, now, error.strerror])
    wait_s = max(0.0, began + number * every_s - time.monotonic())
    for out in select.select([*open_ways.values()], [], [], wait_s)[0]:
        number_of_b = json.loads(out.recv(2000))[1]
        received.append([[name for name, each in open_ways.items() if each is out][0], number_of_b])
print(json.dumps([sent, received]))
"""


class Arrival(NamedTuple):
    """At this machine: way, number and time of sending as the packet states them, its source, and when it came."""

    way: str
    number: int
    sent: float
    source: str
    at: float


class Operator:
    """Receives packets, and answers each of the way `b` over all ways: its number, and when it did so, from and to."""

    def __init__(self, host: str) -> None:
        self.arrivals: list[Arrival] = []
        self.answers: list[tuple[int, float, float]] = []
        self._socket = socket.socket(type=socket.SOCK_DGRAM)
        self._socket.bind((host, 0))
        self.address = self._socket.getsockname()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        known: dict[str, tuple[str, int]] = {}
        while True:
            data, address = self._socket.recvfrom(2000)
            if not data:
                return
            way, number, sent = json.loads(data)
            self.arrivals.append(Arrival(way, number, sent, address[0], time.monotonic()))
            known[way] = address
            if way == "b":
                for each in known.values():
                    self._socket.sendto(data, each)
                self.answers.append((number, self.arrivals[-1].at, time.monotonic()))

    def close(self) -> None:
        self._socket.sendto(b"", self.address)
        self._thread.join()
        self._socket.close()


def _addresses(link) -> dict[str, str]:
    """The vehicle's addresses by device."""
    devices = json.loads(_ip(link, "-json", "-4", "addr"))
    return {each["ifname"]: each["addr_info"][0]["local"] for each in devices if each.get("addr_info")}


def _ip(link, *words: str) -> str:
    return subprocess.check_output(["ip", "-netns", link.vehicle_command[-1], *words], text=True, timeout=10)


def _sending(link, operator, ways, size, every_s, for_s):
    words = json.dumps([*operator.address, ways, size, every_s, for_s])
    command = [*link.vehicle_command, sys.executable, "-c", SENDER, words]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


@needs_root
@pytest.mark.alone
def test_each_lane_holds_its_own_limits():
    lines = []
    lanes = {"a": Limit(lambda t: 1000, 300, 20), "b": Limit(lambda t: 2000, 400, 200)}
    with limited_link("netns", WIDE, *_ends(), lines.append, lanes=lanes) as link:
        with closing(Operator(link.broker.host)) as operator:
            link.start(time.time())
            sender = _sending(link, operator, {"a": "a", "b": "b"}, 1000, 0.0025, 3)  # 3290 kbit/s each
            sender.communicate(timeout=30)
            addresses = _addresses(link)
        link.check()
    for lane, kbps, delay_s, queue_ms in (("a", 1000, 0.02, 300), ("b", 2000, 0.2, 400)):
        own = [line for line in lines if line.lane == lane]
        assert {line.kbps for line in own} == {kbps}
        assert abs(full_rate(own) - kbps) < 0.1 * kbps
        assert 0.9 * queue_ms < max(line.queue_ms for line in own) <= queue_ms + 1
        assert own[-1].dropped > 0
        arrivals = [each for each in operator.arrivals if each.way == lane]
        assert {each.source for each in arrivals} == {addresses[lane]}
        assert delay_s <= min(each.at - each.sent for each in arrivals) < delay_s + 0.05


CUTS = (
    Cut(0.5, 0.5, "silence"),
    Cut(1.5, 0.5, "hold"),
    Cut(2.5, 1.5, "carrier"),  # the kernel may take a second to say so, and another one to say that it is back
    Cut(5.5, 0.5, "down"),
    Cut(6.5, 0.0, "address"),
)
# Of those that last: errors of a socket bound to the device, and to its address; whether packets come later.
FATES = (
    (None, None, False),
    (None, None, True),
    (None, None, False),
    ("Network is unreachable", "No route to host", False),
)


def _stretches(stamped):
    """Stretches of time in which a lane was certainly cut, or not: whether, from, to."""
    for is_cut, lines in groupby(stamped, key=lambda each: each[1].kbps == 0):
        times = [at for at, _ in lines]
        yield is_cut, times[0], times[-1]


@needs_root
def test_a_lane_is_cut_and_restored_while_another_goes_on():
    """Packets leave by both devices, and by `old`, a socket bound to the first address of `a`."""
    stamped = []  # each line with the time at which its rate was in force
    lanes = {"a": replace(WIDE, cuts=CUTS), "b": replace(WIDE, delay_ms=5)}

    def on_sample(line):
        stamped.append((time.monotonic(), line))

    with limited_link("netns", WIDE, *_ends(), on_sample, lanes=lanes) as link:
        names, before = [link.vehicle_command[-1], link.broker.host], _addresses(link)
        monitor = ["ip", "-netns", names[0], "-oneline", "monitor", "address"]
        with (
            closing(Operator(link.broker.host)) as operator,
            subprocess.Popen(monitor, stdout=subprocess.PIPE, text=True) as watching,
        ):
            sender = _sending(link, operator, {"a": "a", "b": "b", "old": before["a"]}, 100, 0.01, 8)
            until(lambda: len({each.way for each in operator.arrivals}) == 3)
            link.start(time.time())
            until(lambda: "NO-CARRIER" in _ip(link, "link", "show", "dev", "a"))
            until(lambda: ",UP" not in _ip(link, "link", "show", "dev", "a"))
            sent, received = json.loads(sender.communicate(timeout=30)[0])
            until(lambda: {("a", sent[-1][1]), ("b", sent[-1][1])} <= {each[:2] for each in operator.arrivals[-9:]})
            after = _addresses(link)
            watching.terminate()
            changes = watching.stdout.read()
        link.check()
    assert not _left(names[0])
    assert names[1] not in subprocess.check_output(["ip", "rule"], text=True)

    arrived = {(each.way, each.number) for each in operator.arrivals}
    answered = {number for way, number in received if way == "a"}
    of_a = [each for each in stamped if each[1].lane == "a"]
    stretches = list(_stretches(of_a))

    def fates(way, begin, end):
        """Of each packet sent meanwhile: the error, and whether it arrived."""
        return [(why, (way, number) in arrived) for name, number, at, why in sent if name == way and begin < at < end]

    def fate(way, begin, end):
        """Of all of them, but the last ones may still be on their way when the next stretch begins."""
        first, *others = [each for each, _ in groupby(fates(way, begin, end))]
        assert len(others) <= 1
        return first

    def is_answered(begin, end):
        """Whether the first answer meanwhile has arrived; a set, as there may be none on a busy machine."""
        numbers = [number for number, start, done in operator.answers if begin < start and done < end]
        return {number in answered for number in numbers[:1]}

    assert [is_cut for is_cut, *_ in stretches] == [False, True] * 4 + [False]
    for (_, begin, end), (error, old_error, comes) in zip(stretches[1::2], FATES, strict=True):
        assert fate("a", begin, end) == (error, comes)
        assert fate("old", begin, end) == (old_error, comes)
        assert is_answered(begin, end) <= {comes}
        assert not [each for each in operator.arrivals if each.way == "a" and begin < each.sent and each.at < end]
    for _, begin, end in stretches[::2]:
        first = min(at for way, number, at, _ in sent if way == "a" and at > begin and ("a", number) in arrived)
        assert (fate("a", first - 0.001, end), is_answered(first, end) <= {True}) == ((None, True), True)
    assert set(fates("b", 0, inf)) == {(None, True)}
    _, begin, end = stretches[1]
    assert of_a[-1][1].lost >= len(fates("a", begin, end))
    # Another address, for good: visible by netlink, and the former one is useless.
    assert (before["a"] != after["a"], before["b"]) == (True, after["b"])
    assert re.search(rf"^Deleted .* a +inet {before['a']} ", changes, re.MULTILINE)
    assert re.search(rf"^(?!Deleted).* a +inet {after['a']} ", changes, re.MULTILINE)
    assert [each.source for each in operator.arrivals if each.way == "a"][-1] == after["a"]
    assert None not in {why for why, _ in fates("old", sent[-1][2] - 0.3, inf)}


@needs_root
def test_the_next_run_removes_all_lanes_of_a_killed_one():
    code = (
        "import os, signal; from runner.link import *; from runner.settings import Endpoint\n"
        "limit, end = Limit(lambda t: 100, 200, 0), Endpoint('127.0.0.1', 1)\n"
        "with limited_link('netns', limit, end, end, print, lanes={'a': limit, 'b': limit}) as link:\n"
        "    print(link.vehicle_command[-1], link.broker.host, flush=True)\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    name, host = _python(code).stdout.split()
    with limited_link("netns", WIDE, *_ends(), print):
        until(lambda: not _left(name))
        assert host not in subprocess.check_output(["ip", "rule"], text=True)


def _bound(host, port):
    sock = socket.socket(type=socket.SOCK_DGRAM)
    sock.settimeout(10)
    sock.bind((host, port))
    return sock


def _setup(operator, server, own, ports):
    """Let an operator with the ports `own` and a vehicle's server with others agree on them; returns the relay's."""
    head = "SETUP rtsp://h/c RTSP/1.0\r\nTransport: RTP/AVP;unicast;client_port={0}-{1}\r\n\r\n"
    operator.sendall(head.format(own, own + 1).encode())
    near = int(re.search(rb"client_port=(\d+)", server.recv(1000))[1])
    transport = f"RTP/AVP;unicast;client_port={near}-{near + 1};server_port={ports}-{ports + 1}"
    server.sendall(f"RTSP/1.0 200 OK\r\nTransport: {transport}\r\n\r\n".encode())
    assert int(re.search(rb"server_port=(\d+)", operator.recv(1000))[1]) == near
    return near


def test_lanes_of_a_relay_are_addresses_of_the_vehicle():
    """A vehicle sends from 127.0.1.1 and 127.0.1.2, and the operator sees and answers these addresses."""
    lines, own, ports = [], free_port(2), free_port(2)
    lanes = {"a": replace(WIDE, delay_ms=20), "b": replace(WIDE, delay_ms=150, cuts=(Cut(0.5, 1.5, "silence"),))}
    with ExitStack() as stack:
        opened = stack.enter_context
        server, broker = (opened(socket.create_server(("127.0.0.1", 0))) for _ in range(2))
        ends = [Endpoint(*each.getsockname()) for each in (server, broker)]
        link = opened(limited_link("relay", WIDE, *ends, lines.append, lanes=lanes))
        media, control = (
            int(word.partition("=")[2])
            for words, key in ((link.operator_overrides, "media.port="), (link.vehicle_overrides, "control.port="))
            for word in words
            if word.startswith(key)
        )
        operator = opened(socket.create_connection(("127.0.0.1", media)))
        near = _setup(operator, opened(server.accept()[0]), own, ports)
        received, reports = (opened(_bound("127.0.0.1", own + n)) for n in range(2))
        ways = {lane: opened(_bound(f"127.0.1.{n}", ports)) for n, lane in enumerate("ab", 1)}
        asked = opened(_bound("127.0.1.2", ports + 1))
        for way, address, delay_s in ((ways["a"], "127.0.1.1", 0.02), (ways["b"], "127.0.1.2", 0.15)):
            sent = time.monotonic()
            way.sendto(b"picture", ("127.0.0.1", near))
            assert received.recvfrom(100) == (b"picture", (address, near))
            assert time.monotonic() - sent >= delay_s
        reports.sendto(b"report", ("127.0.1.2", near + 1))
        assert asked.recvfrom(100) == (b"report", ("127.0.0.1", near + 1))
        vehicle = opened(socket.create_connection(("127.0.0.1", control), source_address=("127.0.1.2", 0)))
        reached = opened(broker.accept()[0])
        link.start(time.time())
        until(lambda: [line for line in lines if line.lane == "b" and line.kbps == 0])
        for way in ways.values():
            way.sendto(b"cut", ("127.0.0.1", near))
        vehicle.sendall(b"message")
        assert received.recvfrom(100) == (b"cut", ("127.0.1.1", near))
        assert reached.recv(100) == b"message"  # as TCP does, once the lane is back
        until(lambda: [line for line in lines if line.lane == "b"][-1].kbps == WIDE.kbps_at(0))
        counted = {line.lane: line for line in lines}
        assert (counted["b"].lost, counted["a"].lost) == (1, 0)
        assert counted["b"].bytes == len("picture") + len("cut") + 2 * 28 + len("message") + 52
        received.settimeout(0.3)
        with pytest.raises(TimeoutError):
            received.recv(100)
        link.check()


@pytest.mark.gst
def test_a_vehicle_uses_both_lanes_of_a_relay(tmp_path):
    """The redundant camera goes on over one while the other is cut."""
    path, ports = tmp_path / "drive", (f"media.port={free_port()}", f"control.port={free_port()}")
    cut = "link.cuts=[{lane: b, at_s: 3, for_s: 2, how: silence}]"
    words = ("experiment=two_uplinks", "~experiment.runs", cut, "link.queue_ms=2000", *SMALL_ROBOT[1:], "source=test")
    done = run("demo", *words, "page.serve=false", *ports, f"log={path}", "duration_s=5.5")
    assert done.returncode == 0, done.stderr
    sides = read_drive(path).sides
    carried = {line.lane: line.packets for line in sides["link"].of(LinkSample)}
    assert carried["a"] > 30 and carried["b"] > 30
    events = sides["vehicle"]
    assert {event.uplink for event in events.of(BitratePredicted)} == {"a", "b"}
    assert {event.uplink for event in events.of(LinkMeasured) if event.kbps > 100} == {"a", "b"}
    stalled = [event.t for event in events.of(LinkMeasured) if event.uplink == "b" and event.state == "stalled"]
    samples = [line for line in sides["operator"].of(Sample) if line.cameras]
    arrived = [at for line in samples for at, _ in line.cameras["front"].arrivals if stalled[0] < at < stalled[0] + 1]
    assert arrived
    decided = [each for each in events.of(DecisionMade) if each.uplinks is not UNSET and each.uplinks["b"].stalled]
    assert {decided[-1].cameras[name].uplinks for name in ("rear", "mast")} >= {("a",)}
    assert "over a and b: redundant" in decided[-1].cameras["front"].reason
    sent = [each for line in events.of(Telemetry) if (each := line.cameras["front"].sent) is not UNSET][-1]
    received = samples[-1].cameras["front"].received
    assert all(0 < received[name].packets <= sent[name].packets for name in "ab")
    assert received["b"].packets < received["a"].packets, "b was cut"
    assert any(note.text.startswith("uplink b: nothing arrives") for note in sides["operator"].of(Note))
    found = statistics(series(Drive(path, sides))).uplinks
    assert 0.5 < found["b"].stalled_s < 3
