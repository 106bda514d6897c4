"""An RTSP client on plain sockets, for behaviour that players lack: wrong URLs, silence, a slow or stopped reader."""

from __future__ import annotations

import re
import select
import socket
import ssl
import struct
import threading
import time
from collections import Counter
from contextlib import suppress
from hashlib import md5
from itertools import pairwise
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from runner.security.keyring import Keyring, rtsp_password


class Digest:
    """The password of a viewer for a vehicle, as RFC 2617 has it given: without `qop`, like GStreamer's server."""

    def __init__(self, keys: Path, vehicle: str) -> None:
        ring = Keyring(keys)
        self._user, self._password = ring.holder.name, rtsp_password(ring.secret, vehicle)
        self._realm = self._nonce = ""

    def challenge(self, head: str) -> None:
        """Read the challenge of an answer with status 401."""
        self._realm, self._nonce = (re.search(rf'{key}="([^"]*)"', head)[1] for key in ("realm", "nonce"))  # type: ignore[index]

    def header(self, method: str, url: str) -> dict[str, object]:
        """The header of a request; none before the challenge."""
        if not self._nonce:
            return {}
        own = _md5(f"{self._user}:{self._realm}:{self._password}")
        response = _md5(f"{own}:{self._nonce}:{_md5(f'{method}:{url}')}")
        fields = {"username": self._user, "realm": self._realm, "nonce": self._nonce, "uri": url, "response": response}
        return {"Authorization": "Digest " + ", ".join(f'{name}="{value}"' for name, value in fields.items())}


def _md5(text: str) -> str:
    return md5(text.encode(), usedforsecurity=False).hexdigest()


def tls(keys: Path) -> ssl.SSLContext:
    """TLS of a holder of keys, to whatever address; the other side must have a certificate of the same authority."""
    ring = Keyring(keys)
    context = ssl.create_default_context(cafile=ring.authority)
    context.check_hostname = False
    context.load_cert_chain(ring.certificate, ring.key)
    return context


def client_hello(keys: Path) -> bytes:
    """The first message of a TLS client (RFC 8446, section 4.1.2)."""
    incoming, outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
    with suppress(ssl.SSLWantReadError):
        tls(keys).wrap_bio(incoming, outgoing).do_handshake()
    return outgoing.read()


