"""Limited links between real sides: forwarding, drops and cleanup."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import time
from contextlib import contextmanager
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest
from machines import machines

from rig import CHECKOUT, NOISE, children_named, free_port, needs_root, over_tcp, process, streaming, until, watching
from runner.configuration.config import configuration
from runner.core.commands import Command
from runner.errors import RunError
from runner.link import Limit, limited_link
from runner.link.limit import OneWay, Policing, TcpFlows
from runner.mqtt.broker import private_broker
from runner.plans import compile_plans
from runner.settings import Endpoint

ROBOT = ("vehicle=delivery_robot", "~cameras.front", "~cameras.mast", "fps_max=15", "page.serve=false", "pqos=constant")
SETTLE_S, MEASURE_S = 2.0, 4.0


KINDS = [pytest.param("netns", marks=needs_root), "relay"]
# Over a relay there are also the drives of test_latency.py and test_live.py.
MAINLY_NETNS = [KINDS[0], pytest.param("relay", marks=pytest.mark.soak)]
CHILDREN = {"netns": "tunnel", "relay": "relay"}
WIDE = Limit(lambda t: 5000, queue_ms=200, delay_ms=0)


class Drive:
    """Both sides with a link between them; `lines` is its log."""

    def __init__(self, link, lines, side, vehicle, plan):
        self.link, self.lines, self.side, self.vehicle, self.plan = link, lines, side, vehicle, plan

    def received(self):
        return self.side.sample({})["rear"]

    def measure(self, seconds=MEASURE_S):
        """First and last log line of a stretch of the drive, and the frames received per second in it."""
        (begun, since), first = self._counted(), len(self.lines) - 1
        until(lambda: self.lines[-1].t >= self.lines[first].t + seconds)
        frames, now = self._counted()
        return self.lines[first], self.lines[-1], (frames - begun) / (now - since)

    def _counted(self):
        """Frames received so far, and when, s."""
        return self.received().frames, time.monotonic()

    def stretch(self, seconds=3):
        """The log lines of a stretch of the drive."""
        first, last, _ = self.measure(seconds)
        return [line for line in self.lines if first.t <= line.t <= last.t]

    def kbps(self, seconds=MEASURE_S):
        """kbit/s that the link forwarded."""
        first, last, _ = self.measure(seconds)
        return rate(first, last)

    def loses_nothing(self):
        """Whether all packets of the next two seconds pass. If a busy machine holds up a sender, its burst may not."""
        lost = self.received().lost
        first, last, fps = self.measure(2)
        whole = (last.dropped, self.received().lost) == (first.dropped, lost)
        return whole and fps > 2 and last.packets > first.packets

    def sends_all(self, kbps, fps):
        """Whether the link forwards this rate for a while, and all pictures arrive. A busy machine may hold up some."""
        lost = self.received().lost
        first, last, arrived = self.measure()
        kept = rate(first, last) == pytest.approx(kbps, rel=0.15) and arrived == pytest.approx(fps, rel=0.1)
        return kept and self.received().lost == lost

    def settle(self):
        """Wait until the queue matches the rate."""
        self.measure(SETTLE_S)


def rate(first, last):
    """kbit/s that the link forwarded between two lines of its log."""
    return 8 * (last.bytes - first.bytes) / 1000 / (last.t - first.t)


def full_rate(lines):
    """The same while packets were queued: a vehicle or a link that a busy machine delays passes less."""
    waiting = [(one, other) for one, other in pairwise(lines) if one.queue_ms >= 1000 * (other.t - one.t)]
    seconds = sum(other.t - one.t for one, other in waiting)
    assert seconds > 1
    return 8 * sum(other.bytes - one.bytes for one, other in waiting) / 1000 / seconds


@contextmanager
def driving(kind, kbps_at, sent_kbps, tcp=False, queue_ms=200, delay_at=None):
    """One camera that sends as much as it may, through a link, to a receiver."""
    from runner.apply import OperatorSide

    lines = []
    limit = Limit(kbps_at, queue_ms, 100, delay_at=delay_at) if delay_at else Limit(kbps_at, queue_ms, 0)
    media, control = (Endpoint("127.0.0.1", free_port()) for _ in range(2))
    words = (*ROBOT, *NOISE, f"pqos.kbps={sent_kbps}", "media.max_viewers=2")
    with (
        limited_link(kind, limit, media, control, lines.append) as link,
        private_broker(link.broker),
        process("vehicle", *words, *link.vehicle_overrides, before=link.vehicle_command) as vehicle,
    ):
        plans = compile_plans(configuration([*words, *link.operator_overrides]).setup())
        side = OperatorSide([over_tcp(plan) if tcp else plan for plan in plans], lambda *_: None)
        try:
            drive = Drive(link, lines, side, vehicle, plans[0])
            until(lambda: drive.received().decoded > 5)
            link.start(time.time())
            until(lambda: lines)
            yield drive
            link.check()
        finally:
            side.stop()


def _ends():
    return [Endpoint("127.0.0.1", free_port()) for _ in range(2)]


def _names():
    """Names of all namespaces and network devices."""
    outputs = [subprocess.check_output(["ip", *words], text=True) for words in (("netns",), ("-br", "link"))]
    return {line.split()[0].partition("@")[0] for lines in outputs for line in lines.splitlines()}


def _left(*links):
    """Namespaces and devices of links, by name, that still exist."""
    return {name for name in _names() for link in links if name == link or name.startswith(f"{link}-")}


@pytest.mark.parametrize("kind", MAINLY_NETNS)
def test_a_wide_link_passes_everything(kind):
    with driving(kind, lambda t: 5000, sent_kbps=1000) as drive:
        drive.settle()
        until(drive.loses_nothing)
    assert {line.kbps for line in drive.lines} == {5000}
    assert [line.t for line in drive.lines] == sorted(line.t for line in drive.lines)


@pytest.mark.alone
@pytest.mark.parametrize("kind", MAINLY_NETNS)
def test_a_narrow_link_passes_its_rate_and_follows_the_trace(kind):
    def kbps_at(t):
        return 5000 if t < 1 else 1000 if t < 7 else 1500

    with driving(kind, kbps_at, sent_kbps=4000) as drive:
        until(lambda: drive.lines[-1].t > 1)
        drive.settle()
        narrow = drive.stretch()
        until(lambda: drive.lines[-1].t > 7)
        drive.settle()
        later = drive.stretch()
        lost = drive.received().lost
    assert full_rate(narrow) == pytest.approx(1000, rel=0.1)
    assert full_rate(later) == pytest.approx(1500, rel=0.1)
    assert narrow[-1].dropped > narrow[0].dropped
    assert lost > 0
    assert 150 < max(line.queue_ms for line in narrow) <= 200
    for line in drive.lines:
        if min(abs(line.t - step) for step in (1, 7)) > 0.01:
            assert line.kbps == kbps_at(line.t)


@pytest.mark.alone
def test_rtsp_over_tcp_is_queued_where_udp_is_dropped():
    with driving("relay", lambda t: 5000 if t < 1 else 1000, sent_kbps=2000, tcp=True) as drive:
        until(lambda: drive.lines[-1].t > 1)
        drive.settle()
        before = drive.received()
        lines = drive.stretch()
        received = drive.received()
    assert full_rate(lines) == pytest.approx(1000, rel=0.1)
    assert (lines[-1].dropped, received.lost) == (0, 0)
    assert received.frames - before.frames > 3


@needs_root
@pytest.mark.alone
@pytest.mark.parametrize(
    "feedback", [pytest.param(False, marks=pytest.mark.soak, id="AVP"), pytest.param(True, id="AVPF")]
)
def test_two_viewers_share_the_total_although_one_has_a_narrow_link(feedback):
    """Both copies leave the vehicle over one link; most packets of the second one are lost behind it.

    With feedback it requests them again and again.
    """
    with driving("netns", lambda t: 20_000, sent_kbps=1400) as drive:
        drive.settle()
        until(lambda: drive.sends_all(1400, 15))
        with watching(drive.plan, feedback=feedback) as second:
            passed = _narrow(second, kbps=200)
            until(passed)
            drive.settle()
            drive.settle()  # a new viewer's first requests are answered in one burst
            until(lambda: drive.sends_all(1400, 15))


def _narrow(client, kbps):
    """Drop packets to the client beyond a rate; returns a function that counts the passed bytes."""
    passed, began = 0, time.monotonic()

    def take(_pad, info):
        nonlocal passed
        size = info.get_buffer().get_size()
        if passed + size > (time.monotonic() - began) * kbps * 125:
            return client.gst.PadProbeReturn.DROP
        passed += size
        return client.gst.PadProbeReturn.OK

    def limit(element):
        if element.get_factory() and element.get_factory().get_name() == "udpsrc":
            element.get_static_pad("src").add_probe(client.gst.PadProbeType.BUFFER, take)

    client.pipeline.connect("deep-element-added", lambda _pipeline, _bin, element: limit(element))
    return lambda: passed


@pytest.mark.parametrize("kind", MAINLY_NETNS)
def test_a_delay_is_added_to_the_wait(kind):
    with driving(kind, lambda t: 5000, sent_kbps=1000, delay_at=lambda t: 200) as drive:
        drive.settle()
        assert until(lambda: drive.received().latency_ms) >= 300
        until(drive.loses_nothing)


def test_lost_packets_are_retransmitted_through_the_relay():
    # A queue that fits most of a frame but not all of it: the rest arrives once it is retransmitted.
    limit = Limit(lambda t: 4000, queue_ms=25, delay_ms=0)
    overrides = (*NOISE, "vehicle=delivery_robot", "fps_max=15", "graph.retransmission_ms=200")
    with (
        streaming(*overrides, cameras=("rear",)) as (side, setup, plans, _),
        limited_link("relay", limit, setup.media, _ends()[0], print) as link,
    ):
        side.turn([Command("rear", "bitrate", 2000), Command("rear", "sending", True)])
        with watching(_at(plans[0], link.operator_overrides), feedback=True) as client:
            until(lambda: _retransmitted(client) > 5 and len(client.sizes) > 5)


def _at(plan, overrides):
    """The plan for an operator that reaches the server at another address."""
    port = dict(word.split("=") for word in overrides)["media.port"]
    client, *rest = plan.operator
    properties = {
        **client.properties,
        "location": re.sub(r":\d+/", f":{port}/", client.properties["location"]),
        "latency": 100,
    }
    return replace(plan, operator=(replace(client, properties=properties), *rest))


def _retransmitted(client):
    """Lost packets that were retransmitted."""
    iterator, found = client.pipeline.iterate_recurse(), []
    iterator.foreach(lambda element: found.append(element) if element.get_factory() else None)
    buffers = [element for element in found if element.get_factory().get_name() == "rtpjitterbuffer"]
    return sum(buffer.get_property("stats").get_value("rtx-success-count") for buffer in buffers)


@needs_root
def test_queued_packets_do_not_block_their_sender():
    """A socket's buffer holds some 90 packets; the queue is behind it."""
    code = (
        "import socket, sys\n"
        "out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)\n"
        "out.setblocking(False)\n"
        "print(sum(out.sendto(bytes(1200), (sys.argv[1], 9)) for _ in range(300)))\n"
    )
    slow = Limit(lambda t: 100, queue_ms=60_000, delay_ms=0)  # sending them takes 29 s
    lines = []
    with limited_link("netns", slow, *_ends(), lines.append) as link:
        command = [*link.vehicle_command, sys.executable, "-c", code, link.broker.host]
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=30)
        link.start(time.time())
    assert done.stdout.strip() == str(300 * 1200)
    assert lines[0].dropped == 0
    assert lines[0].queue_ms > 1000


