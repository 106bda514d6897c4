"""Whole pictures of cameras kept without loss while they are sent, by a real server with real clients."""

from __future__ import annotations

import hashlib
import json
import os
import resource
import signal
from contextlib import ExitStack, contextmanager
from dataclasses import replace

import inside
import pytest

from rig import SMALL_ROBOT, free_port, process, run, until, watching
from runner import graph
from runner.apply import LosslessFiles, VehicleSide, check_plan
from runner.configuration.config import configuration
from runner.core.commands import Command
from runner.drive.read import read_drive
from runner.errors import ConfigError
from runner.gst import Gst, lossless
from runner.plans import compile_plans
from runner.records.lines import LosslessBegan
from runner.settings import Lossless

CAMERAS = ("front", "rear")
ALWAYS = "log.lossless={front: {for_s: 2, every_s: 2}, rear: {for_s: 2, every_s: 2}}"
PICTURES = 50  # of a clip


class Vehicle:
    """Two cameras that are sent, and what is kept of them.

    files  (camera, file, capture time of its first picture) as reported
    """

    def __init__(self, directory, *words):
        self.files, self.reported = [], []
        ports = [f"media.port={free_port()}", f"graph.first_port={free_port(3)}"]
        setup = configuration([*SMALL_ROBOT, "source=test", *ports, *words], check=check_plan).setup()
        self.plans = compile_plans(setup.with_cameras({name: setup.vehicle.cameras[name] for name in CAMERAS}))
        files = LosslessFiles(directory, lambda *one: self.files.append(one))
        self.side = VehicleSide(self.plans, setup.media, self.report, lossless=files)

    def report(self, camera, what):
        self.reported.append(f"{camera}: {what}")

    def said(self, what):
        return [line for line in self.reported if what in line]

    def of(self, camera):
        return [file for name, file, _ in self.files if name == camera]

    @contextmanager
    def watched(self):
        with ExitStack() as stack:
            yield [stack.enter_context(watching(plan)) for plan in self.plans]


@pytest.fixture
def vehicle(tmp_path, request):
    one = Vehicle(tmp_path, *request.param)
    yield one
    one.side.stop()


def kept(*words):
    return pytest.mark.parametrize("vehicle", [words], indirect=True, ids=[""])


def decoded(path):
    """Digests of a file's pictures; fails if it cannot be read to its end."""
    caps = "video/x-raw,format=I420"
    pipeline = Gst.parse_launch(f'filesrc location="{path}" ! matroskademux ! decodebin ! {caps} ! appsink name=out')
    out = pipeline.get_by_name("out")
    out.set_property("sync", False)
    pipeline.set_state(Gst.State.PLAYING)
    pictures = []
    while sample := out.emit("try-pull-sample", 20 * Gst.SECOND):
        buffer = sample.get_buffer()
        pictures.append(hashlib.sha256(buffer.extract_dup(0, buffer.get_size())).hexdigest())
    assert pipeline.get_bus().pop_filtered(Gst.MessageType.ERROR) is None
    pipeline.set_state(Gst.State.NULL)
    return pictures


def has_length(path):
    """Whether a file states its length, which is written into it last."""
    pipeline = Gst.parse_launch(f'filesrc location="{path}" ! matroskademux ! fakesink name=end')
    pipeline.set_state(Gst.State.PAUSED)
    pipeline.get_state(20 * Gst.SECOND)
    known, length = pipeline.get_by_name("end").query_duration(Gst.Format.TIME)
    pipeline.set_state(Gst.State.NULL)
    return known and length > 0


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    """Of the front camera's size, each picture different."""
    path = tmp_path_factory.mktemp("clip") / "clip.mkv"
    width, height = configuration([*SMALL_ROBOT, "source=test"]).setup().vehicle.cameras["front"].source_size
    caps = f"video/x-raw,format=I420,width={width},height={height},framerate=30/1,colorimetry=bt709"
    made = Gst.parse_launch(
        f"videotestsrc num-buffers={PICTURES} pattern=ball background-color=0xff406080 ! {caps} ! timeoverlay"
        f' ! x264enc pass=quant quantizer=0 ! matroskamux ! filesink location="{path}"'
    )
    made.set_state(Gst.State.PLAYING)
    ended = made.get_bus().timed_pop_filtered(20 * Gst.SECOND, Gst.MessageType.EOS | Gst.MessageType.ERROR)
    made.set_state(Gst.State.NULL)
    assert ended.type == Gst.MessageType.EOS
    return path


