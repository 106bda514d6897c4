"""Keys of SRTP as RTSP carries them: MIKEY messages (RFC 3830, RFC 4567), in the form that every version reads.

A key and its salt may be one piece, or the salt may follow in a field of its own. GStreamer 1.28 writes two. What reads
MIKEY in 1.22, and in the server of 1.28, ignores the second: everything then fails to decrypt. All read one piece.
"""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping

HEADER_BYTES, SESSION_BYTES = 10, 9  # of each crypto session of SRTP, behind the header
TIMESTAMP_BYTES = {0: 8, 1: 8, 2: 4}  # by type
KEMAC = 1  # the payload with the keys (section 6.2)
WITH_SALT = 1  # added to the type of a key (section 6.13)
TYPE_SHIFT = 4  # of a key, above the kind of its validity

# By the number of a payload that may precede the keys, its size (sections 6.6, 6.10 and 6.11).
_SIZES: Mapping[int, Callable[[bytes], int]] = {
    5: lambda timestamp: 2 + TIMESTAMP_BYTES[timestamp[1]],
    10: lambda policy: 5 + _number(policy, 3),
    11: lambda random: 2 + random[1],
}


def in_one_piece(encoded: str) -> str:
    """A message in base64 with the salt at the end of its first key; as given if it already is, or is not understood.

    Only keys that are not encrypted are understood: TLS protects the message.
    """
    message = base64.b64decode(encoded)
    try:
        return base64.b64encode(_in_one_piece(message)).decode()
    except (IndexError, KeyError):
        return encoded


def _in_one_piece(message: bytes) -> bytes:
    keys = _keys(message)
    kind = message[keys + 1]
    if not kind >> TYPE_SHIFT & WITH_SALT:
        return message
    key, salt_field = _field(message, keys + 2)
    salt, end = _field(message, salt_field)
    joined = bytes([message[keys], kind & ~(WITH_SALT << TYPE_SHIFT)]) + _counted(key + salt)
    length = _number(message, keys - 2) + len(joined) - (end - keys)
    return message[: keys - 2] + length.to_bytes(2, "big") + joined + message[end:]


def _keys(message: bytes) -> int:
    """Where the first key begins."""
    kind, at = message[2], HEADER_BYTES + SESSION_BYTES * message[8]
    while kind != KEMAC:
        kind, at = message[at], at + _SIZES[kind](message[at:])
    if message[at + 1]:
        raise KeyError("the keys are encrypted")
    return at + 4


def _field(message: bytes, at: int) -> tuple[bytes, int]:
    """What is behind its length, and where it ends."""
    end = at + 2 + _number(message, at)
    if end > len(message):
        raise IndexError(end)
    return message[at + 2 : end], end


def _counted(field: bytes) -> bytes:
    return len(field).to_bytes(2, "big") + field


def _number(message: bytes, at: int) -> int:
    return message[at] << 8 | message[at + 1]
