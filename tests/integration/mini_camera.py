"""A small IP camera over RTSP/TCP in this process, with the habits of real ones."""

from __future__ import annotations

import base64
import re
import socket
import struct
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from rig import free_port

VIDEO = "videotestsrc is-live=true pattern=ball ! video/x-raw,format=I420,width=320,height=240,framerate=15/1"
ENCODERS = {
    "H264": "x264enc tune=zerolatency speed-preset=ultrafast key-int-max=15 ! rtph264pay config-interval=-1",
    "H265": "x265enc tune=zerolatency speed-preset=ultrafast key-int-max=15 ! rtph265pay config-interval=-1",
    "JPEG": "jpegenc ! rtpjpegpay",
}
DESCRIBED = {
    "H264": ("video 0 RTP/AVP 96", "rtpmap:96 H264/90000", "fmtp:96 packetization-mode=1"),
    "H265": ("video 0 RTP/AVP 96", "rtpmap:96 H265/90000"),
    "JPEG": ("video 0 RTP/AVP 26",),
    "sound": ("audio 0 RTP/AVP 8", "rtpmap:8 PCMA/8000"),
    "back channel": ("audio 0 RTP/AVP 0", "rtpmap:0 PCMU/8000", "sendonly"),
    "metadata": ("application 0 RTP/AVP 107", "rtpmap:107 vnd.onvif.metadata/90000"),
}
CHALLENGES = {
    "basic": 'Basic realm="camera"',
    "md5": 'Digest realm="camera", nonce="abc"',
    "sha256": 'Digest realm="camera", nonce="abc", algorithm="SHA-256"',
}


class MiniCamera:
    """Serves until it is closed.

    media     what its description offers, in this order: keys of DESCRIBED; "H264 sendonly" as some state video
    delays_s  by method, how long it takes to answer
    late_s    how long its video begins after its sound
    login     how it asks for a login, a key of CHALLENGES; "": it does not
    password  of the only user whom "basic" admits; "": nobody is ever admitted

    asked     requests, each with its kind of login, "" for none
    set_up    media that were set up
    """

    def __init__(
        self,
        media: Sequence[str] = ("H264",),
        delays_s: Mapping[str, float] | None = None,
        late_s: float = 0.0,
        login: str = "",
        password: str = "",
    ) -> None:
        self._media, self._delays_s, self._late_s = media, delays_s or {}, late_s
        self._login, self._password = login, password
        self.asked: list[tuple[str, str]] = []
        self.set_up: list[str] = []
        self.connections = 0
        port = free_port()
        self.address = f"rtsp://127.0.0.1:{port}/stream"
        self._ended = threading.Event()
        self._socket = socket.create_server(("127.0.0.1", port))
        threading.Thread(target=self._accept, daemon=True).start()

    @property
    def logins(self) -> list[str]:
        return [login for _, login in self.asked if login]

    def close(self) -> None:
        self._ended.set()
        self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()

    def _accept(self) -> None:
        while not self._ended.is_set():
            try:
                connection, _ = self._socket.accept()
            except OSError:
                return
            self.connections += 1
            threading.Thread(target=_Session(self, connection).serve, daemon=True).start()

    def _description(self) -> str:
        lines = ["v=0", "o=- 1 1 IN IP4 127.0.0.1", "s=camera", "c=IN IP4 0.0.0.0", "t=0 0", "a=control:*"]
        for number, medium in enumerate(self._media):
            kind = medium.removesuffix(" sendonly")
            head, *attributes = DESCRIBED[kind]
            attributes += ["sendonly"] if medium != kind else []
            lines += [f"m={head}", *(f"a={each}" for each in (*attributes, f"control:t{number}"))]
        return "".join(f"{line}\r\n" for line in lines)