def test_what_is_kept_is_what_the_source_delivered(clip, tmp_path):
    """Bit by bit, whatever size is sent; the rear camera has a limit, and the stream goes on behind it."""
    words = ("log.lossless={front: {for_s: 2, every_s: 2}, rear: {for_s: 2, every_s: 2, most_gb: 0.0002}}",)
    one = Vehicle(tmp_path, "source=file", f"source.clip={clip}", *words)
    try:
        with one.watched() as clients:
            until(lambda: len(one.of("front")) > 1)
            one.side.turn([Command("front", "size", (80, 60))])
            until(lambda: len(one.of("front")) > 2 and one.said("rear: its whole pictures are no longer kept"))
            before = len(clients[1].sizes)
            until(lambda: len(clients[1].sizes) > before + 30)
            rear = len(one.of("rear"))
        until(lambda: "rear: pipeline stopped" in one.reported)
    finally:
        one.side.stop()
    assert one.said("GB of log.lossless.rear.most_gb are full")
    assert len(one.of("rear")) == rear
    assert not one.said("missing")
    source = decoded(clip)
    assert len(set(source)) == PICTURES
    for file in one.of("front"):
        pictures = decoded(tmp_path / file)
        first = source.index(pictures[0])
        assert pictures == [source[(first + n) % PICTURES] for n in range(len(pictures))]
    captured = [at for name, _, at in one.files if name == "front"]
    assert captured[1] - captured[0] == pytest.approx(2, abs=0.5)


@kept("log.lossless={front: {for_s: 2, every_s: 5}, rear: {for_s: 2, every_s: 5}}")
def test_cameras_take_turns_and_pause(vehicle):
    with vehicle.watched():
        until(lambda: len(vehicle.files) == 3)
    (_, first, began), (_, second, turn), (_, third, again) = vehicle.files
    assert [first, second, third] == [
        f"video/{name}.lossless.{n}.mkv" for name, n in (("front", 0), ("rear", 0), ("front", 1))
    ]
    assert turn - began == pytest.approx(2, abs=0.5)
    assert again - began == pytest.approx(5, abs=0.5)


@kept(ALWAYS)
def test_a_file_is_complete_when_the_last_viewer_leaves_and_another_one_begins_later(vehicle, tmp_path):
    for number in range(2):
        with vehicle.watched():
            until(lambda n=number: len(vehicle.of("front")) > n and len(vehicle.of("rear")) > n)
        until(lambda n=number: vehicle.reported.count("front: pipeline stopped") == n + 1)
    for _, file, _ in vehicle.files:
        until(lambda f=file: has_length(tmp_path / f))
        assert decoded(tmp_path / file)


def stream_continues(vehicle, clients, what):
    """The streams go on in the same pipelines after the file has ended."""
    until(lambda: len(vehicle.said(what)) == len(CAMERAS))
    before = [len(client.sizes) for client in clients]
    until(lambda: all(len(c.sizes) > n + 40 for c, n in zip(clients, before, strict=True)))
    assert sorted(line for line in vehicle.reported if what not in line) == [f"{n}: pipeline built" for n in CAMERAS]


@kept(ALWAYS)
def test_a_full_disk_ends_the_file_and_not_the_stream(vehicle, monkeypatch, tmp_path):
    inside.storing_video_at(monkeypatch, tmp_path, "/dev/full")
    with vehicle.watched() as clients:
        stream_continues(vehicle, clients, "its whole pictures are no longer kept: ")
    assert any("space" in line.lower() for line in vehicle.reported), vehicle.reported


@kept(ALWAYS)
def test_a_disk_that_is_full_later_ends_the_file_and_not_the_stream(vehicle, tmp_path):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, hard))
    try:
        with vehicle.watched() as clients:
            stream_continues(vehicle, clients, "its whole pictures are no longer kept: ")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert decoded(tmp_path / vehicle.of("front")[0]), "what was written can be read"


@kept(ALWAYS)
def test_room_on_the_disk_is_left_for_the_logs(vehicle, monkeypatch):
    monkeypatch.setattr(lossless, "LEFT_BYTES", 1e18)
    with vehicle.watched() as clients:
        stream_continues(vehicle, clients, "its whole pictures are no longer kept: the disk has less than")
    assert vehicle.files == []


@kept(ALWAYS)
def test_a_directory_that_cannot_be_made_ends_the_file_and_not_the_stream(vehicle, tmp_path):
    (tmp_path / "video").write_text("a file")
    with vehicle.watched() as clients:
        stream_continues(vehicle, clients, "its whole pictures are no longer kept: ")
    assert vehicle.files == []


def test_a_disk_that_stalls_does_not_delay_the_stream(tmp_path, monkeypatch):
    """A pipe without a reader accepts 64 kB and then blocks."""
    monkeypatch.setattr(lossless, "FINISH_S", 2.0)
    monkeypatch.setitem(graph._QUEUE, "max-size-bytes", 500_000)
    ends = os.pipe()
    inside.storing_video_at(monkeypatch, tmp_path, f"/proc/self/fd/{ends[1]}")
    vehicle = Vehicle(tmp_path, ALWAYS)
    try:
        with vehicle.watched() as clients:
            stream_continues(vehicle, clients, "was not finished within 2 s")
            os.close(ends[0])
    finally:
        os.close(ends[1])
        vehicle.side.stop()


