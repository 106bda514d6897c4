"""One camera's stream over two uplinks: a vehicle and an operator in network namespaces, with two ways between them."""

from __future__ import annotations

import json
import socket
import ssl
import struct
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from itertools import pairwise
from pathlib import Path
from typing import Any

import inside
import pytest
from ways import ADDRESSES, ADDRESSES_6, OPERATOR, OPERATOR_6, Ways, two_ways

from keyed import CONTROLLER, VEHICLE, issue
from rig import LOOPBACK6, faults, free_port, needs_root, repeating, small_robot, until
from runner.system import children
from runner.system.interfaces import addresses_of

CAMERA, FPS = "front", 30
VIDEO, REPEATED = 96, 97  # payload types
WRAPS_SOON = 65_536 - 700  # packets of a few seconds
FAST_S, SLOW_S = 0.02, 0.2
SAMPLES_S = 0.1


class Vehicle:
    """The vehicle's side in its namespace; see `vehicle_on_ways.py`."""

    def __init__(self, ways: Ways, words: list[str]) -> None:
        uplinks = {name: {"interface": way.device} for name, way in ways.named.items()}
        given = json.dumps({"words": words, "uplinks": uplinks, "number": WRAPS_SOON})
        script = Path(__file__).with_name("vehicle_on_ways.py")
        self._process = subprocess.Popen(
            [*ways.vehicle.command, sys.executable, str(script), given],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=children.environment(),
        )
        self._answer()

    def _answer(self) -> Any:
        assert self._process.stdout
        return json.loads(self._process.stdout.readline())

    def carry(self, *uplinks: str, anew: bool = False) -> Any:
        return self._ask(carry={CAMERA: uplinks}, anew=[CAMERA] * anew)

    def _ask(self, **what: Any) -> Any:
        assert self._process.stdin
        print(json.dumps(what), file=self._process.stdin, flush=True)
        return self._answer()

    @property
    def sent(self) -> dict[str, int]:
        """Packets by uplink."""
        return {name: each["packets"] for name, each in self._ask()["sent"][CAMERA].items()}

    @property
    def reported(self) -> list[str]:
        return faults(self._ask()["reported"])

    def end(self) -> None:
        assert self._process.stdin
        self._process.stdin.close()
        self._process.wait(20)


class Operator:
    """The operator's side.

    units     capture time of each access unit, whether it is a key picture, and when it came
    reported  what it reported
    port      of the vehicle's server
    """

    def __init__(self, words: list[str], addresses: Mapping[str, str]) -> None:
        from runner.apply import OperatorSide, check_plan
        from runner.configuration.config import configuration
        from runner.plans import compile_plans
        from runner.security.exposure import viewer_keyring

        setup = configuration([*words, f"media.host='{addresses['a']}'"], check=check_plan).setup()
        self.units: list[tuple[float, bool, float]] = []
        self.reported: list[str] = []
        self.port = setup.media.port
        self.side = OperatorSide(
            compile_plans(setup),
            lambda camera, what: self.reported.append(f"{camera}: {what}"),
            on_unit=self._on_unit,
            keyring=viewer_keyring(setup),
            vehicle=setup.vehicle.name,
            uplinks={name: [address] for name, address in addresses.items()},
        )

    def _on_unit(self, _camera: str, unit: Any) -> None:
        self.units.append((unit.captured, unit.key, time.monotonic()))

    def sample(self) -> Any:
        return self.side.sample({CAMERA: True})[CAMERA]

    def watch(self, seconds: float) -> None:
        """Until so many seconds of pictures have arrived."""
        wanted = self.units[-1][0] + seconds
        until(lambda: self.units[-1][0] > wanted)


