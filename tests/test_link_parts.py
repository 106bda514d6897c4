"""The parts of a limited link that need no process: the bucket, and RTSP as the relay reads it."""

from __future__ import annotations

import asyncio
import socket
import time
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from runner.link.bucket import Bucket
from runner.link.direction import UNLIMITED, Direction, Link, LossModel, exact_loop
from runner.link.limit import burst_bytes, queue_bytes
from runner.link.relay import TCP_HEADERS, join
from runner.link.rtsp import Splitter, ports, with_ports

KBPS, QUEUE_MS = 800, 100  # 100 bytes in a ms
arrivals = st.lists(st.tuples(st.floats(0, 0.05), st.integers(28, 1500)), min_size=1, max_size=60)  # gap s, bytes


def passed(packets, polls=()):
    """Pass packets (time, size) through a bucket, polled in between: (time, index) of each, and the bucket."""
    bucket = Bucket(KBPS, QUEUE_MS, 0.0)
    left = []
    for index, (t, size) in enumerate(packets):
        for poll in polls:
            left += bucket.take(min(poll, t)) if poll <= t else ()
        bucket.put(size, index, t)
    left += bucket.take(1e9)
    return left, bucket


def timed(gaps):
    t, packets = 0.0, []
    for gap, size in gaps:
        t += gap
        packets.append((t, size))
    return packets


@given(arrivals)
def test_no_period_passes_more_than_the_rate_and_one_bucket(gaps):
    packets = timed(gaps)
    left, _ = passed(packets)
    for first, (begin, _) in enumerate(left):
        size = 0
        for end, index in left[first:]:
            size += packets[index][1]
            assert size <= burst_bytes(KBPS) + (end - begin) * KBPS * 1000 / 8 + 1e-3


@given(arrivals)
def test_packets_pass_in_order_and_none_waits_longer_than_the_queue(gaps):
    packets = timed(gaps)
    left, bucket = passed(packets)
    assert [index for _, index in left] == sorted(index for _, index in left)
    assert all(-1e-9 <= when - packets[index][0] <= QUEUE_MS / 1000 + 1e-9 for when, index in left)
    counters = bucket.counters(1e9)
    assert counters.packets + counters.dropped == len(packets)
    assert counters.bytes == sum(packets[index][1] for _, index in left)


@given(arrivals, st.lists(st.floats(0, 2), max_size=20))
def test_late_polls_give_the_same_result(gaps, polls):
    assert passed(timed(gaps), sorted(polls))[0] == passed(timed(gaps))[0]


def test_a_full_queue_drops_and_reports_its_length():
    bucket = Bucket(KBPS, QUEUE_MS, 0.0)
    for index in range(20):
        bucket.put(1000, index, 0.0)
    counters = bucket.counters(0.0)
    assert (counters.packets, counters.dropped) == (3, 7)  # 3000 bytes pass immediately, 10 000 wait
    assert counters.queue_ms == pytest.approx(100)
    bucket.put(1000, 20, 0.0, keep=True)
    assert bucket.counters(0.0).dropped == 7


def test_a_new_rate_applies_to_queued_packets():
    bucket = Bucket(KBPS, QUEUE_MS, 0.0)
    for index in range(5):
        bucket.put(1000, index, 0.0)
    assert [when for when, _ in bucket.take(0.001)] == [0, 0, 0]
    bucket.set_rate(KBPS / 10, 0.001)
    assert bucket.due() == pytest.approx(0.001 + (1000 - 100) / 10_000)
    bucket.set_rate(KBPS, 0.002)
    assert bucket.due() == pytest.approx(0.002 + (1000 - 110) / 100_000)


def test_at_a_rate_of_0_packets_stay_queued():
    bucket = Bucket(0, QUEUE_MS, 0.0)
    for index in range(5):
        bucket.put(1500, index, 0.0)
    assert [index for _, index in bucket.take(100.0)] == [0, 1]  # the bucket was full
    assert bucket.due() is None
    counters = bucket.counters(100.0)
    assert (counters.queue_ms, counters.packets, counters.dropped) == (QUEUE_MS, 2, 1)
    bucket.set_rate(KBPS, 100.0)
    assert bucket.due() == pytest.approx(100 + 1500 / 100_000)


def test_a_slow_link_has_room_for_a_packet():
    assert queue_bytes(1, 10) == burst_bytes(1) == 3000
    assert (burst_bytes(40_000), queue_bytes(8000, 200)) == (10_000, 200_000)


