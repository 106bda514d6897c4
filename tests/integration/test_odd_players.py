"""Players with habits that were reported in public, see docs/sources.md, beside those of test_players."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path

import pytest
from test_players import serving

from rig import CHECKOUT, even_ports, needs_root, until
from rtsp_client import RtspClient

pytestmark = [pytest.mark.gst, pytest.mark.soak, pytest.mark.players]

HERE = Path(__file__).parent
OPENCV = """
import sys
import cv2
video = cv2.VideoCapture(sys.argv[1], cv2.CAP_FFMPEG, [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, 20000])
shapes = {video.read()[1].shape for _ in range(30)}
print(shapes)
assert shapes == {(180, 320, 3)}
"""
# None names a transport. Without `timeout`, ffmpeg 5 waits for a first packet for ever, and never changes to TCP.
DEFAULTS = {
    "rtspsrc": "gst-launch-1.0 rtspsrc location={url} ! decodebin ! fakesink num-buffers=30",
    "ffmpeg": "ffmpeg -v warning -timeout 3000000 -i {url} -frames:v 30 -f null -",
    "mpv": "mpv --no-config --no-audio --vo=null --frames=30 {url}",
}


def watch(player, url, **environment):
    """Whether a player shows its pictures within a time that no player waits for anything, and what it prints."""
    words = [sys.executable, "-c", OPENCV, url] if player == "opencv" else DEFAULTS[player].format(url=url).split()
    environment = {**os.environ, **environment}
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False, env=environment)
    return done.returncode, done.stdout + done.stderr


# --- OpenCV -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("transport", ["", "tcp", "udp", "udp_multicast"])
@pytest.mark.parametrize("is_first", [True, False], ids=["first", "last"])
def test_opencv_captures_over_each_transport(transport, is_first):
    """Multicast is not offered: it is refused, and OpenCV says so without waiting."""
    pytest.importorskip("cv2")
    options = {"OPENCV_FFMPEG_CAPTURE_OPTIONS": f"rtsp_transport;{transport}"} if transport else {}
    with serving() as vehicle, ExitStack() as stack:
        if not is_first:
            client = stack.enter_context(RtspClient(vehicle.url))
            assert client.open() == [200, 200, 200]
            client.read()
            until(lambda: client.frames > 5)
        began = time.monotonic()
        code, output = watch("opencv", vehicle.url, **options)
        assert (code == 0) is (transport != "udp_multicast"), output
        assert time.monotonic() - began < 15


# --- keep-alives ------------------------------------------------------------------------------------------------------

ALIVE = {
    "OPTIONS": ("OPTIONS", {}),
    "SET_PARAMETER": ("SET_PARAMETER", {}),
    "SET_PARAMETER, empty body": ("SET_PARAMETER", {"Content_Type": "text/parameters", "Content_Length": 0}),
    "GET_PARAMETER, empty body": ("GET_PARAMETER", {"Content_Type": "text/parameters", "Content_Length": 0}),
}


@pytest.mark.parametrize("kind", ALIVE)
def test_each_request_keeps_a_session_alive_without_reports(kind):
    """Over UDP, by a client that sends no RTCP: longer than the limit, and then stopped, it is left out."""
    method, headers = ALIVE[kind]
    with serving("media.session_timeout_s=1") as vehicle, RtspClient(vehicle.url) as client:
        assert client.open(udp=True) == [200, 200, 200]
        client_read(client)
        end = time.monotonic() + 9
        while time.monotonic() < end:
            assert client.ask(method, **headers) == 200
            time.sleep(0.5)
        seen = client.frames
        until(lambda: client.frames > seen + 15, 5)
        assert not any("stopped" in line for line in vehicle.reported)
        until(lambda: any("stopped" in line for line in vehicle.reported), 15)


def client_read(client):
    client.read()
    until(lambda: client.frames > 5)


# --- UDP that does not arrive -----------------------------------------------------------------------------------------

ANY = [*DEFAULTS, "opencv"]


def missing(player):
    words = DEFAULTS.get(player, sys.executable).split()
    if player == "opencv":
        pytest.importorskip("cv2")
    elif not shutil.which(words[0]):
        pytest.skip(f"needs {words[0]}")


@pytest.mark.parametrize("player", ANY)
def test_players_with_their_defaults_change_to_tcp_where_udp_is_refused(player):
    """Another program holds the vehicle's ports: SETUP over UDP gets 461."""
    missing(player)
    ports = even_ports(6)
    with ExitStack() as stack:
        for port in ports:
            stack.enter_context(socket.socket(type=socket.SOCK_DGRAM)).bind(("127.0.0.1", port))
        vehicle = stack.enter_context(serving(f"media.rtp_ports=[{ports[0]},{ports[-1]}]"))
        began = time.monotonic()
        code, output = watch(player, vehicle.url)
        assert code == 0, output
        assert time.monotonic() - began < 10


WATCHED = """
import sys, time
from test_odd_players import serving, watch
with serving() as vehicle:
    began = time.monotonic()
    code, output = watch(sys.argv[1], vehicle.url)
    print(output, vehicle.reported, f"{time.monotonic() - began:.1f} s")
    assert code == 0
"""
# Packets vanish without a word, as in a firewall between two machines.
BLOCKED = """
ip link set lo up
nft add table inet t
nft add chain inet t c '{ type filter hook input priority 0; }'
nft add rule inet t c meta l4proto udp drop
exec "$@"
"""


@needs_root
@pytest.mark.skipif(not shutil.which("nft"), reason="needs nft")
@pytest.mark.parametrize("player", ANY)
def test_players_with_their_defaults_change_to_tcp_where_a_firewall_drops_udp(player):
    """After the time that each of them waits for a first packet: in the same connection, or in a new one."""
    missing(player)
    inside = ["unshare", "--net", "sh", "-ec", BLOCKED, "sh", sys.executable, "-c", WATCHED, player]
    environment = {**os.environ, "PYTHONPATH": f"{CHECKOUT}:{HERE.parent}:{HERE}"}
    done = subprocess.run(inside, capture_output=True, text=True, timeout=90, check=False, env=environment)
    assert done.returncode == 0, done.stdout + done.stderr
