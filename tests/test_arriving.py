"""Packets grouped into frames as they arrive: bytes, arrival time and missing packets of each frame."""

from __future__ import annotations

import pytest

from runner.gst.arriving import NTP_EPOCH_S, RTP_HZ, WINDOW_S, ArrivingFrames, Lateness, MediaClock, Packet, read_packet

pytestmark = pytest.mark.gst

MS = 0.001
CAPTURED = 1_700_000_000.25


def header(*, extension: bytes = b"", sources: int = 0, last: bool = False) -> bytes:
    first = bytes([0x80 | (0x10 if extension else 0) | sources, 96 | (0x80 if last else 0)])
    return first + bytes.fromhex("12340000abcd") + bytes(4 + 4 * sources) + extension


def extension(number: int = 1, captured: float = CAPTURED) -> bytes:
    ntp = round((captured + NTP_EPOCH_S) * 2**32).to_bytes(8, "big")
    return b"\xbe\xde\x00\x03" + bytes([number << 4 | 7]) + ntp + bytes(3)


@pytest.mark.parametrize(
    ("data", "size", "payload", "captured"),
    [
        (header(), 112, 100, None),
        (header(sources=2), 120, 100, None),
        (header(extension=extension()), 128, 100, CAPTURED),
        (header(extension=extension(number=2)), 128, 100, None),
        (header(extension=extension(captured=-NTP_EPOCH_S)), 128, 100, None),  # not filled in
        (header(extension=b"\x10\x00\x00\x01\x00\x00\x00\x00"), 120, 100, None),  # of two bytes (RFC 8285, section 4.3)
        (header(), 12, 0, None),
    ],
)
def test_header_fields_are_parsed(data: bytes, size: int, payload: int, captured: float | None) -> None:
    assert read_packet(data, size) == Packet(0x1234, 0xABCD, last=False, bytes=payload, captured=captured)


def test_the_marker_ends_a_frame() -> None:
    assert read_packet(header(last=True), 12).last


class Stream:
    """Frames of two packets of 1000 bytes, one every 50 ms; the packets of a frame are 2 ms apart.

    The first one states when the frame was captured.
    """

    def __init__(self) -> None:
        self.frames, self._first = ArrivingFrames(), 65_530  # numbers wrap around soon

    def send(self, frame: int, parts: str = "01", *, after_ms: float = 0, retransmitted: bool = False) -> bool:
        newer = False
        for part in map(int, parts):
            captured = CAPTURED + frame / 20 if part == 0 else None  # as sent by GStreamer
            packet = Packet((self._first + 2 * frame + part) % 65536, 4500 * frame % 2**32, part == 1, 1000, captured)
            newer = self.frames.add(packet, self.at(frame, 2 * part + after_ms), retransmitted=retransmitted)
        return newer

    @staticmethod
    def at(frame: int, ms: float = 0) -> float:
        return frame / 20 + ms * MS

    def taken(self, frame: int, ms: float = 40) -> list[tuple[float, float, int, bool]]:
        """Frames taken `ms` after the start of one: number, ms from its start to its arrival, bytes, whole."""
        found = []
        for each in self.frames.take(self.at(frame, ms)):
            number = round(20 * (each.captured - CAPTURED))
            found.append((number, round(1000 * (each.arrived - number / 20), 3), each.bytes, each.whole))
        return found

    @property
    def counted(self) -> tuple[int, int]:
        return self.frames.received, self.frames.missing


def test_whole_frames() -> None:
    stream = Stream()
    for frame in range(10):
        stream.send(frame)
    assert stream.taken(9) == [(frame, 2, 2000, True) for frame in range(10)]
    assert stream.taken(9) == []
    assert stream.counted == (20, 0)


def test_a_missing_first_packet() -> None:
    stream = Stream()
    stream.send(0)
    stream.send(1, "1")
    assert stream.taken(1) == [(0, 2, 2000, True), (1, 2, 1000, False)]
    assert stream.counted == (3, 1)


def test_a_missing_last_packet_is_detected_by_timeout_and_by_the_next_frame() -> None:
    stream = Stream()
    stream.send(0)
    stream.send(1, "0")
    assert not stream.frames.is_late(stream.at(1, 9))
    assert stream.taken(1, 9) == [(0, 2, 2000, True)]
    assert stream.frames.is_late(stream.at(1, 11))
    assert stream.taken(1, 11) == [(1, 0, 1000, False)]
    assert stream.frames.is_late(stream.at(1, 11)), "its last packet may still be requested"
    assert stream.frames.next_number() == 65_533
    stream.send(2)
    stream.send(3, "0")
    stream.send(4)
    assert stream.taken(4) == [(2, 2, 2000, False), (3, 0, 1000, False), (4, 2, 2000, False)]
    assert stream.counted == (8, 2)