@contextmanager
def drive(
    tmp_path: Path,
    keys: bool,
    addresses: Mapping[str, str] = ADDRESSES,
    host: str = "",
    cut: str = "",
    receiver: Sequence[str] = (),
) -> Iterator[tuple[Ways, Vehicle, Operator]]:
    """host: media.host of the vehicle, "": all. cut: ways that are cut before the operator's side begins"""
    port = free_port()
    host = host or "0.0.0.0"
    words = [*small_robot(CAMERA), "source=test", f"media.host={host}", f"media.port={port}", "page.serve=false"]
    holders = [issue(tmp_path / "keys") / name for name in (VEHICLE, CONTROLLER)] if keys else []
    own = [[f"keys={holder}"] for holder in holders] or [["insecure=true"]] * 2
    with two_ways(addresses) as ways:
        ways["a"].delay_s, ways["b"].delay_s = FAST_S, SLOW_S
        vehicle = Vehicle(ways, [*words, *own[0]])
        for name in cut:
            ways[name].is_cut = True
        operator = Operator([*words, *own[1], *receiver], addresses)
        try:
            with repeating(operator.sample, SAMPLES_S):
                until(lambda: len(operator.units) > FPS)
                yield ways, vehicle, operator
        finally:
            operator.side.stop()
            vehicle.end()


def check_every_picture(operator: Operator) -> None:
    """Every picture has come, whole, and none was a key picture but the first."""
    captured = [each for each, _, _ in operator.units]
    gaps = [round(FPS * (new - old)) for old, new in pairwise(captured)]
    sample = operator.sample()
    assert (set(gaps), sample.damaged, sample.lost, operator.reported) == ({1}, 0, 0, [])
    assert not any(key for _, key, _ in operator.units[1:])


def with_and_without_keys(*, by_soak: bool) -> pytest.MarkDecorator:
    """by_soak: with keys or without them, whichever `make soak` alone runs."""
    kinds = ((False, "plain"), (True, "keys"))
    marked = [pytest.param(keys, id=name, marks=[pytest.mark.soak] * (keys is by_soak)) for keys, name in kinds]
    return pytest.mark.parametrize("keys", marked)


@needs_root
@with_and_without_keys(by_soak=False)
def test_a_camera_changes_its_uplink_and_no_picture_is_lost(tmp_path: Path, keys: bool) -> None:
    """In both directions, 180 ms slower and faster, while the sequence numbers wrap around."""
    with drive(tmp_path, keys) as (ways, vehicle, operator):
        for carried in ("a", "b", "a", "ab", "b"):
            vehicle.carry(*carried)
            before = {name: way.passed for name, way in ways.named.items()}
            operator.watch(1.8)  # a shorter absence would count as a loss: a second, and more on a busy machine
            used = {name for name, way in ways.named.items() if way.passed - before[name] > FPS}
            assert used == set(carried)
        check_every_picture(operator)
        counted = operator.side.received()[CAMERA]
        assert {name: each.lost for name, each in counted.items()} == {"a": 0, "b": 0}
        assert counted["a"].twins == 0 < counted["b"].twins
        assert sum(vehicle.sent.values()) > 65_536 - WRAPS_SOON


@needs_root
@pytest.mark.skipif(LOOPBACK6 != "::1", reason="needs IPv6")
def test_over_ipv6(tmp_path: Path) -> None:
    """A camera changes its uplink, and packets from another address are dropped."""
    with drive(tmp_path, keys=False, addresses=ADDRESSES_6, host=f"'{ADDRESSES_6['a']}'") as (ways, vehicle, operator):
        assert OPERATOR_6 in addresses_of("lo")
        ports: set[int] = set()
        ways["b"].seen = lambda packet: ports.add(int.from_bytes(packet[42:44], "big")) is None
        for carried in ("b", "a"):
            vehicle.carry(carried)
            before = {name: way.passed for name, way in ways.named.items()}
            operator.watch(1.2)
            used = {name for name, way in ways.named.items() if way.passed - before[name] > FPS}
            assert used == set(carried)
        with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as stranger:
            for port in ports:
                stranger.sendto(bytes(100), (OPERATOR_6, port))
        until(lambda: operator.sample().foreign)


