"""The stream of each camera kept in files, on both sides, while a real server and its clients run."""

from __future__ import annotations

import os
import resource
import socket
import subprocess
import time
from collections import Counter
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from itertools import pairwise

import inside
import pytest

from rig import CHECKOUT, SMALL_ROBOT, free_port, until, watching
from runner.apply import OperatorSide, VehicleSide, VideoFiles, check_plan, read_video
from runner.configuration.config import configuration
from runner.core.commands import Command
from runner.errors import ConfigError
from runner.gst import Gst, video_files
from runner.gst.caps import structure
from runner.gst.supervised import SupervisedPipeline
from runner.plans import compile_plans

CAMERAS = ("front", "rear")


class Sides:
    """Two cameras on the vehicle and at the operator, each with a file, and their reported first frames."""

    def __init__(self, directory, *words, cameras=CAMERAS):
        self.first_frames, self.reported = [], []
        ports = [f"media.port={free_port()}", f"graph.first_port={free_port(3)}"]
        overrides = [*SMALL_ROBOT, "source=test", "log.video=true", *ports, *words]
        setup = configuration(overrides, check=check_plan).setup()
        setup = setup.with_cameras({name: setup.vehicle.cameras[name] for name in cameras})
        self.plans, self.cameras = compile_plans(setup), cameras
        self.files = VideoFiles(directory, lambda *first: self.first_frames.append(first), lambda *shift: None)
        self.sending = VehicleSide(self.plans, setup.media, self.report, self.files)
        self.resize(320, 180)

    def report(self, camera, what):
        self.reported.append(f"{camera}: {what}")

    def resize(self, *size):
        self.sending.turn(Command(name, "size", size) for name in self.cameras)

    def stop(self):
        if self.sending:
            self.sending.stop()
            self.sending = None

    @contextmanager
    def receiving(self):
        side = OperatorSide(self.plans, self.report, video=self.files)
        try:
            yield side
        finally:
            side.stop()


@pytest.fixture
def sides(tmp_path, request):
    both = Sides(tmp_path, *getattr(request, "param", ()))
    yield both
    both.stop()


def decoded(path, whole=True):
    """Sizes of the pictures that ffmpeg decodes from a file, consecutive equal ones once, and how many pictures.

    whole  nothing was lost in transit: ffmpeg must accept the file and print nothing to standard error
    """
    raw = ["-fps_mode", "passthrough", "-enc_time_base", "1:90000"]
    raw += ["-noautoscale", "-f", "rawvideo", "-y", "/dev/null"]
    command = ["ffmpeg", "-v", "error", "-xerror", "-i", path, *raw]
    if whole:
        checked = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
        assert checked.stderr == ""
    frames = ["-select_streams", "v", "-show_entries", "frame=width,height", "-of", "csv=p=0"]
    shown = subprocess.run(["ffprobe", "-v", "error", *frames, path], capture_output=True, text=True, check=True)
    sizes = [tuple(map(int, line.strip(",").split(","))) for line in shown.stdout.split()]
    return [size for n, size in enumerate(sizes) if n == 0 or sizes[n - 1] != size], len(sizes)


OPENH264 = pytest.param(("graph=openh264_rtsp",), marks=pytest.mark.soak)


@pytest.mark.parametrize("sides", [(), ("graph=h264_srt",), OPENH264], indirect=True, ids=str)
def test_both_sides_store_what_they_send_and_receive(sides, tmp_path):
    with sides.receiving() as operator:
        for size in ((160, 90), (640, 360), (320, 180)):
            until(lambda: all(received.frames > 20 for received in operator.sample({}).values()))
            sides.resize(*size)
            before = operator.sample({})
            until(lambda b=before: all(c.frames > b[n].frames + 20 for n, c in operator.sample({}).items()))
        received, sent, counted = operator.sample({}), sides.sending.read(), time.monotonic()
    until(lambda: "front: pipeline stopped" in sides.reported or sides.plans[0].server is None)
    sides.stop()
    more = 10 + 30 * (time.monotonic() - counted)  # frames continue while both sides stop
    for name in CAMERAS:
        sizes = [(320, 180), (160, 90), (640, 360), (320, 180)]
        found, count = decoded(tmp_path / f"video/{name}.vehicle.0.ts")
        assert found[-4:] == sizes  # a caller sends before any knob is turned
        assert -2 <= count - sent[name].encoded.frames <= more
        # On a busy machine packets get lost on loopback, too; what arrives is stored unchanged.
        whole = received[name].decoded >= received[name].frames - 1 and received[name].lost == 0
        found, count = decoded(tmp_path / f"video/{name}.operator.0.ts", whole)
        # A receiver that joins a running stream begins with the next parameter sets.
        assert found[-4:] == sizes or (not whole and found == sizes[1:])
        assert received[name].decoded - 2 <= count <= received[name].decoded + more
    assert not [line for line in sides.reported if "kept" in line or "slow" in line]