def test_a_frame_lost_whole_is_overdue_before_the_next_one() -> None:
    stream = Stream()
    stream.send(0)
    assert not stream.frames.is_late(stream.at(9)), "the frame rate is unknown"
    stream.send(1)
    assert not stream.frames.is_late(stream.at(2, 10))
    assert stream.frames.is_late(stream.at(2, 20))
    assert stream.frames.next_number() == 65_534
    assert stream.taken(2, 20) == [(0, 2, 2000, True), (1, 2, 2000, True)], "it has not arrived"
    stream.send(3)
    assert stream.taken(3) == [(3, 2, 2000, False)]
    assert stream.frames.is_late(stream.at(4, 20)), "the missing frame does not count as a lower frame rate"


def test_frames_that_all_arrive_late_are_not_overdue() -> None:
    stream = Stream()
    for frame in range(5):
        stream.send(frame, after_ms=25 * frame)  # the link carries two thirds of what is sent
        assert frame < 2 or not stream.frames.is_late(stream.at(frame + 1, 25 * (frame + 1)))


def test_packets_that_are_read_late_arrived_earlier_and_their_frame_is_not_overdue() -> None:
    """A process that was held up reads them 0.2 s after the kernel received them."""
    frames = ArrivingFrames()
    for number in range(4):
        read = 10.2 + 0.001 * number
        frames.add(Packet(number, 4500, number == 3, 1000, CAPTURED), read, read - 0.2)
        assert not frames.is_late(read + 0.005)
    assert [frame.arrived for frame in frames.take(10.21)] == [pytest.approx(10.003)]


def receive(*packets: tuple[int, float | None], stamp: int = 4500) -> ArrivingFrames:
    """A frame of packets with these numbers, of which 3 is the last one, and the times of the kernel."""
    frames = ArrivingFrames()
    for number, at in packets:
        frames.add(Packet(number, stamp, number == 3, 1000 + number, CAPTURED), 10.0 if at is None else at + 0.2, at)
    return frames


def test_a_frame_began_when_the_kernel_received_its_first_packet() -> None:
    (frame,) = receive((1, 10.001), (2, 10.004), (3, 10.006)).take(10.3)
    assert (frame.first, frame.arrived, frame.whole) == (10.001, 10.006, True)


def test_a_frame_whose_packets_have_times_out_of_order_does_not_end_before_it_began() -> None:
    """As after two processors took them from different devices."""
    (frame,) = receive((1, 10.0061), (2, 10.006), (3, 10.006)).take(10.3)
    assert (frame.first, frame.arrived) == (10.006, 10.006)


@pytest.mark.parametrize("times", [(None, None, None), (10.001, 10.004, None), (None, 10.004, 10.006)])
def test_when_a_frame_began_is_unknown_unless_the_kernel_states_its_first_and_last_packet(times: list[float]) -> None:
    """Over TCP and SRT packets are read after others, and by a process that other threads hold up."""
    (frame,) = receive(*zip((1, 2, 3), times, strict=True)).take(10.3)
    assert (frame.first, frame.arrived) == (None, times[-1] or 10.0)


def test_a_frame_in_two_parts_began_with_the_first_one() -> None:
    frames = receive((1, 10.001), (2, 10.002))
    first = frames.take(10.3)
    frames.add(Packet(3, 4500, True, 1003, CAPTURED), 10.4, 10.35)
    parts = [(each.first, each.arrived, each.bytes, each.whole) for each in (*first, *frames.take(10.4))]
    assert parts == [(10.001, 10.002, 2003, False), (10.001, 10.35, 1003, False)]


def test_every_packet_that_arrives_is_counted_once() -> None:
    """Also those that are repeated, retransmitted or reordered, and strays; in the order in which they are handled."""
    frames = receive((2, 10.002), (1, 10.001), (1, 10.001))
    frames.add(Packet(1, 4500, False, 1001, CAPTURED), 10.4, 10.3, retransmitted=True)
    frames.add(Packet(30_000, 0, False, 500, CAPTURED), 10.5)
    expected = [(10.002, 1002), (10.001, 1001), (10.001, 1001), (10.3, 1001), (10.5, 500)]
    assert (frames.take_packets(), frames.take_packets()) == (expected, [])


def test_a_reordered_packet_is_not_missing() -> None:
    stream = Stream()
    stream.send(0)
    assert not stream.send(1, "10")
    stream.send(2)
    assert [size for _, _, size, _ in stream.taken(2)] == [2000, 1000, 3000]
    assert stream.counted == (6, 0)


def test_a_retransmitted_packet_counts_as_missing() -> None:
    stream = Stream()
    stream.send(0)
    stream.send(1, "1")
    assert not stream.send(1, "0", after_ms=20, retransmitted=True)
    stream.send(2, "0")
    assert stream.send(2, "1", after_ms=30, retransmitted=True), "the last one of a frame, requested after a timeout"
    assert [(number, size, whole) for number, _, size, whole in stream.taken(2)] == [
        (0, 2000, True),
        (1, 1000, False),
        (2, 3000, False),
    ]
    assert stream.counted == (4, 2)
    stream.send(3, "0")
    assert stream.frames.is_late(stream.at(3, 11)), "the time of a retransmission is no gap between packets"