@needs_root
def test_over_tcp_no_uplink_carries_a_camera(tmp_path: Path) -> None:
    with drive(tmp_path, keys=False, receiver=["graph.receiver.0.properties.protocols=tcp"]) as (_, vehicle, operator):
        assert vehicle.sent == {"a": 0, "b": 0}
        until(lambda: operator.reported)
        reported = "over TCP by the vehicle's routes: none of its uplinks carries it or is measured by it"
        assert operator.reported == [f"{CAMERA}: {reported}"]


@needs_root
@with_and_without_keys(by_soak=True)
def test_an_uplink_is_cut_and_a_camera_that_both_carry_loses_no_picture(tmp_path: Path, keys: bool) -> None:
    with drive(tmp_path, keys) as (ways, _vehicle, operator):
        for name in ("a", "b"):
            ways[name].is_cut = True
            operator.watch(1.5)
            ways[name].is_cut = False
            operator.watch(0.5)
        check_every_picture(operator)


@needs_root
@with_and_without_keys(by_soak=False)
def test_packets_that_an_uplink_has_held_change_nothing(tmp_path: Path, keys: bool) -> None:
    with drive(tmp_path, keys) as (ways, _vehicle, operator):
        for name in ("b", "a"):
            ways[name].is_held = True
            operator.watch(3)
            ways[name].is_held = False
            operator.watch(1)
        check_every_picture(operator)
        assert all(each.late > FPS for each in operator.side.received()[CAMERA].values())


@pytest.mark.soak
@needs_root
@with_and_without_keys(by_soak=True)
def test_long_faults_of_an_uplink(tmp_path: Path, keys: bool) -> None:
    """The one by which the operator is connected is cut for longer than sessions and connections may be silent."""
    with drive(tmp_path, keys) as (ways, vehicle, operator):
        for seconds in (10, 40):
            vehicle.carry("b")
            ways["a"].is_cut = True
            operator.watch(seconds)
            ways["a"].is_cut = False
            vehicle.carry("a", "b")
            operator.watch(3)
        for name in ("a", "b"):
            ways[name].is_held = True
            operator.watch(10)
            ways[name].is_held = False
            operator.watch(3)
        check_every_picture(operator)
        assert vehicle.reported == [f"{CAMERA}: pipeline built"]


def datagram(source: str, target: tuple[str, int], data: bytes) -> bytes:
    """An IPv4 packet; UDP needs no checksum."""
    addresses = socket.inet_aton(source) + socket.inet_aton(target[0])
    head = struct.pack("!BBHHHBBH", 0x45, 0, 28 + len(data), 0, 0, 64, 17, 0) + addresses
    total = sum(struct.unpack("!10H", head))
    total = (total & 0xFFFF) + (total >> 16)
    head = head[:10] + struct.pack("!H", 0xFFFF ^ ((total & 0xFFFF) + (total >> 16))) + head[12:]
    return head + struct.pack("!HHHH", 16_000, target[1], 8 + len(data), 0) + data


def payload_type(packet: bytes) -> int:
    """Of an RTP packet; 0 of another one."""
    return packet[29] & 0x7F if packet[23] % 2 == 0 and packet[9] == socket.IPPROTO_UDP and len(packet) > 100 else 0


def requests(packet: bytes) -> bytes:
    """RTCP by which a viewer requests a key picture and packets again (RFC 4585), and leaves (RFC 3550)."""
    number, stream = int.from_bytes(packet[30:32], "big"), int.from_bytes(packet[36:40], "big")
    viewer = 1
    report = struct.pack("!BBHI", 0x80, 201, 1, viewer)
    key_picture = struct.pack("!BBHII", 0x81, 206, 2, viewer, stream)
    again = struct.pack("!BBHIIHH", 0x81, 205, 3, viewer, stream, (number - 20) % 65_536, 0xFFFF)
    return report + key_picture + again + struct.pack("!BBHI", 0x81, 203, 1, viewer)