@needs_root
def test_a_namespace_is_removed_completely():
    with limited_link("netns", WIDE, *_ends(), print) as one, limited_link("netns", WIDE, *_ends(), print) as two:
        names = [link.vehicle_command[-1] for link in (one, two)]
        assert len({*names, one.broker.host, two.broker.host}) == 4  # they do not collide
        assert set(names) <= _names()
        stays = subprocess.Popen([*two.vehicle_command, "sleep", "1000"])
        until(lambda: str(stays.pid) in subprocess.check_output(["ip", "netns", "pids", names[1]], text=True).split())
    assert stays.wait(timeout=15) < 0
    assert not set(names) & _names()
    with pytest.raises(ZeroDivisionError), limited_link("netns", WIDE, *_ends(), print) as link:
        names.append(link.vehicle_command[-1])
        1 / 0  # noqa: B018
    assert not _left(*names), "nor their devices"


CONNECTING = "import socket, sys; socket.create_connection((sys.argv[1], int(sys.argv[2])), 1)"


@needs_root
def test_only_the_vehicle_gets_an_answer_at_the_links_address():
    """A neighbour that routes to it through another network of this machine gets none."""
    own, device = "203.0.113.1", f"near-{os.getpid()}"
    with machines("neighbour") as [neighbour], limited_link("netns", WIDE, *_ends(), print) as link:
        peer = f"peer name eth0 netns {neighbour.namespace}"
        for words in (
            f"link add {device} type veth {peer}",
            f"addr add {own}/24 dev {device}",
            f"link set {device} up",
        ):
            subprocess.run(["ip", *words.split()], check=True, timeout=10)
        for words in ("addr add 203.0.113.2/24 dev eth0", "link set eth0 up", f"route add default via {own}"):
            neighbour.run(f"ip {words}")

        def connects(before, server):
            host, port = server.getsockname()
            command = [*before, sys.executable, "-c", CONNECTING, host, str(port)]
            return subprocess.run(command, check=False, capture_output=True, timeout=30).returncode == 0

        reached = until(lambda: neighbour.run("ip -br link show eth0").split()[1] == "UP")
        with socket.create_server((own, 0)) as outside, socket.create_server((link.broker.host, 0)) as inside:
            assert reached
            assert connects(neighbour.command, outside)
            assert not connects(neighbour.command, inside)
            assert connects(link.vehicle_command, inside)
            assert connects([], inside)
    assert link.broker.host not in subprocess.check_output(["ip", "rule"], text=True)


