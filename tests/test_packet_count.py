"""What arrived between two times, of all cameras: the arithmetic of reception reports."""

from __future__ import annotations

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from runner.operator import packet_count
from runner.operator.packet_count import Count, PacketCount

FRONT = [(0.010, 1000), (0.020, 1000), (0.030, 500)]  # three packets of a frame
REAR = [(0.015, 800), (0.025, 800), (0.035, 300)]


def test_packets_of_two_cameras_are_counted_together() -> None:
    count = PacketCount()
    count.add([*FRONT, *REAR])
    assert count.between(0.010, 0.030) == Count(4, 800 + 1000 + 800 + 500)
    assert count.between(0.015, 0.035) == Count(4, 1000 + 800 + 500 + 300)
    assert [count.carried(at) for at in (0.030, 0.035)] == [Count(5, 4100), Count(1, 300)]


def test_a_frame_that_arrives_during_a_report_counts_with_its_first_part() -> None:
    count = PacketCount()
    count.add([*FRONT[:2], *REAR[:2]])
    count.add([FRONT[2], REAR[2]])
    assert count.between(0.010, 0.030) == Count(4, 3100)
    assert [count.carried(at) for at in (0.030, 0.035)] == [Count(5, 4100), Count(1, 300)]


def test_a_repeated_packet_between_two_frames_was_carried_too() -> None:
    count = PacketCount()
    count.add([*FRONT, (0.032, 1000), *REAR])
    assert count.between(0.015, 0.035) == Count(5, 3600)
    assert [count.carried(at) for at in (0.030, 0.035)] == [Count(5, 4100), Count(2, 1300)]


def test_a_packet_that_is_handled_after_the_report_counts_with_the_next_frame() -> None:
    """Another thread was late: the kernel had received it before the frame that was then reported."""
    count = PacketCount()
    count.add([*FRONT, *REAR[:1]])
    assert count.carried(0.030) == Count(4, 3300)
    count.add([*REAR[1:], (0.040, 700)])
    assert count.between(0.010, 0.030) == Count(4, 3100)
    assert count.carried(0.035) == Count(2, 1100)
    assert count.carried(0.040) == Count(1, 700)


def test_a_whole_frame_that_is_handled_after_the_report_counts_with_the_next_one() -> None:
    count = PacketCount()
    count.add([*FRONT, (0.040, 700)])
    assert count.carried(0.040) == Count(4, 3200)
    count.add([*REAR, (0.050, 600)])
    assert count.between(0.015, 0.035) == Count(4, 2600)
    assert [count.carried(at) for at in (0.035, 0.050)] == [Count(), Count(4, 2500)]


def test_packets_that_arrived_at_the_same_time_take_no_time() -> None:
    """As they do at the end of a slot of the radio link: only what follows the first ones is a train."""
    count = PacketCount()
    count.add([(0.010, 1000), (0.010, 1000), (0.020, 1000), (0.020, 1000)])
    assert count.between(0.010, 0.010) == Count()
    assert count.between(0.010, 0.020) == Count(2, 2000)
    assert [count.carried(0.020), count.carried(0.020)] == [Count(4, 4000), Count()]


def test_a_frame_that_began_too_long_ago_is_not_counted(monkeypatch) -> None:  # type: ignore[no-untyped-def]
    monkeypatch.setattr(packet_count, "KEPT", 4)
    count = PacketCount()
    count.add([*FRONT, *REAR])
    count.add([(0.040, 700)])
    assert count.between(0.015, 0.040) == Count()
    assert count.between(0.020, 0.040) == Count(4, 2300)
    assert count.carried(0.040) == Count(7, 5100)


def test_nothing_has_arrived() -> None:
    count = PacketCount()
    count.add([])
    assert (count.between(0.010, 0.020), count.carried(0.020)) == (Count(), Count())


PACKETS = st.lists(st.tuples(st.integers(0, 1000), st.integers(1, 1200), st.integers(0, 3)), min_size=1)


@given(packets=PACKETS, kept=st.sampled_from([3, 4096]))
def test_nothing_is_left_out_or_counted_twice(packets: list[tuple[int, int, int]], kept: int) -> None:
    """Whatever is handled late, and whichever packets end a frame."""
    count, before = PacketCount(), packet_count.KEPT
    packet_count.KEPT = kept
    try:
        carried = []
        for number in range(4):
            handled = [(ms / 1000, size) for ms, size, report in packets if report == number]
            count.add(handled)
            carried += [count.carried(at) for at, size in sorted(handled) if size % 2]
        carried.append(count.carried(2.0))
    finally:
        packet_count.KEPT = before
    assert min(min(each) for each in carried) >= 0
    assert sum(each.packets for each in carried) == len(packets)
    assert sum(each.bytes for each in carried) == sum(size for _, size, _ in packets)


@given(packets=PACKETS)
def test_between_is_additive(packets: list[tuple[int, int, int]]) -> None:
    count = PacketCount()
    count.add((ms / 1000, size) for ms, size, _ in packets)
    times = sorted({ms / 1000 for ms, _, _ in packets})
    parts = [count.between(*pair) for pair in pairwise(times)]
    whole = count.between(times[0], times[-1])
    assert (sum(each.packets for each in parts), sum(each.bytes for each in parts)) == whole