@needs_root
@with_and_without_keys(by_soak=False)
def test_packets_of_an_intruder_change_nothing(tmp_path: Path, keys: bool) -> None:
    """Copies of the vehicle's packets that come before these, with its numbers and another content.

    Without keys they come from an address that is not the vehicle's, with keys from one that is. The vehicle is sent
    requests, from an address that is not the viewer's.
    """
    with drive(tmp_path, keys) as (ways, vehicle, operator):
        requested = inside.requested(inside.receiver(operator.side, CAMERA))
        vehicle.carry("b")
        way, stranger = ways["b"], "10.78.3.2"
        sender, forged = ADDRESSES["b"] if keys else stranger, list[int]()

        def forge(packet: bytes) -> bool:
            own, port = (int.from_bytes(packet[begin : begin + 2], "big") for begin in (20, 22))
            if port % 2 == 0 and len(packet) > 40:  # RTP
                data = packet[28:40] + bytes(len(packet) - 40)
                way.to_operator(datagram(sender, (OPERATOR, port), data))
                way.to_vehicle(datagram(stranger, (ADDRESSES["b"], own + 1), requests(packet)))
                forged.append(payload_type(packet))
            return True

        way.seen = forge
        operator.watch(2)
        way.seen = lambda packet: True
        operator.watch(1)
        assert forged.count(VIDEO) > 2 * FPS
        assert forged.count(REPEATED) <= len(requested), "others than the viewer itself are heard"
        reported, operator.reported[:] = list(operator.reported), []
        check_every_picture(operator)
        foreign = [f"{CAMERA}: packets from hosts other than the vehicle are dropped"]
        assert (reported, operator.sample().foreign > 2 * FPS) == (([], False) if keys else (foreign, True))


@needs_root
def test_an_uplink_whose_device_comes_back_with_another_address_is_used_again(tmp_path: Path) -> None:
    with drive(tmp_path, keys=False) as (ways, vehicle, operator):
        ways["b"].remove()
        operator.watch(1.5)
        until(lambda: vehicle.reported[1:] == ["uplink b: way-b: No such device"])
        ways["b"].create("10.78.4.2")
        operator.side.admit({"a": [ADDRESSES["a"]], "b": ["10.78.4.2"]})
        before = ways["b"].passed
        until(lambda: ways["b"].passed > before + FPS)
        vehicle.carry("b")
        operator.watch(1)
        check_every_picture(operator)
        assert operator.side.received()[CAMERA]["b"].packets > FPS
        until(lambda: vehicle.reported[2:] == ["uplink b: works again"])


@needs_root
def test_a_camera_whose_uplink_is_cut_goes_on_with_a_key_picture_by_the_other(tmp_path: Path) -> None:
    """At once: what the other has swallowed is neither sent again, nor awaited for long. Nothing is shown damaged."""
    with drive(tmp_path, keys=False) as (ways, vehicle, operator):
        ways["a"].delay_s = ways["b"].delay_s = FAST_S
        vehicle.carry("a")
        operator.watch(1.5)
        repeated: list[int] = []
        ways["b"].seen = lambda packet: repeated.append(payload_type(packet)) or True  # type: ignore[func-returns-value]
        ways["a"].is_cut = True
        time.sleep(0.3)
        shown = len(operator.units)
        vehicle.carry("b", anew=True)
        operator.watch(1)
        first, *_ = (unit for unit in operator.units[shown:] if unit[1])
        assert first[2] - (first[0] + time.monotonic() - time.time()) < 0.25
        assert REPEATED not in repeated
        assert operator.sample().damaged <= 1, "the picture that was being encoded at that moment"


@needs_root
def test_a_viewer_connects_by_another_uplink_if_the_first_is_cut(tmp_path: Path) -> None:
    """The server's own address is that of the first one; it listens at that of each."""
    with drive(tmp_path, keys=False, host=ADDRESSES["a"], cut="a") as (_ways, _vehicle, operator):
        operator.watch(0.5)
        assert operator.side.received()[CAMERA]["b"].packets > FPS