@needs_root
def test_the_next_run_removes_what_a_killed_one_left():
    code = (
        "import os, signal, subprocess; from runner.link import *; from runner.settings import Endpoint\n"
        "limit, end = Limit(lambda t: 100, 200, 0), Endpoint('127.0.0.1', 1)\n"
        "with limited_link('netns', limit, end, end, print) as link:\n"
        "    left = subprocess.Popen([*link.vehicle_command, 'sleep', '1000'], stdout=-3, stderr=-3)\n"
        "    print(link.vehicle_command[-1], left.pid, flush=True)\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    name, pid = _python(code).stdout.split()
    with limited_link("netns", WIDE, *_ends(), print):
        until(lambda: not _runs(int(pid)))
    assert name not in _names()


@needs_root
def test_a_run_in_another_network_namespace_does_not_remove_a_link():
    code = (
        "from runner.link import *; from runner.settings import Endpoint\n"
        "limit, end = Limit(lambda t: 100, 200, 0), Endpoint('127.0.0.1', 1)\n"
        "with limited_link('netns', limit, end, end, print): print('a link')\n"
    )
    with limited_link("netns", WIDE, *_ends(), print) as link:
        assert "a link" in _python(code, "unshare", "--net").stdout
        assert link.vehicle_command[-1] in _names()


def _runs(pid):
    try:
        return "\nState:\tZ" not in Path(f"/proc/{pid}/status").read_text()  # a zombie may lack a parent to reap it
    except OSError:
        return False


def _python(code, *before):
    environment = {**os.environ, "PYTHONPATH": str(CHECKOUT)}
    command = [*before, sys.executable, "-c", code]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=60, env=environment)


