"""Access units: where a decoder can start, and what a late decoder receives."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from runner.h264.access_unit import AccessUnit, RecentUnits, read_unit

AUD, SPS, PPS, SEI, IDR, SLICE = (bytes([0, 0, 0, 1, kind]) for kind in (0x09, 0x67, 0x68, 0x06, 0x65, 0x41))


@pytest.mark.parametrize(
    ("data", "anew"),
    [
        (AUD + SPS + PPS + IDR + b"\x88", True),
        (AUD + SPS + PPS + SEI + SLICE + b"\x9a", False),  # a refresh wave begins: parameter sets, but no IDR
        (SLICE + b"\x9a", False),
        (b"\0\0\1\x65\x88", True),  # short start code
        (b"\0\0\0\1\x25\x88", True),  # nal_ref_idc 1
    ],
)
def test_only_an_idr_restarts_the_stored_units(data, anew):
    assert read_unit(data, None, 0).key is anew


@pytest.mark.parametrize("data", [AUD + SPS, AUD, b"", b"\0\0\1"])
def test_a_unit_without_a_picture_is_useless(data):
    assert read_unit(data, None, 0) is None


def test_an_incomplete_picture_is_dropped_and_an_incomplete_idr_becomes_grey():
    sps = b"\0\0\0\1" + bytes.fromhex("6742c015a681e08fe7c05a83008320000003002000000303d1e2c5d4")
    assert read_unit(AUD + SLICE + b"\x9a", None, 0, damaged=True) is None
    assert read_unit(AUD + IDR + b"\x88", None, 0, damaged=True) is None  # a grey picture needs a parameter set
    grey = read_unit(AUD + sps + PPS + IDR + b"\x88", 1.5, 2.5, damaged=True)
    assert (grey.captured, grey.arrived, grey.key, grey.exact) == (1.5, 2.5, True, False)
    assert read_unit(grey.data, None, 0).key
    assert PPS in grey.data  # those of the stream: later units may lack them
    recent = RecentUnits(refresh_s=1.0)
    shown = [recent.add(grey), *(recent.add(unit(2.5 + tenth / 10)) for tenth in range(1, 30))]
    assert [u.arrived for u in shown if u.exact] == [2.5 + tenth / 10 for tenth in range(20, 30)]


def test_a_clock_that_is_set_back_keeps_no_more_units():
    recent = RecentUnits(refresh_s=1.0)
    recent.add(unit(5000, key=True))
    for tenth in range(1, 101):
        recent.add(unit(5000 + tenth / 10))
    for tenth in range(201):
        recent.add(unit(1400 + tenth / 10))
    _, *rest = recent.burst()
    assert [u.arrived for u in rest] == [1400 + tenth / 10 for tenth in range(180, 201)]


@pytest.mark.parametrize(
    ("message", "frames"),
    [
        ("0601c0", 0),  # recovery point, ue(0)
        ("06029a60", 0),
        ("0602098080", 18),
        ("05100102030405060708", None),  # user data
    ],
)
def test_a_recovery_point_states_its_frames(message, frames):
    unit = read_unit(AUD + SPS + PPS + b"\0\0\0\1\x06" + bytes.fromhex(message) + SLICE + b"\x9a", None, 0)
    assert (unit.key, unit.recovery) == (False, frames)


def unit(arrived, key=False, recovery=None):
    return AccessUnit(b"", None, arrived, key, recovery)


def test_a_late_decoder_gets_the_idr_and_two_refresh_periods():
    recent = RecentUnits(refresh_s=1.0)
    recent.add(unit(-1))  # nothing before the first IDR can be decoded
    assert recent.burst() == []
    recent.add(unit(0, key=True))
    for tenth in range(1, 101):
        recent.add(unit(tenth / 10))
    first, *rest = recent.burst()
    assert first.key
    assert [u.arrived for u in rest] == [tenth / 10 for tenth in range(80, 101)]


def test_a_stream_that_is_joined_late_starts_grey_and_is_exact_after_two_periods():
    sps = bytes.fromhex("6742c015a681e08fe7c05a83008320000003002000000303d1e2c5d4")  # x264, 480x260
    recent = RecentUnits(refresh_s=1.0)
    shown = [recent.add(unit(0))]  # no parameter sets yet
    shown.append(recent.add(AccessUnit(b"\0\0\0\1" + sps + PPS + SLICE, 0.1, 0.1, key=False)))
    shown += [recent.add(unit(tenth / 10)) for tenth in range(2, 30)]
    assert [u.arrived for u in shown if u.exact] == [tenth / 10 for tenth in range(21, 30)]
    first, second, *_ = recent.burst()
    assert (first.key, first.exact, read_unit(first.data, None, 0).key) == (True, False, True)
    assert second.arrived == 0.9  # the burst has only the units that the newest needs
    assert recent.add(unit(3, key=True)).exact
    assert recent.add(unit(3.1)).exact


def keyed(*units):
    recent = RecentUnits(refresh_s=10.0, keyed=True)
    return recent, [recent.add(each) for each in units]


def test_a_camera_that_encodes_by_itself_is_shown_from_its_next_key_picture_on():
    sps = bytes.fromhex("6742c015a681e08fe7c05a83008320000003002000000303d1e2c5d4")
    with_sets = AccessUnit(b"\0\0\0\1" + sps + PPS + SLICE, 0, 0, key=False)
    recent, shown = keyed(with_sets, unit(1), unit(2))
    assert (recent.burst(), [each.exact for each in shown]) == ([], [False] * 3)
    assert recent.add(unit(3, key=True)).exact
    recent.add(unit(4))
    assert [each.arrived for each in recent.burst()] == [3, 4]


def test_one_that_announces_waves_is_shown_from_the_next_one_on():
    sps = bytes.fromhex("6742c015a681e08fe7c05a83008320000003002000000303d1e2c5d4")
    begins = AccessUnit(b"\0\0\0\1" + sps + PPS + SLICE, 1, 1, key=False, recovery=2)
    recent, shown = keyed(unit(0), begins, unit(2), unit(3), unit(4))
    assert [each.exact for each in shown] == [False, False, False, True, True]
    assert [each.arrived for each in recent.burst()] == [1, 1, 2, 3, 4]


def test_what_follows_a_key_picture_that_is_too_old_cannot_be_begun_with_but_is_shown():
    recent, shown = keyed(unit(0, key=True), *(unit(second) for second in range(1, 24)))
    assert (recent.burst(), [each.exact for each in shown[-3:]]) == ([], [True, True, True])
    recent.add(unit(30, key=True))
    assert len(recent.burst()) == 1


def test_a_burst_begins_with_the_last_completed_wave():
    recent = RecentUnits(refresh_s=1.0)
    recent.add(unit(0, key=True))
    for tenth in range(1, 58):
        recent.add(unit(tenth / 10, recovery=9 if tenth % 10 == 0 else None))
    _, *rest = recent.burst()
    assert [u.arrived for u in rest] == [tenth / 10 for tenth in range(40, 58)]  # the wave of 5.0 has not ended
    recent.add(unit(5.8))
    recent.add(unit(5.9))
    assert recent.burst()[1].arrived == 5.0


def test_a_grey_start_is_exact_after_the_first_whole_wave():
    recent = RecentUnits(refresh_s=1.0)
    sps = bytes.fromhex("6742c015a681e08fe7c05a83008320000003002000000303d1e2c5d4")
    shown = [recent.add(AccessUnit(b"\0\0\0\1" + sps + PPS + SLICE, None, 0.0, False))]
    shown += [recent.add(unit(tenth / 10, recovery=4 if tenth == 3 else None)) for tenth in range(1, 12)]
    assert [u.arrived for u in shown if u.exact] == [0.7, 0.8, 0.9, 1.0, 1.1]


def test_a_grey_start_may_itself_be_the_beginning_of_the_wave():
    recent = RecentUnits(refresh_s=1.0)
    sps = bytes.fromhex("6742c015a681e08fe7c05a83008320000003002000000303d1e2c5d4")
    shown = [recent.add(AccessUnit(b"\0\0\0\1" + sps + PPS + SLICE, None, 0.0, False, recovery=4))]
    shown += [recent.add(unit(tenth / 10)) for tenth in range(1, 8)]
    assert [u.arrived for u in shown if u.exact] == [0.4, 0.5, 0.6, 0.7]


def test_a_wave_that_takes_longer_than_stated_is_kept_whole():
    recent = RecentUnits(refresh_s=1.0)
    recent.add(unit(0, key=True))
    for number in range(1, 59):  # a wave of ten frames takes three seconds, not one
        recent.add(unit(number * 0.3, recovery=9 if number % 10 == 0 else None))
    _, *rest = recent.burst()
    assert [u.recovery for u in rest[:11]] == [9, *[None] * 9, 9]
    assert len(rest) == 19


@pytest.mark.parametrize("waves", [True, False])
def test_who_joins_after_a_long_pause_is_not_shown_an_old_picture_in_part(waves):
    recent = RecentUnits(refresh_s=1.0)

    def passed(seconds, begin):
        times = [round(begin + tenth / 10, 1) for tenth in range(round(10 * seconds))]
        return [recent.add(unit(t, recovery=9 if waves and round(10 * t) % 10 == 0 else None)) for t in times]

    recent.add(unit(0, key=True))
    assert all(u.whole for u in passed(10, begin=0.1))
    resumed = passed(4, begin=30.5)
    assert all(u.exact for u in resumed), "a decoder that has been running is exact"
    first = next(u.arrived for u in resumed if u.whole)
    assert first == (31.9 if waves else 32.5), "the end of the first wave, or two periods"
    assert all(u.whole for u in resumed if u.arrived >= first)
    assert recent.add(unit(60)).whole is False
    recent.add(unit(60.1, key=True))
    assert recent.add(unit(60.2)).whole


@pytest.mark.parametrize("joined", ["late", "grey"])
def test_pauses_and_slow_frames_refresh_nothing(joined):
    recent = RecentUnits(refresh_s=1.0)
    if joined == "grey":
        sps = bytes.fromhex("6742c015a681e08fe7c05a83008320000003002000000303d1e2c5d4")
        recent.add(AccessUnit(b"\0\0\0\1" + sps + PPS + SLICE, None, 0.0, False))
        times = [tenth / 10 for tenth in range(1, 10)]
    else:
        recent.add(unit(0, key=True))
        times = [tenth / 10 for tenth in range(1, 51)]
    for t in times:
        recent.add(unit(t, recovery=9 if joined == "late" and round(10 * t) % 10 == 0 else None))
    # After the pause a frame takes 0.3 s, so that a wave of ten takes 3 s, longer than two periods.
    shown = [recent.add(unit(30 + number * 0.3, recovery=9 if number % 10 == 5 else None)) for number in range(40)]
    first = next(number for number, u in enumerate(shown) if u.exact and u.whole)
    assert first == 14, "the end of the first whole wave"
    assert all(u.exact and u.whole for u in shown[first:])
    if joined == "late":
        assert all(u.exact for u in shown)


def test_a_second_pause_is_no_refresh_either():
    recent = RecentUnits(refresh_s=1.0)
    recent.add(unit(0, key=True))
    for tenth in range(1, 40):
        recent.add(unit(tenth / 10))
    times = [30.0, 30.1, *(31.8 + tenth / 10 for tenth in range(40))]
    whole = {round(t, 1): recent.add(unit(t)).whole for t in times}
    assert not whole[31.8]
    assert next(t for t in whole if whole[t]) == pytest.approx(32.7, abs=0.15)


def test_who_joins_after_a_short_pause_starts_with_the_units_before_it():
    recent = RecentUnits(refresh_s=1.0)
    recent.add(unit(0, key=True))
    times = [*(tenth / 10 for tenth in range(1, 60)), 11.0, 11.1]
    shown = [recent.add(unit(t, recovery=9 if round(10 * t) % 10 == 0 else None)) for t in times]
    assert all(u.whole for u in shown)
    assert recent.burst()[1].arrived < 6


def test_waves_that_never_end_are_forgotten():
    recent = RecentUnits(refresh_s=1.0)
    recent.add(unit(0, key=True))
    for number in range(1, 1000):
        recent.add(unit(number / 10, recovery=5000))
    assert len(recent.burst()) <= 2 + 80


def test_a_new_idr_makes_everything_before_it_needless():
    recent = RecentUnits(refresh_s=1.0)
    for arrived, key in ((0, True), (0.1, False), (0.2, True), (0.3, False)):
        recent.add(unit(arrived, key))
    assert [u.arrived for u in recent.burst()] == [0.2, 0.3]


@given(st.lists(st.tuples(st.floats(0.01, 0.5), st.booleans()), max_size=200), st.floats(0.1, 2))
def test_a_burst_begins_with_an_idr_ends_with_the_newest_and_is_bounded(steps, refresh_s):
    recent, now, everything = RecentUnits(refresh_s), 0.0, []
    for step, key in steps:
        now += step
        everything.append(recent.add(unit(now, key)))
    burst = recent.burst()
    assert bool(burst) == any(u.key for u in everything)
    if burst:
        assert burst[0].key
        assert burst[-1] is everything[-1]
        assert not any(u.key for u in burst[1:])
        assert all(u.arrived >= now - 2 * refresh_s for u in burst[1:])
        # Only the units between the IDR and the last two periods are missing.
        since = everything[everything.index(burst[0]) + 1 :]
        assert burst[1:] == [u for u in since if u.arrived >= now - 2 * refresh_s]


# --- H.265 ------------------------------------------------------------------------------------------------------------


def h265(*kinds: int) -> bytes:
    """An access unit of NAL units of some types (ITU-T H.265, table 7-1)."""
    return b"".join(b"\0\0\0\1" + bytes([kind << 1, 1, 0xAF]) for kind in kinds)


@pytest.mark.parametrize(
    ("kinds", "key"),
    [((32, 33, 34, 19), True), ((35, 21), True), ((39, 20), True), ((1,), False), ((32, 33, 34, 39, 0), False)],
)
def test_a_unit_of_h265_is_key_by_its_picture_and_not_by_its_parameter_sets(kinds, key):
    unit = read_unit(h265(*kinds), 1.0, 2.0, codec="h265")
    assert unit is not None
    assert (unit.key, unit.exact, unit.data) == (key, True, h265(*kinds))


def test_damaged_h265_units_and_those_without_a_picture_are_useless():
    assert read_unit(h265(19), 1.0, 2.0, damaged=True, codec="h265") is None
    assert read_unit(h265(32, 33, 34), 1.0, 2.0, codec="h265") is None


def test_a_stream_of_h265_begins_with_its_next_key_picture():
    recent = RecentUnits(1.0, "h265")
    assert recent.add(read_unit(h265(33, 1), 1.0, 1.0, codec="h265")).exact is False
    assert recent.burst() == []
    key = read_unit(h265(33, 19), 2.0, 2.0, codec="h265")
    assert recent.add(key) == key
    assert recent.burst() == [key]


def test_later_key_pictures_of_h265_get_the_parameter_sets_last_seen() -> None:
    """As x265 sends them: its later key pictures are CRA (NAL unit type 21) without any."""

    def nal(kind: int, code: bytes = b"\0\0\0\1") -> bytes:
        return code + bytes([kind << 1, 1, 0x55, kind])

    sets = nal(32) + nal(33) + nal(34)
    first, picture, cra = nal(35) + sets + nal(39) + nal(21), nal(1), nal(21, b"\0\0\1")
    recent = RecentUnits(refresh_s=1.0, codec="h265")
    shown = [recent.add(read(data, at)) for at, data in enumerate((first, picture, cra, picture))]
    assert [unit.data for unit in shown] == [first, picture, sets + cra, picture]
    assert [unit.data for unit in recent.burst()] == [sets + cra, picture]
    assert [unit.key for unit in shown] == [True, False, True, False]
    unseen = RecentUnits(refresh_s=1.0, codec="h265")
    assert unseen.add(read(cra, 0)).data == cra


def read(data: bytes, at: float) -> AccessUnit:
    unit = read_unit(data, None, at, codec="h265")
    assert unit
    return unit
