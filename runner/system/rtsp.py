"""Asks an IP camera for its description without a login, and without GStreamer, which does not show the answer."""

from __future__ import annotations

import re
import socket
import ssl
import time
from dataclasses import dataclass
from urllib.parse import urlsplit

PORTS = {"rtsp": 554, "rtsps": 322}
OK, UNAUTHORIZED = 200, 401
LONGEST = 100_000  # bytes of an answer
CONNECT_S = 3.0
# GStreamer's RTSP client (1.22 to 1.28) computes every digest with MD5, whatever algorithm the camera names.
KNOWN_LOGINS = frozenset({"Basic", "Digest MD5"})
_CHALLENGE = re.compile(r"(?i)(?:^|,)\s*(basic|digest)\s+(.*?)(?=,\s*(?:basic|digest)\s|$)")
_QUOTED = re.compile(r'"[^"]*"')
_ALGORITHM = re.compile(r'(?i)\balgorithm\s*=\s*"?([\w-]+)')


@dataclass(frozen=True, slots=True)
class Description:
    """The answer to DESCRIBE.

    status  of RTSP, such as 200, or 401 if a login is needed
    logins  that the camera accepts: Basic, or Digest with its algorithm
    video   number of video media, if it describes any
    """

    status: int
    logins: tuple[str, ...] = ()
    video: int = 0

    @property
    def unknown_login(self) -> str | None:
        """Why GStreamer cannot log in; None if it can, or need not."""
        if not self.logins or KNOWN_LOGINS.intersection(self.logins):
            return None
        demanded = " or ".join(login.removeprefix("Digest ") for login in self.logins)
        return f"the camera demands {demanded}; this GStreamer knows MD5"


def describe(address: str, limit_s: float) -> Description:
    """Ask for the description of an address, rtsp:// or rtsps://.

    limit_s  for the whole answer
    raises   OSError, ValueError if this is no RTSP address, or no answer of RTSP
    """
    url = urlsplit(address)
    if url.scheme not in PORTS or not url.hostname:
        raise ValueError(f"must begin with one of {', '.join(f'{scheme}://' for scheme in PORTS)}")
    deadline = time.monotonic() + limit_s
    plain = socket.create_connection((url.hostname, url.port or PORTS[url.scheme]), min(CONNECT_S, limit_s))
    with _wrapped(plain, url.scheme) as connection:
        request = f"DESCRIBE {address} RTSP/1.0\r\nCSeq: 1\r\nAccept: application/sdp\r\n\r\n"
        connection.sendall(request.encode())
        return _parsed(_answer(connection, deadline))


def _wrapped(connection: socket.socket, scheme: str) -> socket.socket:
    if scheme != "rtsps":
        return connection
    context = ssl.create_default_context()
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE  # nothing secret is sent
    return context.wrap_socket(connection)


def _answer(connection: socket.socket, deadline: float) -> str:
    received = b""
    while not _is_complete(received) and len(received) < LONGEST:
        left = deadline - time.monotonic()
        if left <= 0:
            raise TimeoutError("no answer to DESCRIBE")
        connection.settimeout(left)
        part = connection.recv(65_536)
        if not part:
            break
        received += part
    return received.decode(errors="replace")


def _is_complete(received: bytes) -> bool:
    head, end, body = received.partition(b"\r\n\r\n")
    length = re.search(rb"(?im)^content-length:\s*(\d+)", head)
    return bool(end) and len(body) >= (int(length[1]) if length else 0)


def _parsed(answer: str) -> Description:
    """raises  ValueError"""
    head, _, body = answer.partition("\r\n\r\n")
    status = re.match(r"RTSP/\d\.\d (\d{3})", head)
    if not status:
        raise ValueError("no answer of RTSP")
    offered = re.findall(r"(?im)^www-authenticate:\s*(.*?)\s*$", head)
    logins = [login for header in offered for login in _logins(header)]
    return Description(int(status[1]), tuple(dict.fromkeys(logins)), len(re.findall(r"(?m)^m=video ", body)))


def _logins(header: str) -> list[str]:
    """The logins of one header, which may name several."""
    found = []
    without_commas = _QUOTED.sub(lambda text: text[0].replace(",", " "), header)
    for scheme, parameters in _CHALLENGE.findall(without_commas):
        algorithm = _ALGORITHM.search(parameters)
        found.append("Basic" if scheme.lower() == "basic" else f"Digest {algorithm[1].upper() if algorithm else 'MD5'}")
    return found
