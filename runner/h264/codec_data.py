"""Parameter sets beside an H.264 stream instead of in it: ISO/IEC 14496-15, 5.3.3.1. Pure."""

from __future__ import annotations

from runner.h264.sps import SPS

IDR, AUD = 5, 9  # NAL unit types
_SETS_AT = 5  # byte with the number of sequence parameter sets


def stated_sets(record: bytes) -> bytes:
    """The parameter sets of an AVCDecoderConfigurationRecord, each with its length in 4 bytes in front."""
    sets, at = b"", _SETS_AT
    for mask in (0x1F, 0xFF):  # of the number of sequence parameter sets, and of picture parameter sets
        count, at = record[at] & mask, at + 1
        for _ in range(count):
            end = at + 2 + int.from_bytes(record[at : at + 2], "big")
            sets += b"\0\0" + record[at:end]
            at = end
    return sets


def with_sets(picture: bytes, sets: bytes) -> bytes | None:
    """An encoded picture with parameter sets; None: it has its own, or is an IDR picture, which gets them elsewhere.

    picture  its NAL units have their length in front of them, in 4 bytes
    """
    kinds, at, delimited = [], 0, 0
    while at < len(picture) - 4:
        kinds.append(picture[at + 4] & 0x1F)
        at += 4 + int.from_bytes(picture[at : at + 4], "big")
        if kinds == [AUD]:
            delimited = at
    return None if SPS in kinds or IDR in kinds else picture[:delimited] + sets + picture[delimited:]
