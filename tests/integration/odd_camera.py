"""An RTSP server with the habits of IP cameras that people own, each harmless to players that expect it."""

from __future__ import annotations

import re
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Any

FPS = 15
NTP_EPOCH = 2_208_988_800  # seconds from 1900 to 1970
ENCODER = "x264enc tune=zerolatency speed-preset=ultrafast bitrate=500 key-int-max=15"
VIDEO = (
    "m=video 0 RTP/AVP 96",
    "a=rtpmap:96 H264/90000",
    "a=fmtp:96 packetization-mode=1",
    "a=control:trackID=1",
)


@dataclass(frozen=True)
class Habits:
    """What a camera does otherwise than most.

    description   lines of the session description; {address} is the camera's own
    content_base  header of the answer to DESCRIBE; {address} likewise, "" sends none
    setup         URL at which the video is set up; others are answered 404
    refused       status of a SETUP by transport, "TCP", "UDP" or "multicast", that is not supported
    headers       additional headers of each answer, by method; a value None: the method is never answered
    session       value of the header Session
    encoder       GStreamer's description of the encoder
    early         whether it encodes before it is asked to play, so that a viewer joins between two key pictures
    shift         seconds by which the RTP time of a picture is wrong, from the picture's number and the connection's
    ntp_shift     seconds by which its wall clock is wrong, from the seconds since the start; None: no sender reports
    marks         whether the last packet of a picture has the marker bit
    marks_each    whether the last packet of each NAL unit has it
    aggregates    how the payloader puts several NAL units into a packet
    """

    description: tuple[str, ...] = ("v=0", "o=- 1 1 IN IP4 127.0.0.1", "s=camera", "t=0 0", "a=control:*", *VIDEO)
    content_base: str = "{address}/"
    setup: str = "{address}/trackID=1"
    refused: dict[str, str] = field(default_factory=dict)
    headers: dict[str, str | None] = field(default_factory=dict)
    session: str = "1234"
    encoder: str = ENCODER
    early: bool = False
    shift: Callable[[int, int], float] = lambda _picture, _connection: 0.0
    ntp_shift: Callable[[float], float] | None = lambda _seconds: 0.0
    marks: bool = True
    marks_each: bool = False
    aggregates: str = "none"


class OddCamera:
    """Serves one stream at `address` until it is closed.

    setups       requested (URL, transport)
    connections  accepted so far
    """

    def __init__(self, habits: Habits, host: str = "127.0.0.1") -> None:
        self.habits = habits
        self.setups: list[tuple[str, str]] = []
        self.methods: list[str] = []
        self.connections = 0
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"rtsp://{host}:{self._listener.getsockname()[1]}/stream"
        self._clients: list[socket.socket] = []
        self._closed = threading.Event()
        threading.Thread(target=self._accept, daemon=True).start()

    def close(self) -> None:
        self._closed.set()
        self._listener.close()
        self.drop()

    def drop(self) -> None:
        """End every connection, as a camera does that restarts."""
        for client in self._clients:
            with suppress(OSError):
                client.shutdown(socket.SHUT_RDWR)

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                client, _ = self._listener.accept()
                self.connections += 1
                self._clients.append(client)
                threading.Thread(target=_Connection(self, client, self.connections).serve, daemon=True).start()


