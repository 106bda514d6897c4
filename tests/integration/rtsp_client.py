"""An RTSP client on bare sockets, for what players never do: wrong URLs, silence, a reader that stops or is slow."""

from __future__ import annotations

import re
import socket
import threading
import time
from itertools import pairwise
from typing import Any


class RtspClient:
    """One connection; packets are kept as (time, sequence number, marker).

    at      address to connect to instead of the URL's
    source  address to connect from
    agent   its User-Agent
    small   buffers and segments as on a slow network: those of loopback would hold many seconds of video
    """

    def __init__(
        self, url: str, *, at: tuple[str, int] | None = None, source: str = "", agent: str = "", small: bool = False
    ) -> None:
        host, port = re.match(r"rtsp://([^:/]+):(\d+)", url).groups()  # type: ignore[union-attr]
        self.url, self._agent = url, agent
        self.tcp = socket.socket()
        self.tcp.settimeout(10)
        self.tcp.bind((source, 0))
        if small:
            self.tcp.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            self.tcp.setsockopt(socket.IPPROTO_TCP, socket.TCP_MAXSEG, 1400)
        self.tcp.connect(at or (host, int(port)))
        self.session, self.head, self.body = "", "", ""
        self._sequence, self._buffer = 0, b""
        self.packets: list[tuple[float, int, bool]] = []
        self._rtp: list[socket.socket] = []
        self._thread: threading.Thread | None = None
        self.delay_s = 0.0  # between two reads

    def ask(self, method: str, url: str = "", **headers: object) -> int:
        self._sequence += 1
        headers |= {"Session": self.session} if self.session else {}
        headers |= {"User-Agent": self._agent} if self._agent else {}
        lines = [f"{method} {url or self.url} RTSP/1.0", f"CSeq: {self._sequence}"]
        lines += [f"{name.replace('_', '-')}: {value}" for name, value in headers.items()]
        self.tcp.sendall("\r\n".join([*lines, "", ""]).encode())
        return self._answer()

    def open(self, *, udp: bool = False, **play: object) -> list[int]:
        """Status codes of DESCRIBE, SETUP and PLAY, up to the first failure."""
        codes = [self.ask("DESCRIBE", Accept="application/sdp")]
        base = re.search(r"Content-Base: (\S+?)/*\r", self.head)
        if codes == [200]:
            codes.append(self.ask("SETUP", f"{base[1]}/stream=0", Transport=self._transport(udp)))  # type: ignore[index]
        if codes == [200, 200]:
            codes.append(self.ask("PLAY", **play))
        return codes

    def read(self) -> RtspClient:
        """Read packets from now on, in a thread."""
        self._thread = threading.Thread(target=self._read_udp if self._rtp else self._read_tcp, daemon=True)
        self._thread.start()
        return self

    @property
    def server_port(self) -> int:
        return int(re.search(r"server_port=(\d+)", self._setup)[1])  # type: ignore[index]

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
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            self.tcp.settimeout(left)
            try:
                if not self.tcp.recv(65536):
                    return True
            except TimeoutError:
                return False
            except OSError:
                return True
        return False

    def close(self) -> None:
        for sock in (self.tcp, *self._rtp):
            sock.close()

    def __enter__(self) -> RtspClient:
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()

    def _transport(self, udp: bool) -> str:
        if not udp:
            return "RTP/AVP/TCP;unicast;interleaved=0-1"
        for _ in range(2):
            self._rtp.append(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            self._rtp[-1].bind((self.tcp.getsockname()[0], 0))
        ports = [sock.getsockname()[1] for sock in self._rtp]
        return f"RTP/AVP;unicast;client_port={ports[0]}-{ports[1]}"

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
            data = self.tcp.recv(65536)
            if not data:
                raise EOFError("the server closed the connection")
            self._buffer += data
        return self._buffer

    def _packet(self) -> None:
        """Take one interleaved packet (RFC 2326, 10.12)."""
        size = 4 + int.from_bytes(self._fill(4)[2:4], "big")
        data, self._buffer = self._fill(size)[4:size], self._buffer[size:]
        if self._fill(0) is not None and data[1] & 0x7F == 96:
            self._keep(data)

    def _keep(self, data: bytes) -> None:
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
        try:
            while True:
                self._keep(self._rtp[0].recv(2048))
        except OSError:
            return