def test_a_side_that_cannot_start_reports_no_file_error(tmp_path):
    """A pipeline that fails to start resets the element that writes the file before it has a name."""
    with ExitStack() as stack:
        sides = Sides(tmp_path, "graph=h264_srt", cameras=("front",))
        stack.callback(sides.stop)
        taken = stack.enter_context(socket.socket(type=socket.SOCK_DGRAM))
        port = next(element for element in sides.plans[0].operator if element.name == "listener")
        taken.bind(("127.0.0.1", Gst.Uri.from_string(port.properties["uri"]).get_port()))
        with sides.receiving():
            until(lambda: any("Could not open" in line for line in sides.reported))
            taken.close()
            until(lambda: any("operator" in file for _, file, _ in sides.first_frames))
        assert not [line for line in sides.reported if "kept" in line]


def test_the_first_frame_of_a_file_is_reported_with_its_capture_time(sides):
    start = time.time()
    with sides.receiving():
        until(lambda: len(sides.first_frames) == 4)
    end = time.time()
    first = {(camera, file): captured for camera, file, captured in sides.first_frames}
    for name in CAMERAS:
        sent = first[name, f"video/{name}.vehicle.0.ts"]
        received = first[name, f"video/{name}.operator.0.ts"]
        assert start < sent < end
        assert abs(received - sent) < 0.001  # the same frame, and the packets carry its capture time


def test_a_pause_has_its_true_length_in_the_files(sides, tmp_path):
    """GStreamer's demuxer would leave half a second of it."""
    with sides.receiving() as operator:
        until(lambda: operator.sample({})["front"].frames > 20)
        sides.sending.turn([Command("front", "sending", False)])
        time.sleep(1.5)
        sides.sending.turn([Command("front", "sending", True)])
        until(lambda: operator.sample({})["front"].frames > 40)
    sides.stop()
    for file in (f"video/front.{side}.0.ts" for side in ("vehicle", "operator")):
        units = list(read_video(tmp_path / file))
        assert max(b.after_ns - a.after_ns for a, b in pairwise(units)) > 1.4 * Gst.SECOND
        assert max(b.demuxed_ns - a.demuxed_ns for a, b in pairwise(units)) < 1.4 * Gst.SECOND


def test_a_rebuilt_pipeline_begins_a_new_file(sides, tmp_path):
    for number in range(2):
        with watching(sides.plans[0]) as client:
            until(lambda c=client: len(c.sizes) > 20)
        until(lambda n=number: sides.reported.count("front: pipeline stopped") == n + 1)
    assert [file for _, file, _ in sides.first_frames] == ["video/front.vehicle.0.ts", "video/front.vehicle.1.ts"]
    for number in range(2):
        assert decoded(tmp_path / f"video/front.vehicle.{number}.ts")[1] >= 20
    first, second = (captured for _, _, captured in sides.first_frames)
    assert first < second


def test_an_existing_file_is_never_overwritten(sides, tmp_path):
    (tmp_path / "video").mkdir()
    old = tmp_path / "video/front.vehicle.0.ts"
    old.write_bytes(b"another drive")
    with watching(sides.plans[0]):
        until(lambda: sides.first_frames)
    assert [file for _, file, _ in sides.first_frames] == ["video/front.vehicle.1.ts"]
    assert old.read_bytes() == b"another drive"


def test_an_operator_without_a_vehicle_leaves_no_files(tmp_path, monkeypatch):
    starts, build = Counter(), SupervisedPipeline._build
    monkeypatch.setattr(SupervisedPipeline, "_build", lambda self: (starts.update([self]), build(self)))
    sides = Sides(tmp_path)
    sides.stop()
    with sides.receiving():
        until(lambda: len(starts) == len(CAMERAS) and min(starts.values()) > 2)
    assert sides.first_frames == []
    assert list(tmp_path.iterdir()) == []