def connected():
    """Both ends of a TCP connection."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        end = socket.create_connection(server.getsockname())
        return server.accept()[0], end


def test_tcp_waits_for_room_where_udp_is_dropped():
    message, size = b"x" * 150, 150 + TCP_HEADERS

    async def run():
        link = Link(Direction(KBPS, QUEUE_MS, 0), Direction(**UNLIMITED))
        (near, vehicle), (far, operator) = connected(), connected()
        with near, vehicle, far, operator:
            operator.setblocking(False)
            joined = asyncio.create_task(join(link, near, far, lambda data: [data], lambda data: [data]))
            await asyncio.sleep(0.01)  # the relay waits for data: the queue still has room
            while not link.up.change(None, None)["dropped"]:
                link.up.put(100, lambda: None)
            longest = link.up.change(None, None)["queue_ms"]
            vehicle.sendall(message)
            received = asyncio.create_task(asyncio.get_running_loop().sock_recv(operator, 1000))
            while not received.done():
                await asyncio.sleep(0)
                link.up.put(100, lambda: None)  # UDP takes all room that TCP leaves
                longest = max(longest, link.up.change(None, None)["queue_ms"])
            joined.cancel()
            await asyncio.wait([joined])
            return await received, longest

    with asyncio.Runner(loop_factory=exact_loop) as runner:
        received, longest = runner.run(asyncio.wait_for(run(), 20))
    assert received == message
    assert QUEUE_MS - 1000 * size / (KBPS * 125) <= longest <= QUEUE_MS


SETUP = (
    b"SETUP rtsp://h/c/stream=0 RTSP/1.0\r\nCSeq: 4\r\n"
    b"Transport: RTP/AVPF;unicast;client_port=50002-50003,RTP/AVP;unicast;client_port=50002-50003\r\n\r\n"
)
REPLY = (
    b"RTSP/1.0 200 OK\r\n"
    b"transport: RTP/AVPF;unicast;client_port=6-7;server_port=8-9;mode=PLAY\r\nX: client_port=6\r\n\r\n"
)
SDP = b"RTSP/1.0 200 OK\r\nContent-length: 28\r\n\r\nTransport: client_port=1-2\r\n"
PACKET = b"$\x00\x00\x06\r\n\r\nab"


@given(st.lists(st.sampled_from([SETUP, REPLY, SDP, PACKET]), max_size=6), st.integers(1, 90))
def test_rtsp_is_cut_into_the_same_units_however_it_arrives(sent, chunk):
    data, units = b"".join(sent), Splitter()
    pieces = (data[start : start + chunk] for start in range(0, len(data), chunk))
    assert [unit for piece in pieces for unit in units.feed(piece)] == sent


def test_a_header_that_never_ends_is_not_rtsp():
    with pytest.raises(ValueError, match="no end of an RTSP header"):
        list(Splitter().feed(b"x" * 70_000))


def test_ports_are_read_and_replaced_in_the_transport_header_alone():
    assert ports(SETUP, "client_port") == [50002, 50002]
    assert ports(SETUP, "server_port") == []
    assert with_ports(SETUP, "client_port", lambda port: port + 100) == SETUP.replace(b"50002-50003", b"50102-50103")
    changed = with_ports(with_ports(REPLY, "client_port", lambda _: 60), "server_port", lambda _: 80)
    assert changed == REPLY.replace(b"client_port=6-7;server_port=8-9", b"client_port=60-61;server_port=80-81")
    for other in (SDP, PACKET):
        assert ports(other, "client_port") == []
        assert with_ports(other, "client_port", lambda _: 1) == other


def test_a_delay_changes_for_later_packets_and_none_overtakes_another():
    async def deliver():
        direction, arrived = Direction(10_000, 100, 0), []
        for number, delay_ms in enumerate((120, 0, 40)):
            direction.change(None, delay_ms)
            direction.put(100, lambda number=number: arrived.append((number, time.monotonic() - began)))
        while len(arrived) < 3:
            await asyncio.sleep(0.005)
        return arrived

    began = time.monotonic()
    arrived = asyncio.run(deliver())
    assert [number for number, _ in arrived] == [0, 1, 2]
    assert arrived[0][1] >= 0.12


@pytest.mark.parametrize(("loss", "burst"), [(0.002, 1), (0.01, 1), (0.03, 10), (0.2, 3)])
def test_losses_have_the_configured_share_and_burst_length(loss, burst):
    losses = LossModel(loss, burst)
    drawn = [losses.draw() for _ in range(400_000)]
    runs = sum(lost and not before for before, lost in pairwise([False, *drawn]))
    assert sum(drawn) / len(drawn) == pytest.approx(loss, rel=0.1)
    assert sum(drawn) / runs == pytest.approx(max(burst, 1 / (1 - loss)), rel=0.1)


@pytest.mark.parametrize(("loss", "drawn"), [(0, {False}), (1, {True})])
def test_a_loss_of_0_or_1_is_exact(loss, drawn):
    losses = LossModel(loss, 1)
    assert {losses.draw() for _ in range(1000)} == drawn
