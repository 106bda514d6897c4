"""How long lost packets show: until an IDR picture, or a whole refresh wave that began after the last loss."""

from __future__ import annotations

import pytest

from runner.h264.damage import HEAD_BYTES, Damage

AUD, SPS, PPS, SEI, IDR, SLICE = (bytes([0, 0, 0, 1, kind]) for kind in (0x09, 0x67, 0x68, 0x06, 0x65, 0x41))
KEY = AUD + SPS + PPS + IDR + b"\x88"
DELTA = AUD + SLICE + b"\x9a"
WAVE_OF_4 = AUD + SPS + PPS + SEI + bytes.fromhex("060122") + SLICE + b"\x9a"  # recovery_frame_cnt 3: ue(3) = 00100


def damaged(units: list[tuple[bytes, bool]], codec: str = "h264") -> str:
    """One letter per unit: D for damaged, - for not."""
    damage = Damage(codec)
    return "".join("D" if damage.add(lost, lambda data=data: data) else "-" for data, lost in units)  # type: ignore[misc]


def stream(text: str, lost: str) -> list[tuple[bytes, bool]]:
    """Units by letter: k key, w a wave begins, . any other; lost: x where packets are missing."""
    kinds = {"k": KEY, "w": WAVE_OF_4, ".": DELTA}
    return [(kinds[kind], mark == "x") for kind, mark in zip(text, lost, strict=True)]


@pytest.mark.parametrize(
    ("text", "lost", "expected"),
    [
        ("k...w...w...", "            ", "------------"),
        ("k...k...", " x      ", "-DDD----"),  # an IDR picture heals immediately
        ("k...w...w...", " x          ", "-DDDDDD-----"),  # a wave heals with its last picture
        ("k...w...w...", "    x       ", "----DDDDDDD-"),  # a wave whose beginning is lost does not
        ("k...w...w...", " x   x      ", "-DDDDDDDDDD-"),  # nor does a wave with a loss
        ("k...w...w...", " x        x ", "-DDDDDD---DD"),
        ("k...", "x   ", "DDDD"),  # packets of the IDR picture itself are missing
    ],
)
def test_a_loss_shows_until_the_picture_is_healed(text: str, lost: str, expected: str) -> None:
    assert damaged(stream(text, lost)) == expected


def test_for_unsupported_codecs_only_incomplete_units_count_as_damaged() -> None:
    assert damaged([(b"", False), (b"", True), (b"", False)], codec="vp8") == "-D-"


def test_a_shorter_wave_that_begins_later_heals_first() -> None:
    """A wave of negative length, parsed from bytes that are no recovery point, does not count."""
    wave_of_100 = AUD + SPS + PPS + SEI + bytes.fromhex("06030191") + b"\x80" + SLICE + b"\x9a"
    wrong = AUD + SPS + PPS + SEI + bytes.fromhex("060100") + SLICE + b"\x9a"
    units = [(DELTA, True), (wave_of_100, False), (DELTA, False), (WAVE_OF_4, False), *[(DELTA, False)] * 4]
    assert damaged(units) == "DDDDDD--"
    assert damaged([(DELTA, True), (wrong, False), (DELTA, False), (KEY, False)]) == "DDD-"


def test_units_are_not_parsed_while_the_picture_is_intact() -> None:
    def fail() -> bytes:
        raise AssertionError

    assert not Damage("h264").add(False, fail)


def test_the_first_bytes_of_a_unit_suffice() -> None:
    noise = bytes(range(1, 256)) * 100
    damage = Damage("h264")
    assert damage.add(True, lambda: b"")
    assert not damage.add(False, lambda: (KEY + noise)[:HEAD_BYTES])


def test_units_missed_before_the_first_one_cause_damage() -> None:
    damage = Damage("h264", is_damaged=True)
    assert [damage.add(False, lambda: DELTA), damage.add(False, lambda: KEY), damage.add(False, lambda: DELTA)] == [
        True,
        False,
        False,
    ]
    assert not Damage("vp8", is_damaged=True).is_damaged


def test_a_key_picture_that_is_whole_heals_what_was_lost_before_it() -> None:
    damage = Damage("h264")
    assert damage.add(True, lambda: DELTA, whole=True)
    assert not damage.add(True, lambda: KEY, whole=True)
    assert not damage.is_damaged
    assert damage.add(True, lambda: KEY, whole=False)
