"""Parameter sets that an encoder states beside its stream, and the pictures that repeat them."""

from __future__ import annotations

import pytest

from runner.h264.codec_data import stated_sets, with_sets

SPS, PPS, SECOND = b"\x67\x42\xc0\x1e\xd9", b"\x68\xce\x3c\x80", b"\x68\xee"
AUD, RECOVERY, SLICE, IDR = b"\x09\xf0", b"\x06\x06\x01\xc4\x80", b"\x41\x9a\x24\x6c", b"\x65\x88\x84\x21"


def avc(*units: bytes) -> bytes:
    return b"".join(len(unit).to_bytes(4, "big") + unit for unit in units)


def record(sps: list[bytes], pps: list[bytes], more: bytes = b"") -> bytes:
    """more: of the high profiles, whose records go on."""

    def listed(units: list[bytes]) -> bytes:
        return b"".join(len(unit).to_bytes(2, "big") + unit for unit in units)

    return b"\x01\x42\xc0\x1e\xff" + bytes([0xE0 | len(sps)]) + listed(sps) + bytes([len(pps)]) + listed(pps) + more


@pytest.mark.parametrize("more", [b"", b"\xfd\xf8\xf8\x00"])
def test_a_record_s_sets_are_read_in_order(more: bytes) -> None:
    assert stated_sets(record([SPS], [PPS, SECOND], more)) == avc(SPS, PPS, SECOND)


@pytest.mark.parametrize(
    ("picture", "then"),
    [
        (avc(RECOVERY, SLICE), avc(SPS, PPS, RECOVERY, SLICE)),
        (avc(AUD, RECOVERY, SLICE), avc(AUD, SPS, PPS, RECOVERY, SLICE)),  # a delimiter stays first
        (avc(SPS, PPS, RECOVERY, SLICE), None),
        (avc(RECOVERY, IDR), None),
    ],
)
def test_a_picture_gets_sets_unless_it_has_them_or_its_sender_adds_them(picture: bytes, then: bytes | None) -> None:
    assert with_sets(picture, avc(SPS, PPS)) == then