@pytest.mark.parametrize("kind", KINDS)
def test_a_link_that_fails_is_reported(kind):
    lines = []
    with (
        pytest.raises(RunError, match="it ended: killed by SIGKILL"),
        limited_link(kind, WIDE, *_ends(), lines.append) as link,
    ):
        link.start(time.time())
        until(lambda: lines)
        link.check()
        (child,) = children_named(os.getpid(), f"runner.link.{CHILDREN[kind]}")
        os.kill(child, signal.SIGKILL)
        until(lambda: fails(link.check))
    assert not Path(f"/proc/{child}").exists()


def fails(check):
    try:
        check()
    except RunError:
        return True
    return False


def test_the_relay_ends_with_its_link(monkeypatch):
    monkeypatch.setattr("runner.link.child.END_S", 10.0)
    with pytest.raises(ZeroDivisionError), limited_link("relay", WIDE, *_ends(), print):
        began, (relay,) = time.monotonic(), children_named(os.getpid(), "runner.link.relay")
        1 / 0  # noqa: B018
    assert not Path(f"/proc/{relay}").exists()
    assert time.monotonic() - began < 10  # it was not killed


def test_without_root_the_relay_is_recommended():
    code = (
        "import os; from runner.link import *; from runner.settings import Endpoint\n"
        "os.geteuid() or os.seteuid(65534)\n"
        "end = Endpoint('127.0.0.1', 1)\n"
        "try:\n"
        "    limited_link('netns', Limit(lambda t: 100, 200, 0), end, end, print).__enter__()\n"
        "except Exception as error:\n"
        "    print(error)\n"
    )
    rule = "run as root (CAP_NET_ADMIN and CAP_SYS_ADMIN), or choose link=relay"
    assert _python(code).stdout.strip() == f"link=netns may not make a network namespace: {rule}"


def test_without_iproute2_the_error_names_what_to_install(monkeypatch):
    monkeypatch.setattr("shutil.which", lambda *_, **__: None)
    with pytest.raises(RunError) as raised, limited_link("netns", WIDE, *_ends(), print):
        pass
    rule = "on Debian: apt-get install iproute2, or choose link=relay"
    assert str(raised.value) == f"link=netns needs ip; {rule}"