@pytest.mark.parametrize("first", [30_000, 65_000])
def test_a_restarted_stream_is_recognised_by_its_second_packet(first: int) -> None:
    stream = Stream()
    stream.send(0)
    stream._first = first
    for frame in range(1, 5):
        stream.send(frame)
    whole = [(frame, 2, 2000, True) for frame in range(5)]
    assert stream.taken(4) == [whole[0], *whole[2:]], "when frame 1 was captured is lost"
    assert stream.counted == (9, 0)


def test_one_stray_packet_is_no_restart() -> None:
    stream = Stream()
    stream.send(0)
    stream.frames.add(Packet(30_000, 0, last=False, bytes=1000, captured=0.0), 0.01)
    stream.send(1)
    assert stream.taken(1) == [(0, 2, 2000, True), (1, 2, 2000, True)]
    assert stream.counted == (4, 0)


@pytest.mark.parametrize("held_s", [1, 10])
def test_packets_that_a_way_has_held_are_no_new_stream(held_s: int) -> None:
    """Nor are they missing once they have come; at 8 Mbit/s that many numbers are thousands."""
    frames, count = ArrivingFrames(), held_s * 833

    def add(number: int, at: float) -> bool:
        packet = Packet(number % 65_536, round(number / 833 * RTP_HZ) % 2**32, last=True, bytes=1000, captured=None)
        return frames.add(packet, at)

    assert add(65_000, 0)
    assert add(65_000 + count, held_s)
    assert not any(add(65_000 + number, held_s + 0.1) for number in range(1, count))
    assert (frames.received, frames.missing) == (count + 1, 0)
    assert add(65_001 + count, held_s + 0.2)


def test_a_duplicate_packet_hides_no_loss() -> None:
    stream = Stream()
    stream.send(0)
    stream.send(1, "1")
    stream.send(1, "1", after_ms=1)
    stream.send(1, "1", after_ms=1)
    assert stream.counted == (3, 1)
    stream.send(1, "0", after_ms=2)
    stream.send(1, "0", after_ms=2)
    assert stream.counted == (4, 0)


def test_a_media_clock_wraps_around() -> None:
    clock = MediaClock(1 / 90_000)
    clock.tick(2**32 - 90_000)
    before = clock.seconds
    clock.tick(0)
    clock.tick(90_000)
    assert clock.seconds - before == pytest.approx(2)
    clock.tick(0)  # backwards
    assert clock.seconds - before == pytest.approx(1)


# --- lateness ---------------------------------------------------------------------------------------------------------


class Packets:
    """Packets that are sent 100 times a second, whose transit takes 50 ms at least."""

    def __init__(self) -> None:
        self._lateness, self._sent, self.jump = Lateness(), 0, 0

    def late(self, seconds: float, delay: float = 0) -> list[float]:
        """How late those of some seconds seem that are delayed."""
        first, self._sent = self._sent, self._sent + round(100 * seconds)
        sent = range(first, self._sent)
        return [self._lateness.of((900 * n + self.jump) % 2**32, n / 100 + 0.05 + delay) for n in sent]


def test_packets_that_waited_in_an_outage_are_late() -> None:
    packets = Packets()
    packets.jump = 2**32 - 90_000  # the timestamp wraps around
    assert packets.late(3) == pytest.approx([0] * 300, abs=1e-6)
    packets._sent += 300
    for delay in (4, 3, 2, 1):
        assert packets.late(WINDOW_S / 5, delay) == pytest.approx([delay] * 100, abs=1e-6)
    assert packets.late(1) == pytest.approx([0] * 100, abs=1e-6)


def test_silence_does_not_age_what_is_usual() -> None:
    packets = Packets()
    packets.late(1)
    packets._sent += 1000
    assert packets.late(0.1, 3) == pytest.approx([3] * 10, abs=1e-6)


def test_a_longer_path_becomes_usual() -> None:
    packets = Packets()
    packets.late(10)
    late = packets.late(2 * WINDOW_S + 0.1, 2)
    assert late[: round(100 * WINDOW_S)] == pytest.approx([2] * 500, abs=1e-6)
    assert late[-1] == pytest.approx(0, abs=1e-6)
    packets.late(2 * WINDOW_S + 0.1)
    assert packets.late(0.1, 1)[-1] == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("seconds", [-1000, 1000])
def test_a_sender_that_sets_its_clock_anew_is_not_late(seconds: int) -> None:
    packets = Packets()
    packets.late(3)
    packets.jump = seconds * RTP_HZ
    assert packets.late(3)[-200:] == pytest.approx([0] * 200, abs=1e-6)
    assert packets.late(0.1, 1) == pytest.approx([1] * 10, abs=1e-6)
