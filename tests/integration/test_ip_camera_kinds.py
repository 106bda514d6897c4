"""IP cameras as people own them: sound beside the video, slow answers, wrong passwords, decoders that do not work."""

from __future__ import annotations

import re
import time
from contextlib import contextmanager

import inside
import pytest
from mini_camera import mini_camera

from rig import faults, free_port, ip_camera, streaming, until, watching
from runner.configuration.yaml_file import load_file
from runner.core.commands import Command
from runner.resources import directory

_FAST = "tune=zerolatency speed-preset=ultrafast key-int-max=15"
_H264 = f"x264enc {_FAST} ! rtph264pay config-interval=-1"
_VIDEO = "videotestsrc is-live=true ! video/x-raw,format=I420,width=320,height=240,framerate=15/1"
_LATE = "queue max-size-time=0 max-size-buffers=0 max-size-bytes=0 min-threshold-time=1500000000"
LAUNCHED = {
    "video": f"{_VIDEO} ! {_H264}",
    "late video": f"{_VIDEO} ! {_LATE} ! {_H264}",
    "sound": "audiotestsrc is-live=true ! audio/x-raw,rate=8000,channels=1 ! alawenc ! rtppcmapay pt=8",
    "H.265": f"{_VIDEO} ! x265enc {_FAST} ! rtph265pay config-interval=-1",
}
REAR = ("vehicle=delivery_robot", "source=rtsp", "fps_max=15")


@contextmanager
def robot(address, *words):
    """A robot whose rear camera is an IP camera. Yields (side, plan, reported)."""
    with streaming(*REAR, f'source.address="{address}"', *words, cameras=("rear",)) as (side, _, (plan,), reported):
        values = {"sending": True, "size": (424, 240), "bitrate": 500}
        side.turn([Command("rear", knob, value) for knob, value in values.items()])
        yield side, plan, reported


def shown(plan, frames=6, seconds=60.0):
    """Watch until so many pictures have arrived; a viewer that is refused tries again."""
    with watching(plan) as client:
        until(lambda: client.frames_with_retry() >= frames, seconds, every_s=0.2)


def refused(plan):
    """Watch until the viewer is refused; how long this took, s."""
    began = time.monotonic()
    with watching(plan) as client:
        until(lambda: client.errors)
    return time.monotonic() - began


def soak_of_sources(*values):
    return pytest.param(*values, marks=(pytest.mark.soak, pytest.mark.sources))


@pytest.mark.parametrize(
    ("media", "medium", "chosen"),
    [
        (("sound", "H264"), 0, "H264"),
        *(
            soak_of_sources(media, medium, chosen)
            for media, medium, chosen in (
                (("H264",), 0, "H264"),
                (("H264", "sound"), 0, "H264"),
                (("metadata", "sound", "H264"), 0, "H264"),
                (("H264", "sound", "back channel", "metadata"), 0, "H264"),
                (("back channel", "H264"), 0, "H264"),
                (("H265", "sound", "H264"), 0, "H265"),
                (("H265", "sound", "H264"), 1, "H264"),
                (("H264", "JPEG"), 1, "JPEG"),
                (("sound", "JPEG"), 0, "JPEG"),
                (("sound", "H264 sendonly"), 0, "H264 sendonly"),
            )
        ),
    ],
)
def test_only_the_chosen_video_of_a_camera_is_set_up(media, medium, chosen):
    """Its sound comes before its first key picture."""
    with (
        mini_camera(*media, late_s=0.3) as camera,
        robot(camera.address, f"source.medium={medium}") as (side, plan, reported),
        watching(plan) as client,
    ):
        until(lambda: client.frames_with_retry() > 5)
        assert camera.set_up == [chosen]
        assert faults(reported) == ["rear: pipeline built"]
        source = inside.sender(side, "rear").get_by_name("source")
        assert source.get_property("tcp-timeout") == 1_000_000  # as in its file again: the camera has streamed


def launched(*media):
    """The media of a camera of GStreamer, as launch lines."""
    return " ".join(f"{LAUNCHED[kind]} name=pay{number}" for number, kind in enumerate(media))


@pytest.mark.soak
@pytest.mark.sources
@pytest.mark.parametrize(
    "media",
    [
        ("video",),
        ("video", "sound"),
        ("sound", "video"),
        ("late video",),
        ("late video", "sound"),
        ("sound", "late video"),
        ("H.265",),
    ],
    ids=" ".join,
)
def test_cameras_of_gstreamer_are_shown(media):
    """Over UDP; their servers start sending all media at the same time."""
    with ip_camera(free_port(), media=launched(*media)) as (address, _), robot(address) as (side, plan, reported):
        shown(plan, frames=30)
        assert side.read()["rear"].fault is None
        assert reported.count("rear: pipeline built") == 1  # slow answers may be reported, but no attempt fails


