"""Which part of the full image an encoded picture shows, in the stream itself: an SEI message of H.264. Pure.

The message is user data registered by ITU-T T.35 (D.1.6): the country and provider below, then x, y, width and height,
px of the full image, each in LEB128. Unregistered user data would begin with an identifier of 16 bytes, 3 kbit/s
more of each camera at 30 Hz. Nobody has registered this provider for the project, so a reader checks the rest of the
message as well. A picture of the full image has no message.
"""

from __future__ import annotations

from runner.core.model import Roi

USER_DATA = 4  # payload type
MARK = bytes([0x04, 0x54, 0x4F])  # Germany; "TO"
MOST_BYTES = 2 + len(MARK) + 4 * 3  # of a message, with its type and its length
_SEI_HEADER, _END = b"\x06", b"\x80"


def region_unit(region: Roi) -> bytes:
    """The NAL unit that states a region, without start code.

    No byte needs to be escaped: only x and y can be bytes of 0, and what follows them is 16 or more.
    """
    payload = MARK + b"".join(_leb128(number) for number in (region.x, region.y, region.width, region.height))
    return _SEI_HEADER + bytes([USER_DATA, len(payload)]) + payload + _END


def region_of(message: bytes) -> Roi | None:
    """The region that the first message of an SEI unit states, from the byte after the unit's header; else None."""
    if message[:1] != bytes([USER_DATA]) or message[2 : 2 + len(MARK)] != MARK:
        return None
    numbers: list[int] = []
    payload = message[2 + len(MARK) : 2 + message[1]]
    while payload and len(numbers) < 5:
        number, length = _read_leb128(payload)
        numbers.append(number)
        payload = payload[length:]
    return Roi(*numbers) if len(numbers) == 4 and numbers[2] and numbers[3] else None


def with_region(data: bytes, region: Roi, *, prefixed: bool = False) -> bytes:
    """An encoded picture with its region stated in front of its first slice.

    prefixed  its NAL units have their length in front of them, in 4 bytes (avc), instead of a start code (Annex B)
    """
    unit = region_unit(region)
    begin = _first_slice(data, prefixed)
    return data if begin is None else data[:begin] + (_length(unit) if prefixed else b"\0\0\1") + unit + data[begin:]


def _first_slice(data: bytes, prefixed: bool) -> int | None:
    """Where the first slice begins, with its start code or length; None: there is none."""
    at = 0 if prefixed else data.find(b"\0\0\1")
    while 0 <= at < len(data) - 4:
        header = data[at + 4] if prefixed else data[at + 3]
        if 1 <= header & 0x1F <= 5:
            return at - 1 if not prefixed and at and not data[at - 1] else at
        at = at + 4 + int.from_bytes(data[at : at + 4], "big") if prefixed else data.find(b"\0\0\1", at + 3)
    return None


def _length(unit: bytes) -> bytes:
    return len(unit).to_bytes(4, "big")


def _leb128(number: int) -> bytes:
    encoded = b""
    while number > 0x7F:
        encoded, number = encoded + bytes([number & 0x7F | 0x80]), number >> 7
    return encoded + bytes([number])


def _read_leb128(data: bytes) -> tuple[int, int]:
    """A number and its length in bytes."""
    number = 0
    for at, byte in enumerate(data[:3]):
        number |= (byte & 0x7F) << 7 * at
        if not byte & 0x80:
            return number, at + 1
    return 0, len(data)
