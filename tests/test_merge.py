"""Packets of one stream that come by two uplinks, one of them slower: which go on, and what is counted for each."""

from __future__ import annotations

import struct
from collections.abc import Iterable

import pytest

from runner.gst.arriving import NUMBERS, RTP_HZ, Packet, read_packet
from runner.gst.merge import PAUSE_S, TAKING_OVER_S, Merge, WholeFrames
from runner.records.reception import UplinkReceived

pytestmark = pytest.mark.gst  # the package runner.gst loads it

VIDEO, REPEATED = 96, 97
FIRST = NUMBERS - 50  # the numbers wrap around soon
PER_S = 100  # packets


class Ways:
    """A stream of 100 packets a second of 1000 bytes."""

    def __init__(self, *, is_authentic: bool = True) -> None:
        self.merge = Merge(is_authentic=is_authentic)
        self.merge.payload_type = VIDEO

    def come(
        self, numbers: Iterable[int], uplink: str, delay_s: float, *, kind: int = VIDEO, stream: int = 7
    ) -> list[int]:
        """Packets come so much after they were sent; returns those that go on, which the session then passes."""
        passed = []
        for number in numbers:
            now, stamp = number / PER_S + delay_s, round(number * RTP_HZ / PER_S) % 2**32
            header = struct.pack("!BBHII", 0x80, kind, (FIRST + number) % NUMBERS, stamp, stream)
            packet = read_packet(header, 1012)
            if self.merge.passes(header, packet, uplink, now, None):
                passed.append(number)
                self.merge.note_passed(packet, now)
        return passed


def test_each_packet_goes_on_once_and_counts_for_each_uplink_that_it_came_by() -> None:
    ways = Ways()
    for number in range(100):
        assert ways.come([number], "a", 0.02) == [number]
        if number >= 10 and number % 10:
            assert ways.come([number - 10], "b", 0.12) == []
    assert ways.merge.counts() == {
        "a": UplinkReceived(packets=100),
        "b": UplinkReceived(packets=81, lost=8, twins=81),
    }
    assert ways.merge.difference_s == pytest.approx(0.1)


def test_what_one_uplink_has_lost_comes_by_the_other() -> None:
    ways = Ways()
    assert ways.come([0, 1, 3], "a", 0.02) == [0, 1, 3]
    assert ways.come([0, 1, 2, 3], "b", 0.12) == [2]
    assert ways.merge.counts()["a"].lost == 1


def test_twins_are_only_counted_if_somebody_else_may_have_sent_them() -> None:
    ways = Ways(is_authentic=False)
    assert ways.come([0, 1], "a", 0.02) + ways.come([0, 1], "b", 0.12) == [0, 1, 0, 1]
    assert ways.merge.counts()["b"].twins == 2


def test_repeated_packets_have_numbers_of_their_own_and_pass_once() -> None:
    ways = Ways()
    ways.come(range(10), "a", 0.02)
    assert ways.come([3, 4], "a", 0.1, kind=REPEATED, stream=8) == [3, 4]
    assert ways.come([3, 4], "b", 0.1, kind=REPEATED, stream=8) == []
    assert ways.merge.counts()["b"] == UplinkReceived(packets=2, twins=2)


def test_packets_that_were_held_are_dropped_while_newer_ones_come() -> None:
    """Also those that never came by another uplink: the jitter buffer has given them up."""
    ways = Ways()
    ways.come(range(100), "a", 0.02)
    ways.come(range(200, 1200), "b", 0.02)
    assert ways.come(range(100, 1000), "a", 2.5) == []
    assert ways.merge.counts()["a"].late == 900
    assert ways.come(range(1200, 1210), "b", 0.02) == [*range(1200, 1210)]


def test_a_stream_that_starts_anew_with_older_times_goes_on() -> None:
    ways = Ways()
    ways.come(range(1000, 1100), "a", 0.02)
    assert ways.come([0], "a", 10.5) == []
    assert ways.come([1], "a", 13.1) == [1]


def test_an_uplink_that_the_camera_has_left_for_a_while_has_lost_nothing() -> None:
    ways = Ways()
    gone = round(PER_S * PAUSE_S) + 2
    for numbers in (range(100), range(100 + gone, 200 + gone)):
        ways.come(numbers, "a", 0.02)
    assert ways.merge.counts()["a"].lost == 0


def test_an_uplink_that_no_longer_carries_the_camera_is_not_awaited() -> None:
    ways = Ways()
    ways.come(range(10), "b", 0.2)
    ways.come(range(10, 150), "a", 0.02)
    assert ways.merge.difference_s == 0


def test_an_uplink_takes_over_from_one_that_has_failed() -> None:
    ways = Ways()
    ways.come(range(100), "a", 0.02)
    ways.come(range(105, 110), "b", 0.03)
    assert not ways.merge.has_taken_over(1.14), "too short a pause"
    ways.come(range(130, 140), "b", 0.03)
    assert not ways.merge.has_taken_over(1.43), "it had carried the stream before"
    ways.come(range(220, 221), "a", 0.02)
    assert ways.merge.has_taken_over(2.23)
    assert not ways.merge.has_taken_over(2.25 + TAKING_OVER_S)


def test_frames_of_which_all_packets_have_come() -> None:
    frames = WholeFrames()
    packets = [(5, 1.0, False), (6, None, True), (7, 1.1, True), (9, None, True), (10, 1.3, False)]
    for number, captured, last in [*packets, (20, 1.5, False), (21, None, True), (24, None, True)]:
        frames.add(Packet(number, 0, last, 1000, captured))
    assert [frames.captured(stated) for stated in (1.0, 1.1, 1.2, 1.5)] == [1.0, 1.1, None, 1.5]
    assert frames.captured(1.3) == 1.5, "its end has not come: the next one is output with its beginning"
