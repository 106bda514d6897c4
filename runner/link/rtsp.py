"""The part of RTSP that the relay parses (RFC 2326): ends of messages and the negotiated UDP ports. Pure."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator

LONGEST_HEADER = 65_536  # bytes; a longer one is not RTSP

_END = b"\r\n\r\n"
_LENGTH = re.compile(rb"^content-length:\s*(\d+)", re.IGNORECASE | re.MULTILINE)
_TRANSPORT = re.compile(rb"^transport:[^\r\n]*", re.IGNORECASE | re.MULTILINE)


class Splitter:
    """Splits one direction of a connection into messages and interleaved packets ('$', section 10.12)."""

    def __init__(self) -> None:
        self._data = b""

    def feed(self, data: bytes) -> Iterator[bytes]:
        """Complete units, in order; the rest is buffered for the next call.

        raises  ValueError if the bytes are not RTSP
        """
        self._data += data
        while (length := self._length()) and length <= len(self._data):
            unit, self._data = self._data[:length], self._data[length:]
            yield unit

    def _length(self) -> int:
        """Length of the first unit; 0: not known yet."""
        data = self._data
        if data[:1] == b"$":
            return 4 + int.from_bytes(data[2:4], "big") if len(data) >= 4 else 0
        end = data.find(_END)
        if end < 0:
            if len(data) > LONGEST_HEADER:
                raise ValueError(f"no end of an RTSP header within {LONGEST_HEADER} bytes")
            return 0
        body = _LENGTH.search(data[:end])
        return end + len(_END) + (int(body[1]) if body else 0)


def ports(message: bytes, name: str) -> list[int]:
    """First ports (RTP; RTCP is the next one) under a name in the Transport header: client_port, server_port."""
    if message[:1] == b"$":
        return []
    header = _TRANSPORT.search(_head(message))
    return [int(match[1]) for match in _pattern(name).finditer(header[0])] if header else []


def with_ports(message: bytes, name: str, replace: Callable[[int], int]) -> bytes:
    """The message with the pairs of ports under that name replaced; nothing else changes."""

    def pair(match: re.Match[bytes]) -> bytes:
        port = replace(int(match[1]))
        return f"{name}={port}-{port + 1}".encode()

    head = _head(message)
    header = _TRANSPORT.sub(lambda found: _pattern(name).sub(pair, found[0]), head)
    return header + message[len(head) :]


def _head(message: bytes) -> bytes:
    return message.partition(_END)[0]


def _pattern(name: str) -> re.Pattern[bytes]:
    return re.compile(rf"(?<![\w]){name}=(\d+)(?:-\d+)?".encode())
