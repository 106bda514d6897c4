"""Players and receivers of other makers at a vehicle's cameras: each sees one stream, soon, beside any other."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import threading
import time
from contextlib import ExitStack, contextmanager
from itertools import permutations

import pytest

from keyed import VEHICLE, WATCHER, issue
from rig import Client, faults, streaming, until
from rtsp_client import RtspClient
from runner.core.commands import Command
from runner.security.keyring import Keyring

pytestmark = pytest.mark.gst
CAMERA, FPS = "rear", 30
SMALL = (f"vehicle={VEHICLE}", f"fps_max={FPS}", "cameras.rear.width_px=320", "cameras.rear.height_px=180")
SOON_S = 1.5
VARIANTS = [pytest.mark.soak, pytest.mark.players]
KNOBS = {"sending": True, "size": (320, 180), "bitrate": 500}


class Served:
    """A camera that is sent, the plan of its receivers, and what its vehicle reports."""

    def __init__(self, side, setup, plan, reported):
        self.plan, self.reported = plan, reported
        self.url = f"rtsp://127.0.0.1:{setup.media.port}/{CAMERA}"
        side.turn([Command(CAMERA, *knob) for knob in KNOBS.items()])


@contextmanager
def serving(*overrides):
    with streaming(*SMALL, *overrides, cameras=(CAMERA,)) as (side, setup, (plan,), reported):
        yield Served(side, setup, plan, reported)


@contextmanager
def playing(command):
    """A player in its own process; yields the process and, as it goes on, the lines it prints with their times."""
    lines = []
    environment = {**os.environ, "SDL_VIDEODRIVER": "dummy", "SDL_AUDIODRIVER": "dummy"}
    with subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment
    ) as child:

        def read():
            lines.extend((time.monotonic(), line) for line in child.stdout)

        reader = threading.Thread(target=read, daemon=True)
        reader.start()
        try:
            yield child, lines
        finally:
            child.kill()
            reader.join(10)


# --- one medium -------------------------------------------------------------------------------------------------------


def sets_up_everything(client, *, udp):
    """Set up each medium of the description, as relays do that take whatever is offered; returns the description."""
    assert client.ask("DESCRIBE", Accept="application/sdp") == 200
    description, base = client.body, re.search(r"Content-Base: (\S+?)/*\r", client.head)[1]
    media = re.findall(r"m=video 0 (\S+) .*?a=control:(\S+)", description, re.S)
    for number, (profile, control) in enumerate(media):
        transport = client.transport(profile, udp=udp, channel=2 * number)
        assert client.ask("SETUP", f"{base}/{control}", Transport=transport) == 200
    assert client.ask("PLAY", base) == 200
    client.read()
    until(lambda: client.frames > 5)
    return description


@pytest.mark.parametrize("secure", [False, True], ids=["plain", "keys"])
def test_one_medium_is_described_and_set_up_by_each_path(tmp_path, secure):
    """With feedback only where it is asked for, from one pipeline; with keys as SRTP."""
    keys = issue(tmp_path / "keys") if secure else None
    words = [f"keys={keys / VEHICLE}"] if keys else []
    plain, feedback = ("RTP/SAVP", "RTP/SAVPF") if keys else ("RTP/AVP", "RTP/AVPF")
    keyring = Keyring(keys / VEHICLE) if keys else None
    login = {"keys": keys / WATCHER, "vehicle": VEHICLE} if keys else {}
    with ExitStack() as stack:
        side, _, (plan,), reported = stack.enter_context(streaming(*SMALL, *words, cameras=(CAMERA,), keyring=keyring))
        side.turn([Command(CAMERA, *knob) for knob in KNOBS.items()])
        own = plan.operator[0].properties["location"]
        for udp in (False, True):
            for url, profile in ((own, feedback), (own.removesuffix("/feedback"), plain), (own + "/", feedback)):
                client = stack.enter_context(RtspClient(url, **login))
                description = sets_up_everything(client, udp=udp)
                formats = "96 97" if profile == feedback else "96"
                assert re.findall(r"^m=(.*)\r$", description, re.M) == [f"video 0 {profile} {formats}"]
                assert (" rtx/90000" in description) is (profile == feedback)
        assert faults(reported) == [f"{CAMERA}: pipeline built"]


# --- first pictures ---------------------------------------------------------------------------------------------------


@pytest.mark.alone
@pytest.mark.parametrize("transport", ["udp", pytest.param("tcp", marks=VARIANTS)])
@pytest.mark.parametrize("joins", [True, pytest.param(False, marks=VARIANTS)])
def test_ffmpeg_shows_its_first_picture_soon(transport, joins):
    """It joins in the middle of a refresh wave if somebody else watches."""
    with serving() as vehicle, RtspClient(vehicle.url) as other:
        if joins:
            assert other.open() == [200, 200, 200]
            other.read()
            until(lambda: other.frames > FPS)
        took = []
        for _ in range(3):  # the machine may be busy once
            began = time.monotonic()
            words = ["ffmpeg", "-v", "error", "-rtsp_transport", transport, "-i", vehicle.url]
            subprocess.run([*words, "-frames:v", "1", "-f", "null", "-"], check=True, timeout=30)
            took.append(time.monotonic() - began)
            if took[-1] < SOON_S:
                break
        assert min(took) < SOON_S


@pytest.mark.soak
@pytest.mark.players
@pytest.mark.parametrize("transport", ["udp", "tcp"])
@pytest.mark.parametrize("joins", [True, False])
def test_ffplay_is_not_far_behind(transport, joins):
    """It shows pictures by their times, from the first that it received: a slow start stays as delay."""
    words = ["ffplay", "-hide_banner", "-an", "-rtsp_transport", transport, "-vf", "showinfo"]
    with serving() as vehicle, RtspClient(vehicle.url) as other:
        if joins:
            assert other.open() == [200, 200, 200]
            other.read()
            until(lambda: other.frames > FPS)
        began = time.monotonic()
        with playing([*words, vehicle.url]) as (_, lines):

            def shown():
                found = [(at, re.search(r"pts_time:([\d.]+)", line)) for at, line in tuple(lines)]
                return [(at - began, float(pts[1])) for at, pts in found if pts]

            until(lambda: len(shown()) > 4 * FPS)
        behind = [at_s - pts_s for at_s, pts_s in shown()]
        assert behind[-1] < SOON_S, behind


# --- beside each other ------------------------------------------------------------------------------------------------

FFMPEG = "ffmpeg -v error -rtsp_transport {transport} -i {url} -map 0 -frames:v 30 -f null -"
GST_LAUNCH = "gst-launch-1.0 -q rtspsrc location={url} protocols={transport} ! decodebin ! fakesink num-buffers=30"
MPV = "mpv --no-config --no-audio --vo=null --rtsp-transport={transport} --frames=30 {url}"
PLAYERS = {"ffmpeg": FFMPEG, "gst-launch": GST_LAUNCH, "mpv": MPV}


@pytest.mark.parametrize(
    ("player", "transport"),
    [
        ("ffmpeg", "tcp"),
        *(
            pytest.param(player, transport, marks=VARIANTS)
            for player in PLAYERS
            for transport in ("udp", "tcp")
            if (player, transport) != ("ffmpeg", "tcp")
        ),
    ],
)
@pytest.mark.parametrize("is_first", [True, False], ids=["first", "last"])
def test_a_player_plays_whatever_is_offered(player, transport, is_first):
    """Alone, and beside a receiver with feedback that has lost packets sent again."""
    if not shutil.which(PLAYERS[player].split()[0]):
        pytest.skip(f"needs {player}")
    with serving() as vehicle, ExitStack() as stack:
        if not is_first:
            _losing(vehicle, stack)
        words = PLAYERS[player].format(url=vehicle.url, transport=transport).split()
        done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False)
        assert done.returncode == 0, done.stderr
        assert "error" not in done.stderr.lower()


@pytest.mark.soak
@pytest.mark.players
@pytest.mark.parametrize("order", list(permutations(["feedback", "ffmpeg udp", "gst-launch tcp", "gst-launch udp"], 3)))
def test_no_order_of_connecting_disturbs_a_viewer(order):
    endless = {name: line.replace("-frames:v 30 ", "").replace(" num-buffers=30", "") for name, line in PLAYERS.items()}
    with serving() as vehicle, ExitStack() as stack:
        players = []
        for each in order:
            player, _, transport = each.partition(" ")
            if player == "feedback":
                _losing(vehicle, stack)
            else:
                words = endless[player].format(url=vehicle.url, transport=transport).split()
                players.append(stack.enter_context(playing(words)))
            time.sleep(1.0)
        time.sleep(3.0)
        for child, lines in players:
            assert child.poll() is None, lines
        assert vehicle.reported[0] == f"{CAMERA}: pipeline built"
        assert not any("stopped" in what for what in vehicle.reported)


def _losing(vehicle, stack):
    """A receiver as our own that loses packets and has them sent again: every viewer gets those."""
    from runner.gst import Gst

    client = Client(vehicle.plan, feedback=True)
    stack.callback(client.pipeline.set_state, Gst.State.NULL)
    number = [0]

    def lose(_pad, info):
        number[0] += 1
        lost = number[0] % 20 == 0 and info.get_buffer().get_size() > 500
        return Gst.PadProbeReturn.DROP if lost else Gst.PadProbeReturn.OK

    def on_element(_pipeline, _parent, element):
        if element.get_factory() and element.get_factory().get_name() == "udpsrc":
            element.get_static_pad("src").add_probe(Gst.PadProbeType.BUFFER, lose)

    client.pipeline.connect("deep-element-added", on_element)
    until(lambda: len(client.sizes) > 5)
