"""What an IP camera answers to DESCRIBE, without a login."""

from __future__ import annotations

import socket
import threading

import pytest

from runner.system.rtsp import Description, describe


def described(answer):
    """What is known of a camera that answers this."""

    def serve():
        camera, _ = listening.accept()
        with camera:
            camera.recv(1000)
            camera.sendall(answer.encode())

    with socket.create_server(("127.0.0.1", 0)) as listening:
        threading.Thread(target=serve, daemon=True).start()
        return describe(f"rtsp://127.0.0.1:{listening.getsockname()[1]}/", 5)


def refused(*challenges):
    return "\r\n".join(("RTSP/1.0 401 Unauthorized", *(f"WWW-Authenticate: {each}" for each in challenges), "", ""))


@pytest.mark.parametrize(
    ("challenges", "logins", "demands"),
    [
        (['Basic realm="a, Digest b"'], ("Basic",), None),
        (['Digest realm="a", nonce="b"'], ("Digest MD5",), None),
        (['digest realm="a", algorithm=md5, nonce="b"'], ("Digest MD5",), None),
        (['Digest realm="a", nonce="b", algorithm="SHA-256"', 'Digest realm="a", nonce="b"'], None, None),
        (['Digest realm="a", algorithm=SHA-256, nonce="b", Basic realm="a"'], ("Digest SHA-256", "Basic"), None),
        (['Digest realm="a", algorithm=SHA-256, nonce="b"'], ("Digest SHA-256",), "SHA-256"),
        (['Digest realm="a", algorithm=SHA-512-256'] * 2, ("Digest SHA-512-256",), "SHA-512-256"),
    ],
)
def test_the_logins_of_a_camera_are_named(challenges, logins, demands):
    found = described(refused(*challenges))
    assert found.status == 401
    assert found.logins == (logins or ("Digest SHA-256", "Digest MD5"))
    assert found.unknown_login == (f"the camera demands {demands}; this GStreamer knows MD5" if demands else None)


def test_video_media_are_counted():
    body = "v=0\r\nm=audio 0 RTP/AVP 8\r\nm=video 0 RTP/AVP 96\r\nm=video 0 RTP/AVP 26\r\n"
    assert described(f"RTSP/1.0 200 OK\r\nCSeq: 1\r\n\r\n{body}") == Description(200, (), 2)


@pytest.mark.parametrize("address", ["http://camera/stream", "/dev/video0", "rtsp:///stream"])
def test_other_addresses_are_refused(address):
    with pytest.raises(ValueError, match="must begin with one of rtsp://, rtsps://"):
        describe(address, 1)


def test_other_answers_are_refused():
    with pytest.raises(ValueError, match="no answer of RTSP"):
        described("HTTP/1.1 400 Bad Request\r\n\r\n")