def test_the_file_does_not_affect_the_stream(sides):
    """Format and latency of the stream are the same with and without a file."""

    def seen(plan):
        pipeline, end = Gst.parse_launch(plan.pipeline), Gst.ElementFactory.make("fakesink", None)
        pipeline.add(end)
        pipeline.get_by_name("pay0").link(end)
        if plan.video:
            video_files.VideoFile(sides.files, "front", "vehicle", lambda *_: 0.0, sides.report).follow(pipeline)
        pipeline.set_state(Gst.State.PLAYING)
        try:
            caps = until(lambda: pipeline.get_by_name("sent").get_static_pad("src").get_current_caps())
            query = Gst.Query.new_latency()
            assert pipeline.query(query)
            form = structure(caps)
            return form.get_string("stream-format"), form.get_string("alignment"), tuple(query.parse_latency())
        finally:
            pipeline.set_state(Gst.State.NULL)

    plan = sides.plans[0]
    assert seen(replace(plan, video=True)) == seen(plan)


# --- faults that do not end the stream --------------------------------------------------------------------------------


def failed_files(sides):
    """Files that were reported as failed; the operator names cameras together if they fail alike."""
    reports = [line.partition(": ") for line in sides.reported]
    return sum(len(cameras.split(", ")) for cameras, _, what in reports if what.startswith("video is not recorded"))


def stream_continues(sides, camera="front"):
    """The stream continues on both sides, in the same pipelines, after the file has failed on both."""
    with sides.receiving() as operator:
        until(lambda: failed_files(sides) == 2 * len(CAMERAS))
        before = operator.sample({})[camera].frames
        until(lambda: operator.sample({})[camera].frames > before + 40)
        received = operator.sample({})
        assert {c.rebuilt for c in received.values()} == {0}, sides.reported
        sides.resize(160, 90)
        until(lambda: operator.sample({})[camera].width == 160)
    others = [line for line in sides.reported if "video is not recorded" not in line and "pipeline stopped" not in line]
    assert sorted(others) == [f"{name}: pipeline built" for name in CAMERAS]


def test_a_full_disk_ends_the_file_and_not_the_stream(sides, monkeypatch, tmp_path):
    inside.storing_video_at(monkeypatch, tmp_path, "/dev/full")
    stream_continues(sides)
    assert any("space" in line.lower() for line in sides.reported), sides.reported


def test_a_disk_that_is_full_later_ends_the_file_and_not_the_stream(sides, tmp_path):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, hard))
    try:
        stream_continues(sides)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    for name in CAMERAS:
        assert (tmp_path / f"video/{name}.vehicle.0.ts").stat().st_size == 50_000


def test_a_directory_that_cannot_be_made_ends_the_file_and_not_the_stream(sides, tmp_path):
    (tmp_path / "video").write_text("a file")
    stream_continues(sides)
    assert sides.first_frames == []


def test_a_disk_that_stalls_does_not_delay_the_stream(tmp_path, monkeypatch):
    """A pipe without a reader accepts 64 kB and then blocks."""
    ends = os.pipe()
    inside.storing_video_at(monkeypatch, tmp_path, f"/proc/self/fd/{ends[1]}", queue_bytes=20_000)
    sides = Sides(tmp_path)
    try:
        with sides.receiving() as operator:
            until(lambda: any("too slow" in line for line in sides.reported))
            before = operator.sample({})["front"].frames
            until(lambda: operator.sample({})["front"].frames > before + 40)
            os.close(ends[0])  # the writers fail, and can be ended
            until(lambda: any("video is not recorded" in line for line in sides.reported))
    finally:
        os.close(ends[1])
        sides.stop()


# --- configuration ----------------------------------------------------------------------------------------------------


def test_a_graph_without_counters_is_rejected(tmp_path):
    text = (CHECKOUT / "conf/graph/h264_rtsp.yaml").read_text()
    (tmp_path / "graph").mkdir()
    (tmp_path / "graph/mine.yaml").write_text(text.replace("{name: sent,", "{name: other,"))
    configuration(["source=test", "graph=mine"], tmp_path).vehicle()
    with pytest.raises(
        ConfigError,
        match=r"mine\.yaml: vehicle: log\.video needs an identity named sent .*; see command line: log\.video=true",
    ):
        configuration(["source=test", "graph=mine", "log.video=true"], tmp_path).vehicle()


def test_h265_is_stored_unchanged(tmp_path):
    for element in ("x265enc", "avdec_h265"):
        if not Gst.ElementFactory.find(element):
            pytest.skip(f"{element} is not installed")
    sides = Sides(tmp_path, "graph=h265_rtsp", cameras=("front",))
    with sides.receiving() as operator:
        until(lambda: operator.sample({})["front"].frames > 40)
    until(lambda: "front: pipeline stopped" in sides.reported)
    sides.stop()
    for side in ("vehicle", "operator"):
        sizes, count = decoded(tmp_path / f"video/front.{side}.0.ts", whole=side == "vehicle")
        assert sizes == [(320, 180)]
        assert count > 35