SLOW = (
    "recording.elements=[{name: slow, element: identity, properties: {sleep-time: 200000}},"
    " {name: encoder, element: x264enc, properties: {pass: quant, quantizer: 0, speed-preset: ultrafast}},"
    " {name: mux, element: matroskamux}]"
)


def test_pictures_that_an_encoder_is_too_slow_for_are_counted(tmp_path, monkeypatch):
    monkeypatch.setitem(graph._QUEUE, "max-size-bytes", 500_000)
    vehicle = Vehicle(tmp_path, "log.lossless={front: {for_s: 2, every_s: 2}}", SLOW)
    try:
        with vehicle.watched() as clients:
            (line,) = until(lambda: vehicle.said("whole pictures are missing in front.lossless.0.mkv"))
            assert len(clients[0].sizes) > 50, "all are sent"
    finally:
        vehicle.side.stop()
    missing, of = (int(word) for word in line.split() if word.isdigit())
    assert missing > 20
    assert of == missing + len(decoded(tmp_path / "video/front.lossless.0.mkv"))


@kept(ALWAYS)
def test_the_branch_does_not_affect_the_stream(vehicle, tmp_path):
    """Latency and format of what is sent are the same with and without it."""

    def seen(plan):
        pipeline, end = Gst.parse_launch(plan.pipeline), Gst.ElementFactory.make("fakesink", None)
        pipeline.add(end)
        pipeline.get_by_name("pay0").link(end)
        LosslessFiles(tmp_path, print).cameras([plan], vehicle.report).follow("front", pipeline)
        pipeline.set_state(Gst.State.PLAYING)
        try:
            caps = until(lambda: pipeline.get_by_name("sent").get_static_pad("src").get_current_caps())
            query = Gst.Query.new_latency()
            assert pipeline.query(query)
            return caps.to_string(), tuple(query.parse_latency())
        finally:
            pipeline.set_state(Gst.State.NULL)

    plan = replace(vehicle.plans[0], lossless=Lossless())
    assert "lossless-tee" in plan.pipeline
    assert seen(plan) == seen(replace(plan, lossless=None))


# --- of a whole drive -------------------------------------------------------------------------------------------------


def test_a_drive_that_is_ended_by_a_signal_leaves_files_that_models_are_measured_on(tmp_path, monkeypatch):
    pytest.importorskip("cv2")
    pytest.importorskip("numba")
    drive, cache = tmp_path / "drive", {"XDG_CACHE_HOME": str(tmp_path / "cache")}
    ports = (f"media.port={free_port()}", f"control.port={free_port()}")
    words = ("demo", *SMALL_ROBOT, "source=test", "page.serve=false", *ports, f"log={drive}")
    file = drive / "video/front.lossless.0.mkv"
    with process(*words, "log.lossless={front: {for_s: 30, every_s: 60}}", env=cache) as demo:
        until(lambda: file.exists() and file.stat().st_size > 600_000)
        demo.send_signal(signal.SIGTERM)
        assert demo.wait(30) == 128 + signal.SIGTERM
    assert has_length(file)
    lines = read_drive(drive).sides["vehicle"].of(LosslessBegan)
    assert [line.file for line in lines] == ["video/front.lossless.0.mkv"]
    small = ("scalings=[0.5,1.0]", "bitrates_kbps=[60,200]", "screens=[]", "metric_every=10")
    done = run("model", str(drive), f"output={tmp_path / 'models'}", "camera=front", *small, env=cache)
    assert done.returncode == 0, done.stderr
    assert "front: measured on front.lossless.0.mkv, kept without loss while driving" in done.stderr
    document = json.loads((tmp_path / "models/front.model.json").read_text())
    assert document["sequences"]["front"]["file"] == "front.lossless.0.mkv"
    assert document["sequences"]["front"]["lossless"]


# --- configuration ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("log.lossless={frnt: {}}", r"log\.lossless\.frnt: 'frnt': no such camera, did you mean front\?"),
        ("log.lossless={front: {for_s: 9, every_s: 3}}", r"log\.lossless\.front\.for_s: 9: must be at most every_s, 3"),
    ],
)
def test_a_wrong_request_is_refused(word, message):
    with pytest.raises(ConfigError, match=message):
        configuration([*SMALL_ROBOT, "source=test", word]).setup()


def test_a_camera_that_encodes_by_itself_has_no_raw_pictures():
    words = ("source=rtsp", "graph=pass_through", "source.address=rtsp://10.0.0.1/a")
    with pytest.raises(ConfigError, match=r"log\.lossless: needs raw pictures, but this camera is passed on"):
        configuration([*SMALL_ROBOT, *words, "log.lossless={front: {}}"]).setup()