ECHO = """
import socket, sys, time
out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
out.settimeout(5)
back = []
for number in range(200):
    out.sendto(bytes([number]), (sys.argv[1], int(sys.argv[2])))
    time.sleep(0.002)
began = time.monotonic()
try:
    while True:
        back.append(out.recv(10)[0])
except TimeoutError:
    print(len(back))
out.sendto(b"!" * 1000, (sys.argv[1], int(sys.argv[2])))
"""


@needs_root
def test_both_directions_of_a_namespace_lose_and_delay_any_packet():
    """As the relay does with UDP. Half of the packets pass one way, and half of those come back."""
    lossy = replace(WIDE, delay_ms=50, loss=0.5, reverse=OneWay(lambda t: 5000, 200, 150, loss=0.5))
    lines = []
    with limited_link("netns", lossy, *_ends(), lines.append) as link, socket.socket(type=socket.SOCK_DGRAM) as echo:
        echo.bind((link.broker.host, 0))
        echo.settimeout(20)
        words = (sys.executable, "-c", ECHO, link.broker.host, str(echo.getsockname()[1]))
        with subprocess.Popen([*link.vehicle_command, *words], stdout=subprocess.PIPE, text=True) as vehicle:
            passed = 0
            while vehicle.poll() is None:
                data, address = echo.recvfrom(2000)
                if len(data) > 1:
                    break
                passed += 1
                echo.sendto(data, address)
            returned = int(vehicle.communicate(timeout=30)[0])
        link.start(time.time())
    assert 60 < passed < 140
    assert 0.3 * passed < returned < 0.7 * passed
    assert lines[-1].lost == 200 - passed


FLOOD = """
import socket, sys, time
out, began, late_s = socket.socket(type=socket.SOCK_DGRAM), time.monotonic(), 0.0
for number in range(250):  # of 1028 bytes on the link each, 2056 kbit/s
    due = began + number * 0.004
    time.sleep(max(0, due - time.monotonic()))
    late_s = max(late_s, time.monotonic() - due)
    out.sendto(bytes(1000), (sys.argv[1], 9))
print(late_s)
"""


@pytest.mark.alone
@needs_root
def test_a_policer_drops_what_exceeds_its_rate_without_a_queue():
    """Of a second at 2056 kbit/s it passes 1028 kbit/s and its depth; nothing waits."""
    policed = replace(WIDE, policer=Policing(1028, 64))
    for _ in range(5):
        lines = []
        with limited_link("netns", policed, *_ends(), lines.append) as link:
            flood = [*link.vehicle_command, sys.executable, "-c", FLOOD, link.broker.host]
            late_s = float(subprocess.run(flood, check=True, timeout=30, stdout=subprocess.PIPE).stdout)
            link.start(time.time())
        if late_s < 0.03:
            break  # otherwise a busy machine sent a burst, of which less passes
    assert lines[-1].queue_ms == 0
    assert lines[-1].packets + lines[-1].dropped == 250
    assert 125 <= lines[-1].packets <= 150


@needs_root
def test_tcp_flows_compete_from_the_start_of_the_drive_on():
    """Finite transfers with CUBIC share the link with all other traffic."""
    lines = []
    flows = TcpFlows(2, size=(20_000, 60_000), pause_s=0.1)
    with limited_link("netns", replace(WIDE, delay_ms=20, tcp=flows), *_ends(), lines.append) as link:
        assert link.notes == ("competing TCP flows: 2, congestion control cubic",)
        time.sleep(3)
        link.start(time.time())
        until(lambda: lines and lines[-1].tcp_bytes > 500_000)
        link.check()
    assert lines[0].tcp_bytes < 1_000_000  # if they had flowed before, 1.9 MB
    assert lines[-1].bytes > 1.02 * lines[-1].tcp_bytes  # headers


def test_tcp_flows_need_a_namespace():
    with pytest.raises(RunError, match="link=relay: tcp is not supported, choose link=netns"):
        limited_link("relay", replace(WIDE, tcp=TcpFlows(1)), *_ends(), print).__enter__()


def test_a_relay_stays_on_this_machine():
    expected = "relay: cannot listen on 192.0.2.77: .*with link=relay both sides and the broker are here"
    with pytest.raises(RunError, match=expected):
        limited_link("relay", WIDE, Endpoint("192.0.2.77", 8554), *_ends()[:1], print).__enter__()


def test_an_unknown_kind_is_refused():
    with pytest.raises(RunError, match="link=rely: unknown kind, did you mean relay"):
        limited_link("rely", WIDE, *_ends(), print).__enter__()
