"""How a viewer's packets travel: over UDP, or in the RTSP connection."""

from __future__ import annotations

import socket
import struct
from contextlib import ExitStack, contextmanager
from statistics import median

import pytest

from rig import even_ports, free_port, needs_root, over_tcp, streaming, until
from rtsp_client import RtspClient
from runner.core.commands import Command
from runner.gst.repair import OVER_TCP

pytestmark = pytest.mark.gst
CAMERA = "rear"
SMALL = ("vehicle=delivery_robot", "cameras.rear.width_px=320", "cameras.rear.height_px=180")


@contextmanager
def driving(*overrides, tcp=False):
    """A camera that is sent; yields its vehicle's side, its operator's side, its plan and what both report."""
    from runner.apply import OperatorSide

    with streaming(*SMALL, *overrides, cameras=(CAMERA,)) as (side, _, (plan,), reported):
        knobs = {"sending": True, "size": (320, 180), "bitrate": 300}
        side.turn([Command(CAMERA, *knob) for knob in knobs.items()])
        operator = OperatorSide(
            [over_tcp(plan) if tcp else plan], lambda cameras, what: reported.append(f"operator: {cameras}: {what}")
        )
        try:
            yield side, operator, plan, reported
        finally:
            operator.stop()


def received(operator):
    return operator.sample({CAMERA: True})[CAMERA]


@pytest.mark.alone
@pytest.mark.parametrize("tcp", [True, pytest.param(False, marks=[pytest.mark.soak, pytest.mark.players])])
def test_a_picture_does_not_wait_for_the_next_one(tcp):
    """Over TCP, too; at 5 Hz the next one comes 200 ms later."""
    with driving("fps_max=5", tcp=tcp) as (_, operator, _, _):
        latencies = []

        def enough():
            latency_ms = received(operator).latency_ms
            if latency_ms is not None and latency_ms not in latencies:
                latencies.append(latency_ms)
            return len(latencies) >= 10

        until(enough, every_s=0.1)
        assert median(latencies) < 100


def test_a_viewer_that_falls_back_to_tcp_is_named():
    """Another program holds the ports for RTP."""
    ports = even_ports(6)
    with ExitStack() as stack:
        for port in ports:
            stack.enter_context(socket.socket(type=socket.SOCK_DGRAM)).bind(("127.0.0.1", port))
        _, operator, _, reported = stack.enter_context(driving(f"media.rtp_ports=[{ports[0]},{ports[-1]}]"))
        until(lambda: received(operator).frames > 5, every_s=0.1)
        over_tcp = {f"rear: over TCP, UDP ports {ports[0]}-{ports[-1]} are in use", f"operator: rear: {OVER_TCP}"}
        until(lambda: over_tcp <= set(reported))


@pytest.mark.parametrize(
    ("transport", "known"),
    [
        ("tcp", False),
        pytest.param("udp", True, marks=[pytest.mark.soak, pytest.mark.players]),
        pytest.param("srt", False, marks=[pytest.mark.soak, pytest.mark.players]),
    ],
)
def test_when_a_frame_began_is_known_over_udp_only(transport, known):
    """The others repair losses unseen, and what they deliver is read later than it arrived. Every packet is counted."""
    words = ("graph=h264_srt", f"graph.first_port={free_port(3)}") if transport == "srt" else ()
    with driving("fps_max=15", *words, tcp=transport == "tcp") as (_, operator, _, _):
        frames, packets = [], []

        def enough():
            received(operator)  # a listener is rebuilt if nothing calls it
            arrivals = operator.take_arrivals()[""]
            frames.extend(arrivals.frames[CAMERA])
            packets.extend(arrivals.arrived)
            return len(frames) > 20

        until(enough, every_s=0.1)
    assert {frame.first is not None for frame in frames[5:]} == {known}
    begin, end = frames[5].arrived, frames[-1].arrived
    assert sum(size for at, size in packets if begin < at <= end) == sum(frame.bytes for frame in frames[6:])


@needs_root  # to see packets as they are sent
@pytest.mark.parametrize(
    ("host", "udp"),
    [
        ("::", False),  # an IPv6 socket for both
        *(
            pytest.param(host, udp, marks=[pytest.mark.soak, pytest.mark.players])
            for host in ("127.0.0.1", "::1")
            for udp in (False, True)
        ),
    ],
)
def test_packets_carry_the_dscp_of_the_graph(host, udp):
    with (
        socket.socket(socket.AF_PACKET, socket.SOCK_DGRAM, socket.htons(0x0003)) as seen,
        streaming(*SMALL, f'media.host="{host}"', "graph.dscp=46", cameras=(CAMERA,)) as (side, setup, _, _),
    ):
        seen.bind(("lo", 0))
        side.turn([Command(CAMERA, "sending", True), Command(CAMERA, "bitrate", 300)])
        addresses = {"::": ("::1", "127.0.0.1")}.get(host, (host,))
        for address in addresses:
            named = f"[{address}]" if ":" in address else address
            with RtspClient(f"rtsp://{named}:{setup.media.port}/{CAMERA}") as viewer:
                assert viewer.open(udp=udp) == [200, 200, 200]
                port = viewer.server_port if udp else setup.media.port
                viewer.read()
                # Beside other tests its buffer is soon full of their packets: it is read all the time.
                until(lambda p=port, version=6 if ":" in address else 4: 46 in codes(seen, p, version))


def codes(seen, port, version):
    """DiffServ code points of the packets of some size that a port has sent over a version of IP."""
    found = set()
    seen.setblocking(False)
    while True:
        try:
            packet = seen.recv(65_536)
        except BlockingIOError:
            return found
        head = 40 if version == 6 else 4 * (packet[0] & 15)
        if packet[0] >> 4 == version and len(packet) > 300 and packet[head : head + 2] == struct.pack(">H", port):
            word = int.from_bytes(packet[:2], "big") >> 4 if version == 6 else packet[1]
            found.add((word & 0xFF) >> 2)