class _Session:
    """One connection."""

    def __init__(self, camera: MiniCamera, connection: socket.socket) -> None:
        self._camera, self._connection = camera, connection
        self._channels: dict[int, int] = {}  # by medium
        self._sending = threading.Lock()
        self._ended = threading.Event()

    def serve(self) -> None:
        received = b""
        try:
            while not self._camera._ended.is_set() and (part := self._connection.recv(65_536)):
                received = self._handle(received + part)
        except OSError:
            pass
        finally:
            self._ended.set()
            self._connection.close()

    def _handle(self, received: bytes) -> bytes:
        """Answer the complete requests; the rest."""
        while received:
            if received[:1] == b"$":  # RTCP
                if len(received) < 4 or len(received) < 4 + (size := struct.unpack(">H", received[2:4])[0]):
                    return received
                received = received[4 + size :]
                continue
            head, end, rest = received.partition(b"\r\n\r\n")
            if not end:
                return received
            self._answer(head.decode())
            received = rest
        return received

    def _answer(self, request: str) -> None:
        camera, (method, url) = self._camera, request.split()[:2]
        login = re.search(r"Authorization: (\w+) ?(\S*)", request)
        camera.asked.append((method, login[1] if login else ""))
        self._ended.wait(camera._delays_s.get(method, 0))
        if method == "DESCRIBE" and camera._login and not self._is_admitted(login):
            self._reply(request, "401 Unauthorized", f"WWW-Authenticate: {CHALLENGES[camera._login]}\r\n")
            return
        match method:
            case "OPTIONS":
                self._reply(request, more="Public: OPTIONS, DESCRIBE, SETUP, PLAY, TEARDOWN, GET_PARAMETER\r\n")
            case "DESCRIBE":
                self._reply(request, more="Content-Type: application/sdp\r\n", body=camera._description())
            case "SETUP":
                self._set_up(request, int(url.rpartition("t")[2]))
            case "PLAY":
                self._reply(request, more="Range: npt=now-\r\n")
                self._play()
            case _:
                self._reply(request)

    def _is_admitted(self, login: re.Match[str] | None) -> bool:
        right = base64.b64encode(f"viewer:{self._camera._password}".encode()).decode()
        return bool(login and self._camera._password and login[2] == right)

    def _reply(self, request: str, status: str = "200 OK", more: str = "", body: str = "") -> None:
        number = re.search(r"CSeq: (\d+)", request)
        assert number
        length = f"Content-Length: {len(body)}\r\n" if body else ""
        self._send(f"RTSP/1.0 {status}\r\nCSeq: {number[1]}\r\nSession: 1\r\n{more}{length}\r\n{body}".encode())

    def _send(self, data: bytes) -> None:
        with self._sending:
            self._connection.sendall(data)

    def _set_up(self, request: str, medium: int) -> None:
        channel = re.search(r"interleaved=(\d+)", request)
        if not channel:
            self._reply(request, "461 Unsupported Transport")
            return
        self._camera.set_up.append(self._camera._media[medium])
        self._channels[medium] = int(channel[1])
        pair = f"{channel[1]}-{int(channel[1]) + 1}"
        self._reply(request, more=f"Transport: RTP/AVP/TCP;unicast;interleaved={pair}\r\n")

    def _play(self) -> None:
        for medium, channel in self._channels.items():
            kind = self._camera._media[medium].removesuffix(" sendonly")
            send = self._send_video if kind in ENCODERS else self._send_sound
            threading.Thread(target=send, args=(kind, channel), daemon=True).start()

    def _send_packet(self, channel: int, packet: bytes) -> None:
        self._send(b"$" + bytes([channel]) + struct.pack(">H", len(packet)) + packet)

    def _send_sound(self, _kind: str, channel: int) -> None:
        number = 0
        try:
            while not self._ended.wait(0.02):
                head = struct.pack(">BBHII", 0x80, 8, number & 0xFFFF, number * 160 & 0xFFFFFFFF, 77)
                self._send_packet(channel, head + b"\xd5" * 160)
                number += 1
        except OSError:
            pass

    def _send_video(self, kind: str, channel: int) -> None:
        from runner.gst import Gst

        self._ended.wait(self._camera._late_s)
        pipeline: Any = Gst.parse_launch(f"{VIDEO} ! {ENCODERS[kind]} mtu=1200 ! appsink name=sink sync=false")
        sink = pipeline.get_by_name("sink")
        pipeline.set_state(Gst.State.PLAYING)
        try:
            while not self._ended.is_set():
                if sample := sink.emit("try-pull-sample", Gst.SECOND):
                    buffer = sample.get_buffer()
                    self._send_packet(channel, buffer.extract_dup(0, buffer.get_size()))
        except OSError:
            pass
        finally:
            pipeline.set_state(Gst.State.NULL)


@contextmanager
def mini_camera(*media: str, **habits: Any) -> Iterator[MiniCamera]:
    """A camera of these media and habits, see `MiniCamera`."""
    camera = MiniCamera(media or ("H264",), **habits)
    try:
        yield camera
    finally:
        camera.close()