@pytest.mark.parametrize(
    ("media", "words", "why"),
    [
        (
            ("H264", "sound"),
            ("source.medium=1",),
            "source.medium is 1, but the camera offers 1 video media, counted from 0",
        ),
        soak_of_sources(("sound", "metadata"), (), "the camera offers no video, only audio, application"),
    ],
)
def test_a_camera_without_the_wanted_video_is_reported(media, words, why):
    with mini_camera(*media) as camera, robot(camera.address, *words) as (_, plan, reported), watching(plan):
        until(lambda: f"rear: {why}" in reported)
        assert camera.set_up == []


@pytest.mark.parametrize(
    ("method", "delay_s"),
    [
        ("DESCRIBE", 2.0),
        soak_of_sources("DESCRIBE", 25.0),
        soak_of_sources("OPTIONS", 2.0),
        soak_of_sources("SETUP", 5.0),
        soak_of_sources("PLAY", 22.0),
    ],
)
def test_a_camera_that_answers_slowly_is_awaited(monkeypatch, method, delay_s):
    """By one attempt, however long; its viewers are refused at once meanwhile."""
    monkeypatch.setattr("runner.gst.opening.OPEN_S", 0.3)  # as long as a viewer waits
    with mini_camera(delays_s={method: delay_s}) as camera, robot(camera.address) as (side, plan, reported):
        refused(plan)
        waiting = until(lambda: side.read()["rear"].fault)
        assert re.fullmatch(rf"waiting for the camera: {method}, [12] s", waiting)
        assert refused(plan) < 1  # it would take delay_s
        shown(plan)
        assert side.read()["rear"].fault is None
        assert camera.connections == 1
        assert faults(reported)[1:3] == [
            f"rear: {waiting}",
            f"rear: the camera answered {method} after {delay_s:.0f} s",
        ]


def test_a_vehicle_stops_while_a_camera_does_not_answer():
    with mini_camera(delays_s={"DESCRIBE": 20}) as camera:
        with robot(camera.address) as (side, plan, _), watching(plan):
            until(lambda: side.read()["rear"].fault)
            began = time.monotonic()
        assert time.monotonic() - began < 3


@pytest.fixture
def credentials(tmp_path):
    file = tmp_path / "rear camera"
    file.write_text("viewer:wrong\n")
    file.chmod(0o600)
    return file


@pytest.mark.parametrize(
    ("login", "frozen_s"), [("basic", "1"), soak_of_sources("basic", None), soak_of_sources("md5", "1")]
)
def test_a_refused_login_is_tried_again_when_its_file_changes(credentials, login, frozen_s):
    """A camera locks out who tries too often. Its viewers make no attempt, whether or not the source is watched."""
    words = (f'source.credentials="{credentials}"', f"source.frozen_s={frozen_s}" if frozen_s else "~source.frozen_s")
    with mini_camera(login=login, password="right") as camera, robot(camera.address, *words) as (side, plan, reported):
        refused(plan)
        logins = len(camera.logins)
        assert logins == 1
        for _ in range(3):
            refused(plan)
        assert len(camera.logins) == logins
        why = f"the camera refuses the user or the password of {credentials}"
        assert side.read()["rear"].fault == why
        assert f"rear: {why}; next attempt after 60 s, or once this file has changed" in reported
        credentials.write_text("viewer:right\n")
        if login == "basic":
            shown(plan)
            assert side.read()["rear"].fault is None
        else:
            until(lambda: refused(plan) and len(camera.logins) > logins)
            assert len(camera.logins) == 2
            assert any("next attempt after 120 s" in line for line in reported)


@pytest.mark.parametrize("asked", [1, 2], ids=["before the login", "during the login"])
def test_an_attempt_logs_in_once_although_playing_is_requested_late(credentials, asked):
    """As by a busy machine, which goes on to PLAYING while the camera is being asked."""
    from runner.gst import Gst
    from runner.gst.credentials import Login
    from runner.gst.watched import WatchedSource

    words = (f'source.credentials="{credentials}"',)
    with (
        mini_camera(login="basic", delays_s={"DESCRIBE": 0.2}) as camera,
        robot(camera.address, *words) as (_, plan, reported),
    ):
        pipeline, login = Gst.Pipeline(), Login(plan, reported.append)
        pipeline.add(WatchedSource(plan, login, set(), reported.append))
        pipeline.set_state(Gst.State.PAUSED)
        until(lambda: sum(method == "DESCRIBE" for method, _ in camera.asked) == asked)
        pipeline.set_state(Gst.State.PLAYING)
        until(lambda: login.refusal)
        pipeline.set_state(Gst.State.NULL)
        assert len(camera.logins) == 1