class _Connection:
    def __init__(self, camera: OddCamera, client: socket.socket, number: int) -> None:
        self._camera, self._client, self._number = camera, client, number
        self._habits = camera.habits
        self._lock = threading.Lock()  # answers and interleaved packets share the socket
        self._send: Callable[[bytes], None] | None = None
        self._send_rtcp: Callable[[bytes], None] | None = None
        self._ended, self._playing = threading.Event(), threading.Event()

    def serve(self) -> None:
        if self._habits.early:
            threading.Thread(target=self._stream, daemon=True).start()
        received = b""
        with suppress(OSError):
            while data := self._client.recv(65536):
                received += data
                while request := _take(received):
                    length, text = request
                    received = received[length:]
                    if text:
                        self._answer(text)
        self._ended.set()
        self._client.close()

    def _answer(self, request: str) -> None:
        method, url = request.split()[:2]
        self._camera.methods.append(method)
        extra = self._habits.headers.get(method, "")
        if extra is None:
            return
        if method == "OPTIONS":
            self._reply(request, "200 OK", extra or "Public: OPTIONS, DESCRIBE, SETUP, PLAY, TEARDOWN, GET_PARAMETER")
        elif method == "DESCRIBE":
            self._describe(request, extra)
        elif method == "SETUP":
            self._set_up(request, url)
        elif method == "PLAY":
            self._reply(request, "200 OK", extra)
            self._playing.set()
            if not self._habits.early:
                threading.Thread(target=self._stream, daemon=True).start()
        else:
            self._reply(request, "200 OK", extra)

    def _describe(self, request: str, extra: str) -> None:
        address = self._camera.address
        body = "".join(f"{line}\r\n" for line in self._habits.description).replace("{address}", address)
        base = self._habits.content_base.replace("{address}", address)
        kind = extra or "Content-Type: application/sdp"
        self._reply(request, "200 OK", "\r\n".join(filter(None, (base and f"Content-Base: {base}", kind))), body)

    def _set_up(self, request: str, url: str) -> None:
        transport = re.search(r"Transport: (.*)\r", request)[1]  # type: ignore[index]
        self._camera.setups.append((url, transport))
        kind = "TCP" if "interleaved" in transport else "multicast" if "multicast" in transport else "UDP"
        if kind in self._habits.refused:
            self._reply(request, self._habits.refused[kind])
        elif url != self._habits.setup.replace("{address}", self._camera.address):
            self._reply(request, "404 Not Found")
        elif kind == "TCP":
            channel = int(re.search(r"interleaved=(\d+)", transport)[1])  # type: ignore[index]
            self._send, self._send_rtcp = self._interleaved(channel), self._interleaved(channel + 1)
            self._reply(request, "200 OK", f"Transport: RTP/AVP/TCP;unicast;interleaved={channel}-{channel + 1}")
        else:
            self._reply(request, "200 OK", f"Transport: RTP/AVP;unicast;{self._udp(transport)}")

    def _interleaved(self, channel: int) -> Callable[[bytes], None]:
        def send(packet: bytes) -> None:
            with self._lock:
                self._client.sendall(b"$" + bytes([channel]) + struct.pack(">H", len(packet)) + packet)

        return send

    def _udp(self, transport: str) -> str:
        rtp, rtcp = map(int, re.search(r"client_port=(\d+)-(\d+)", transport).groups())  # type: ignore[union-attr]
        sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2)]
        for each in sockets:
            each.bind(("127.0.0.1", 0))
        self._send = lambda packet: sockets[0].sendto(packet, ("127.0.0.1", rtp)) and None
        self._send_rtcp = lambda packet: sockets[1].sendto(packet, ("127.0.0.1", rtcp)) and None
        ports = "-".join(str(each.getsockname()[1]) for each in sockets)
        return f"client_port={rtp}-{rtcp};server_port={ports}"

    def _reply(self, request: str, status: str, extra: str = "", body: str = "") -> None:
        number = re.search(r"CSeq: (\d+)", request)[1]  # type: ignore[index]
        lines = [f"RTSP/1.0 {status}", f"Cseq: {number}", f"Session: {self._habits.session}"]
        lines += [line for line in (extra, body and f"Content-Length: {len(body)}") if line]
        with self._lock:
            self._client.sendall(("\r\n".join(lines) + "\r\n\r\n" + body).encode())

    # --- the stream ---------------------------------------------------------------------------------------------------

    def _stream(self) -> None:
        for picture, packets in enumerate(_pictures(self._habits, self._ended)):
            if not self._playing.is_set():
                continue
            with suppress(OSError):
                for packet in packets:
                    self._send_packet(packet, picture, packets)
                if picture % FPS == 0 and self._habits.ntp_shift:
                    self._report(packets[0], picture)

    def _send_packet(self, packet: bytes, picture: int, packets: list[bytes]) -> None:
        shifted = _time(packet) + round(90000 * self._habits.shift(picture, self._number))
        is_last = packet is packets[-1] or (self._habits.marks_each and _ends_unit(packet))
        second = packet[1] & 0x7F | (0x80 if self._habits.marks and is_last else 0)
        assert self._send
        self._send(packet[:1] + bytes([second]) + packet[2:4] + struct.pack(">I", shifted % 2**32) + packet[8:])

    def _report(self, packet: bytes, picture: int) -> None:
        """A sender report (RFC 3550, section 6.4.1) without reception reports."""
        assert self._send_rtcp and self._habits.ntp_shift
        seconds = time.time() + NTP_EPOCH + self._habits.ntp_shift(picture / FPS)
        ntp = round(seconds * 2**32)
        shifted = _time(packet) + round(90000 * self._habits.shift(picture, self._number))
        head = b"\x80\xc8\x00\x06" + packet[8:12]
        self._send_rtcp(head + struct.pack(">QIII", ntp % 2**64, shifted % 2**32, picture, picture * 1000))


def _take(received: bytes) -> tuple[int, str] | None:
    """The next complete request, "" for an interleaved packet, and its length in bytes."""
    if received[:1] == b"$":
        length = 4 + int.from_bytes(received[2:4], "big")
        return (length, "") if len(received) >= max(4, length) else None
    end = received.find(b"\r\n\r\n")
    return (end + 4, received[: end + 4].decode()) if end >= 0 else None


def _time(packet: bytes) -> int:
    return int.from_bytes(packet[4:8], "big")


def _ends_unit(packet: bytes) -> bool:
    """Whether a NAL unit ends with it (RFC 6184, section 5.8)."""
    fragment, end = 28, 0x40
    return packet[12] & 0x1F != fragment or bool(packet[13] & end)


def _pictures(habits: Habits, ended: threading.Event) -> Iterator[list[bytes]]:
    """The RTP packets of each picture."""
    from runner.gst import Gst

    size = f"video/x-raw,format=I420,width=320,height=240,framerate={FPS}/1"
    payloader = f"rtph264pay config-interval=-1 pt=96 mtu=1200 aggregate-mode={habits.aggregates}"
    packets_of = f"{size} ! {habits.encoder} ! {payloader}"
    line = f"videotestsrc is-live=true pattern=ball ! {packets_of} ! appsink name=sink sync=false"
    pipeline: Any = Gst.parse_launch(line)
    sink = pipeline.get_by_name("sink")
    pipeline.set_state(Gst.State.PLAYING)
    packets: list[bytes] = []
    try:
        while not ended.is_set():
            if not (sample := sink.emit("try-pull-sample", Gst.SECOND)):
                continue
            packets.append(sample.get_buffer().extract_dup(0, sample.get_buffer().get_size()))
            if packets[-1][1] & 0x80:
                yield packets
                packets = []
    finally:
        pipeline.set_state(Gst.State.NULL)


@contextmanager
def odd_camera(habits: Habits, host: str = "127.0.0.1") -> Iterator[OddCamera]:
    camera = OddCamera(habits, host)
    try:
        yield camera
    finally:
        camera.close()