@needs_root
def test_a_stranger_without_keys_is_refused_at_the_address_of_each_uplink(tmp_path: Path) -> None:
    with drive(tmp_path, keys=True) as (_ways, vehicle, operator):
        tls = ssl._create_unverified_context()
        for address in ADDRESSES.values():
            plain = socket.create_connection((address, operator.port), 2)
            with suppress(ssl.SSLError, ConnectionError), tls.wrap_socket(plain) as stranger:
                stranger.sendall(b"OPTIONS * RTSP/1.0\r\nCSeq: 1\r\n\r\n")
                assert not stranger.recv(1000)
        refused = f"keys: refused an RTSP client at {OPERATOR}: "
        until(lambda: any(line.startswith(refused) for line in vehicle.reported))
        check_every_picture(operator)


@needs_root
def test_what_is_lost_is_sent_again_although_the_other_uplink_is_cut(tmp_path: Path) -> None:
    """That by which the operator is connected. By both, a request is sent twice, and granted once.

    The operator waits long for a packet: on a busy machine these ways deliver late.
    """
    with drive(tmp_path, keys=False, receiver=["graph.jitter_buffer_ms=500"]) as (ways, vehicle, operator):
        ways["a"].delay_s = ways["b"].delay_s = 0.005  # answered before the first request is repeated
        vehicle.carry("b")
        operator.watch(0.5)
        kinds: list[int] = []

        def lose(packet: bytes) -> bool:
            kinds.append(payload_type(packet))
            return kinds[-1] != VIDEO or kinds.count(VIDEO) % 60 != 0

        def is_granted_once():
            kinds.clear()
            ways["b"].seen = lose
            operator.watch(3)
            ways["b"].seen = lambda packet: True
            operator.watch(1)
            lost, repeated = kinds.count(VIDEO) // 60, kinds.count(REPEATED)
            return lost <= repeated < 2 * lost

        for is_cut in (True, False):
            ways["a"].is_cut = is_cut
            until(is_granted_once)  # a machine that is busy for a moment asks again before it is answered
        check_every_picture(operator)


@pytest.mark.parametrize("has_keys", [False, True])
def test_a_new_pipeline_connects_by_the_next_uplink(has_keys: bool) -> None:
    """With keys not to an IPv6 address, which GnuTLS refuses as the name of a server."""
    from runner.gst import Gst
    from runner.gst.received_uplinks import ReceivedUplinks

    uplinks = ReceivedUplinks({"a": ["10.0.1.2"], "b": ["10.0.2.2", "fd78::2"]}, has_keys=has_keys)
    expected = ["10.0.1.2", "10.0.2.2", *([] if has_keys else ["[fd78::2]"])]
    for host in (*expected, *expected):
        client = Gst.ElementFactory.make("rtspsrc")
        client.set_property("location", "rtsp://10.0.1.2:8554/front")
        uplinks.direct(client)
        assert client.get_property("location") == f"rtsp://{host}:8554/front"


def test_feedback_that_comes_by_both_uplinks_passes_once() -> None:
    from runner.gst import Gst
    from runner.gst.uplinks import Feedback

    pipeline = Gst.parse_launch("appsrc name=a ! funnel name=all ! appsink name=sink sync=false  appsrc name=b ! all.")
    feedback, sources = Feedback(), [pipeline.get_by_name(name) for name in "ab"]
    probes = [feedback.merge(source.get_static_pad("src")) for source in sources]
    pipeline.set_state(Gst.State.PLAYING)
    passed = []
    for source, data in ((0, b"1"), (1, b"1"), (1, b"2"), (0, b"2"), (0, b"3"), (0, b"3"), (1, b"4")):
        sources[source].emit("push-buffer", Gst.Buffer.new_wrapped(data))
        if sample := pipeline.get_by_name("sink").emit("try-pull-sample", 100 * Gst.MSECOND):
            passed.append(sample.get_buffer().extract_dup(0, 1))
    pipeline.set_state(Gst.State.NULL)
    assert (passed, len(probes)) == ([b"1", b"2", b"3", b"3", b"4"], 2)