def test_a_login_that_is_refused_while_the_camera_streams_counts_as_refused(credentials):
    """As after a change of the password, when the client connects again by itself."""
    from runner.gst import GLib, Gst

    credentials.write_text("viewer:right\n")
    words = (f'source.credentials="{credentials}"',)
    with (
        mini_camera(login="basic", password="right") as camera,
        robot(camera.address, *words) as (side, plan, reported),
        watching(plan) as client,
    ):
        until(lambda: client.frames_with_retry() > 5)
        source, logins = inside.sender(side, "rear").get_by_name("source"), len(camera.logins)
        why = GLib.Error.new_literal(Gst.ResourceError.quark(), "Unauthorized", Gst.ResourceError.NOT_AUTHORIZED)
        source.post_message(Gst.Message.new_error(source, why, ""))
        source.set_locked_state(True)
        source.set_state(Gst.State.PAUSED)
        time.sleep(2)  # longer than a camera may be frozen
        assert any(line.startswith("rear: the camera refuses the user or the password") for line in reported)
        assert len(camera.logins) == logins


@pytest.mark.soak
@pytest.mark.sources
def test_a_refused_login_is_tried_again_after_growing_pauses(monkeypatch, credentials):
    monkeypatch.setattr("runner.gst.credentials.REFUSED_S", (2.0, 30.0))
    with (
        mini_camera(login="md5") as camera,
        robot(camera.address, f'source.credentials="{credentials}"') as (_, plan, _),
    ):
        began = time.monotonic()
        while time.monotonic() - began < 12:  # due at 0, 2 and 6 s, then at 14 s
            refused(plan)
        assert len(camera.logins) == 3


def test_a_camera_that_only_knows_sha_256_is_named(tod, credentials):
    demands = "the camera demands SHA-256; this GStreamer knows MD5"
    words = (f'source.credentials="{credentials}"',)
    with mini_camera(login="sha256") as camera, robot(camera.address, *words) as (side, plan, reported):
        refused(plan)
        until(lambda: f"rear: {demands}" in reported)
        assert side.read()["rear"].fault == demands
        assert len(camera.logins) == 1
        done = tod("doctor", "vehicle", *REAR, f'source.address="{camera.address}"', *words)
        assert f"MISSING camera rear: {camera.address}: {demands}" in done.out.splitlines()


@contextmanager
def chosen_decoder(after, behind="identity"):
    """A decoder of H.264 that decodebin prefers, since its class does not say that it is hardware.

    after   how many pictures it delivers, then none
    behind  elements behind it
    """
    from runner.gst import Gst

    def always(name, direction, caps):
        return Gst.PadTemplate.new(name, direction, Gst.PadPresence.ALWAYS, Gst.Caps.from_string(caps))

    class Decoder(Gst.Bin):
        __gstmetadata__ = ("Vendor's decoder", "Codec/Decoder/Video", "Decodes H.264", "Vendor")
        __gsttemplates__ = (
            always("sink", Gst.PadDirection.SINK, "video/x-h264,stream-format=avc,alignment=au"),
            always("src", Gst.PadDirection.SRC, "video/x-raw(ANY)"),
        )

        def __init__(self):
            super().__init__()
            self.passed = 0
            inner = Gst.parse_bin_from_description(f"avdec_h264 ! {behind}", True)
            self.add(inner)
            for name in ("sink", "src"):
                self.add_pad(Gst.GhostPad.new(name, inner.get_static_pad(name)))
            self.get_static_pad("src").add_probe(Gst.PadProbeType.BUFFER, self.on_picture)

        def on_picture(self, _pad, _info):
            self.passed += 1
            return Gst.PadProbeReturn.OK if self.passed <= after else Gst.PadProbeReturn.DROP

    assert Gst.Element.register(None, "vendordec", Gst.Rank.NONE, Decoder)
    factory = Gst.ElementFactory.find("vendordec")
    factory.set_rank(Gst.Rank.PRIMARY + 1000)  # an element that is registered again keeps its rank
    try:
        yield
    finally:
        factory.set_rank(Gst.Rank.NONE)


@pytest.mark.parametrize("after", [0, soak_of_sources(1), soak_of_sources(20)])
def test_a_decoder_that_delivers_nothing_is_left_out(after):
    with chosen_decoder(after), mini_camera() as camera, robot(camera.address) as (side, plan, reported):
        shown(plan, frames=after + 10)
        silent = "decoder vendordec: no picture within 2 s; the next attempt leaves it out"
        assert [line for line in reported if silent in line]
        assert side.read()["rear"].fault is None


@pytest.mark.soak
@pytest.mark.sources
def test_a_decoder_whose_pictures_the_next_element_refuses_is_left_out():
    form = "video/x-raw,format=VENDOR,width=320,height=240,framerate=15/1"
    behind = f'capssetter join=false replace=true caps="{form}"'
    with chosen_decoder(1000, behind), mini_camera() as camera, robot(camera.address) as (_, plan, reported):
        shown(plan)
        assert "rear: decoder vendordec: no picture has passed; the next attempt leaves it out" in reported


@pytest.mark.parametrize("source", ["rtsp", "v4l2", "bag", "ros", "file"])
def test_packaged_sources_prefer_decoders_in_software(source):
    found = load_file(directory("conf") / "source" / f"{source}.yaml")["elements"]
    decoders = [element for element in found if element["element"] == "decodebin"]
    assert [element["properties"] for element in decoders] == [{"force-sw-decoders": True}]