class RtspClient:
    """One connection; packets are kept as (time, sequence number, marker), and their number by source (SSRC).

    at      address to connect to instead of the URL's
    source  address to connect from
    agent   its User-Agent
    small   buffers and segments as on a slow network: those of loopback would hold many seconds of video
    keys    directory of a viewer's keys: it speaks TLS and gives a password; what it receives stays encrypted
    """

    def __init__(
        self,
        url: str,
        *,
        at: tuple[str, int] | None = None,
        source: str = "",
        agent: str = "",
        small: bool = False,
        keys: Path | None = None,
        vehicle: str = "delivery_robot",
    ) -> None:
        host, port = urlsplit(url).hostname, urlsplit(url).port
        assert host and port
        self.url, self._agent = url, agent
        self._login = Digest(keys, vehicle) if keys else None
        self._family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self.tcp = socket.socket(self._family)
        self.tcp.settimeout(10)
        self.tcp.bind((source, 0))
        if small:
            self.tcp.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            self.tcp.setsockopt(socket.IPPROTO_TCP, socket.TCP_MAXSEG, 1400)
        self.tcp.connect(at or (host, port))
        self._tls = tls(keys).wrap_socket(self.tcp) if keys else None
        self.tcp = self._tls or self.tcp
        self._lock = threading.Lock()  # OpenSSL's connections serve one thread at a time
        self.session, self.head, self.body = "", "", ""
        self._sequence, self._buffer = 0, b""
        self.packets: list[tuple[float, int, bool]] = []
        self.sources: Counter[int] = Counter()
        self._rtp: list[socket.socket] = []
        self._thread: threading.Thread | None = None
        self.delay_s = 0.0  # between two reads

    def ask(self, method: str, url: str = "", **headers: object) -> int:
        """Send a request, with the password once it is required; returns the status code."""
        code = self._exchange(method, url, headers)
        if code == 401 and self._login:
            self._login.challenge(self.head)
            code = self._exchange(method, url, headers)
        return code

    def _exchange(self, method: str, url: str, headers: dict[str, object]) -> int:
        self._send(method, url, headers)
        return self._answer()

    def leave(self) -> None:
        """Send TEARDOWN without waiting for the answer, which may arrive after media data."""
        self._send("TEARDOWN", "", {})

    def _send(self, method: str, url: str, headers: dict[str, object]) -> None:
        self._sequence += 1
        headers = {**headers, **(self._login.header(method, url or self.url) if self._login else {})}
        headers |= {"Session": self.session} if self.session else {}
        headers |= {"User-Agent": self._agent} if self._agent else {}
        lines = [f"{method} {url or self.url} RTSP/1.0", f"CSeq: {self._sequence}"]
        lines += [f"{name.replace('_', '-')}: {value}" for name, value in headers.items()]
        with self._lock:
            self.tcp.sendall("\r\n".join([*lines, "", ""]).encode())

    def open(self, *, udp: bool = False, feedback: bool = False, **play: object) -> list[int]:
        """Status codes of DESCRIBE, SETUP and PLAY, up to the first failure; with a profile for feedback (RFC 4585)."""
        codes = [self.ask("DESCRIBE", Accept="application/sdp")]
        base = re.search(r"Content-Base: (\S+?)/*\r", self.head)
        if codes == [200]:
            profile = ("RTP/SAVP" if self._login else "RTP/AVP") + ("F" if feedback else "")
            codes.append(self.ask("SETUP", f"{base[1]}/stream=0", Transport=self.transport(profile, udp=udp)))  # type: ignore[index]
        if codes == [200, 200]:
            codes.append(self.ask("PLAY", **play))
        return codes

    def read(self) -> RtspClient:
        """Read packets from now on, in a thread."""
        self._thread = threading.Thread(target=self._read_udp if self._rtp else self._read_tcp, daemon=True)
        self._thread.start()
        return self

    def wait(self, seconds: float) -> None:
        """Wait until the reading thread has ended, as with the connection."""
        assert self._thread
        self._thread.join(seconds)
        assert not self._thread.is_alive()

    def is_reading(self) -> bool:
        return bool(self._thread and self._thread.is_alive())

    @property
    def server_port(self) -> int:
        return int(re.search(r"server_port=(\d+)", self._setup)[1])  # type: ignore[index]

    def send_feedback(self, kind: int, form: int, ssrc: int, content: bytes = b"") -> None:
        """Send an RTCP feedback message about a source (RFC 4585, section 6.1) behind an empty receiver report."""
        own = 1
        report = struct.pack(">BBHI", 0x80, 201, 1, own)
        message = struct.pack(">BBHII", 0x80 | form, kind, 2 + len(content) // 4, own, ssrc) + content
        self._rtp[1].sendto(report + message, (self.tcp.getpeername()[0], self.server_port + 1))

    @property
    def lost(self) -> int:
        """Packets that are missing between the first and the last."""
        numbers = [number for _, number, _ in self.packets]
        return sum((b - a - 1) % 65536 for a, b in pairwise(numbers))

    @property
    def frames(self) -> int:
        return sum(marker for _, _, marker in self.packets)

    def longest_gap(self) -> float:
        """Longest time between the ends of two frames, s."""
        ends = [at for at, _, marker in self.packets if marker]
        return max(b - a for a, b in pairwise(ends))

    def ended(self, seconds: float = 10) -> bool:
        """Whether the server closes the connection within a time; discards incoming data."""
        return is_closed(self.tcp, time.monotonic() + seconds)

    def close(self) -> None:
        """The reading thread ends first: it would read on from the descriptor, by then perhaps another client's."""
        sockets = (self.tcp, *self._rtp)
        for sock in sockets:
            with suppress(OSError):
                socket.socket.shutdown(sock, socket.SHUT_RDWR)  # TLS's own would let the thread read what is encrypted
        if self._thread:
            self.wait(10)
        for sock in sockets:
            sock.close()

    def __enter__(self) -> RtspClient:
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()

    def transport(self, profile: str, *, udp: bool, channel: int = 0) -> str:
        """The header of a SETUP, with the first of two channels over TCP, or with new sockets."""
        if not udp:
            return f"{profile}/TCP;unicast;interleaved={channel}-{channel + 1}"
        for _ in range(2):
            self._rtp.append(socket.socket(self._family, socket.SOCK_DGRAM))
            # A reader that a busy machine delays must not lose packets.
            self._rtp[-1].setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4_000_000)
            self._rtp[-1].bind((self.tcp.getsockname()[0], 0))
        ports = [sock.getsockname()[1] for sock in self._rtp[-2:]]
        return f"{profile};unicast;client_port={ports[0]}-{ports[1]}"

    def _answer(self) -> int:
        while True:
            if self._fill(4)[:1] == b"$":
                self._packet()
                continue
            while b"\r\n\r\n" not in self._buffer:
                self._fill(len(self._buffer) + 1)
            head, _, self._buffer = self._buffer.partition(b"\r\n\r\n")
            self.head = head.decode() + "\r\n"
            length = re.search(r"Content-Length: (\d+)", self.head)
            size = int(length[1]) if length else 0
            self._fill(size)
            self.body, self._buffer = self._buffer[:size].decode(), self._buffer[size:]
            if found := re.search(r"Session: ([^;\r]+)", self.head):
                self.session = found[1]
            if "Transport: " in self.head:
                self._setup = self.head
            return int(self.head.split()[1])

    def _fill(self, size: int) -> bytes:
        while len(self._buffer) < size:
            data = self._receive()
            if not data:
                raise EOFError("the server closed the connection")
            self._buffer += data
        return self._buffer

    def _receive(self) -> bytes:
        if not self._tls:
            return self.tcp.recv(65536)
        incoming = select.poll()
        incoming.register(self._tls, select.POLLIN)
        with self._lock:
            waiting = self._tls.pending()
        if not waiting and not incoming.poll(1000 * (self._tls.gettimeout() or 0)):
            raise TimeoutError
        with self._lock:
            return self._tls.recv(65536)

    def _packet(self) -> None:
        """Read one interleaved packet (RFC 2326, 10.12)."""
        size = 4 + int.from_bytes(self._fill(4)[2:4], "big")
        data, self._buffer = self._fill(size)[4:size], self._buffer[size:]
        if self._fill(0) is not None and data[1] & 0x7F == 96:
            self._keep(data)

    def _keep(self, data: bytes) -> None:
        source = int.from_bytes(data[8:12], "big")
        self.sources[source] += 1
        if source == next(iter(self.sources)):  # not those sent again, which have another source
            self.packets.append((time.monotonic(), int.from_bytes(data[2:4], "big"), bool(data[1] & 0x80)))

    def _read_tcp(self) -> None:
        try:
            while True:
                self._fill(4)
                if self._buffer[:1] == b"$":
                    self._packet()
                else:
                    self._answer()
                if self.delay_s:
                    time.sleep(self.delay_s)
        except (OSError, EOFError):
            return

    def _read_udp(self) -> None:
        while all(data := [sock.recv(2048) for sock in select.select(self._rtp[::2], [], [])[0]]):  # of each SETUP
            for each in data:
                self._keep(each)


def is_closed(sock: socket.socket, until: float) -> bool:
    """Whether the other side closes a connection by a time of the monotonic clock; discards incoming data."""
    while (left_s := until - time.monotonic()) > 0:
        sock.settimeout(left_s)
        try:
            if not sock.recv(65_536):
                return True
        except TimeoutError:
            return False
        except OSError:
            return True
    return False
