"""What `model` measures is what a camera sends: the same picture from a bag or a clip, its recording and the stream."""

from __future__ import annotations

import json
import struct
import subprocess
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("cv2")
pytest.importorskip("rosbags")

import cv2
from bags import BEGAN_NS, compressed, filmed, image, typestore, write_bag
from shared_data import shared

from rig import streaming
from runner.configuration.config import configuration
from runner.core.commands import Command
from runner.core.model import BagTopic, Roi
from runner.graph import launch
from runner.gst import Gst
from runner.gst.pictures import luma_of
from runner.gst.sequence import discover, with_clip_range
from runner.plans import compile_plans
from runner.rate_quality.cache import Cache
from runner.rate_quality.metrics import find_metric
from runner.rate_quality.sequence import FEWEST_FRAMES, decoding, survey

pytestmark = pytest.mark.gst

CAMERA, FPS, FRAMES = "front_center", 25, 30
WIDTH, HEIGHT = 480, 272
FACTOR, KBPS = 0.5, 200
SIZE = [f"cameras.{CAMERA}.{k}={v}" for k, v in (("width_px", WIDTH), ("height_px", HEIGHT), ("fps", FPS))]
BAGS = ("jpeg", "bgr8", "mono8")
CLIPS = {  # by name, colorimetry and the elements that write it
    "full-range MP4": ("1:3:5:1", "x264enc pass=quant quantizer=2 ! mp4mux"),
    "full-range H.265 MP4": ("1:3:5:1", "x265enc option-string=qp=2:log-level=0 ! h265parse ! mp4mux"),
    "full-range MP4 of BT.601": ("1:4:16:4", "x264enc pass=quant quantizer=2 ! mp4mux"),
    "full-range Matroska": ("1:3:5:1", "x264enc pass=quant quantizer=2 ! matroskamux"),
    "limited-range MP4": ("bt709", "x264enc pass=quant quantizer=2 ! mp4mux"),
    "uncompressed RGB": ("bt709", "videoconvert ! video/x-raw,format=BGR ! avimux"),
    "MJPEG": ("1:4:0:0", "jpegenc quality=95 ! avimux"),
}


@pytest.fixture(scope="module")
def frames() -> list[np.ndarray]:
    """Of a drive, grey, so that the matrix of a clip does not matter: BGR."""
    grey = [cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY) for frame in _road()]
    return [cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR) for frame in grey]


def _road() -> list[np.ndarray]:
    return filmed(shared("video/forward_highway_day_540p25_A.mp4"), FRAMES, (WIDTH, HEIGHT))


def limited(frame: np.ndarray) -> np.ndarray:
    """Luma of a grey picture in limited range."""
    return np.round(16 + 219 / 255 * frame[..., 0]).astype(np.uint8)


@pytest.fixture(scope="module")
def footage(frames, tmp_path_factory):
    """Makes the bag or clip of a kind: its path, and the words that make it the camera's source."""

    def make(kind: str) -> tuple[Path, list[str]]:
        directory = tmp_path_factory.mktemp("footage")
        if kind in BAGS:
            path = write_bag(directory / "bag", "mcap", {"/front": list(_messages(kind, frames))})
            return path, ["source=bag", f"source.bag={path}", "source.topic=/front"]
        path = _clip(directory, frames, *CLIPS[kind])
        return path, ["source=file", f"source.clip={path}"]

    return make


def _messages(kind: str, frames: list[np.ndarray]):
    store = typestore("mcap")
    for number, frame in enumerate(frames):
        ns = BEGAN_NS + number * 10**9 // FPS
        if kind == "jpeg":
            message = compressed(store, ns, cv2.imencode(".jpg", frame)[1].tobytes(), "jpeg")
        else:
            pixels = frame if kind == "bgr8" else frame[..., :1]
            message = image(store, ns, np.ascontiguousarray(pixels), kind)
        yield ns, message


def _clip(directory: Path, frames: list[np.ndarray], colorimetry: str, writer: str) -> Path:
    full = colorimetry.startswith("1")
    planes = (frame[..., 0].tobytes() if full else limited(frame).tobytes() for frame in frames)
    raw, path = directory / "raw", directory / "clip"
    raw.write_bytes(b"".join(plane + bytes([128]) * (WIDTH * HEIGHT // 2) for plane in planes))
    form = f"format=i420 width={WIDTH} height={HEIGHT} framerate={FPS}/1"
    stated = f"capssetter caps=video/x-raw,colorimetry=(string){colorimetry}"
    line = f"filesrc location={raw} ! rawvideoparse {form} ! {stated} ! {writer} ! filesink location={path}"
    subprocess.run(["gst-launch-1.0", "-q", *line.split()], check=True, timeout=60)
    return path


# GStreamer's conversion of both range and matrix is two levels too bright, that of RGB as much too dark.
ROUGH = ("jpeg", "mono8", "MJPEG", "uncompressed RGB")
LEVELS = (0, 64, 128, 192, 255)  # of five stripes


@pytest.mark.parametrize("kind", [kind for kind in CLIPS if kind != "MJPEG"])
def test_contrast_is_right_whatever_range_a_clip_has(kind, tmp_path):
    frame = np.repeat(np.array(LEVELS, np.uint8), WIDTH // len(LEVELS))
    picture = np.ascontiguousarray(np.broadcast_to(frame[None, :, None], (HEIGHT, WIDTH, 3)))
    clip = _clip(tmp_path, [picture] * 3, *CLIPS[kind])
    middles = np.arange(WIDTH // 10, WIDTH, WIDTH // 5)
    for line in (sources_line(clip, WIDTH, HEIGHT), decoded(clip)):
        shown = next(pulled(line))[HEIGHT // 2, middles].astype(int)
        assert np.abs(shown - limited(picture)[0, middles]).max() <= (3 if kind in ROUGH else 1), line


def matrix(a: int, b: int, c: int, d: int) -> bytes:
    """The matrix of an MP4 header: a, b, u, c, d, v, x, y, w."""
    return struct.pack(">9i", a << 16, b << 16, 0, c << 16, d << 16, 0, 0, 0, 1 << 30)


@pytest.mark.parametrize(
    ("turn", "top"),
    [((0, 1, -1, 0), (16, 16)), ((-1, 0, 0, -1), (235, 16)), ((0, -1, 1, 0), (235, 235))],
    ids=["90", "180", "270"],
)
def test_a_clip_with_a_display_matrix_is_sent_upright(turn, top, tmp_path):
    """Before it is turned, its left half is black, its right half white."""
    width, height = (160, 96) if turn[0] else (96, 160)
    frame = np.zeros((96, 160), np.uint8) + 16
    frame[:, 80:] = 235
    raw, clip = tmp_path / "raw", tmp_path / "clip.mp4"
    raw.write_bytes(3 * (frame.tobytes() + bytes([128]) * (96 * 80)))
    form = "format=i420 width=160 height=96 framerate=25/1 ! capssetter caps=video/x-raw,colorimetry=(string)bt709"
    line = f"filesrc location={raw} ! rawvideoparse {form} ! x264enc ! mp4mux ! filesink location={clip}"
    subprocess.run(["gst-launch-1.0", "-q", *line.split()], check=True, timeout=60)
    movie, track, rest = clip.read_bytes().split(matrix(1, 0, 0, 1))  # each has one (ISO/IEC 14496-12)
    clip.write_bytes(movie + matrix(1, 0, 0, 1) + track + matrix(*turn) + rest)
    found = discover(clip, "sequence")
    assert (found.width, found.height) == (width, height)
    for line in (sources_line(clip, width, height), decoded(clip)):
        shown = next(pulled(line)).astype(int)
        assert shown.shape == (height, width)
        assert (shown[8, 8], shown[8, -8]) == pytest.approx(top, abs=3)


def sources_line(clip: Path, width: int, height: int) -> str:
    """A camera's source, as it plays the clip."""
    size = [f"cameras.{CAMERA}.{key}={value}" for key, value in (("width_px", width), ("height_px", height))]
    setup = configuration(["source=file", f"source.clip={clip}", *size, f"cameras.{CAMERA}.fps={FPS}"]).setup()
    (plan,) = (plan for plan in compile_plans(setup) if plan.camera.name == CAMERA)
    return launch(with_clip_range(plan).source)


@pytest.mark.timed
@pytest.mark.parametrize(
    "kind", ["jpeg", *(pytest.param(k, marks=[pytest.mark.soak, pytest.mark.sources]) for k in (*BAGS[1:], *CLIPS))]
)
def test_footage_its_recording_and_the_live_stream_have_the_same_quality(
    kind, footage, frames, tod, tmp_path, monkeypatch
):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr("runner.rate_quality.plots.plot", lambda *_: None)
    path, source = footage(kind)
    others = [f"~cameras.{name}" for name in ("front_left", "front_right", "rear_center")]
    others += [f"~cameras.top_{side}" for side in ("front", "left", "right", "rear")]
    recorded = tmp_path / "recorded" / f"{CAMERA}.mkv"
    done = tod("record", *others, *SIZE, *source, f"output={recorded.parent}", f"duration_s={FRAMES / FPS}")
    assert done.status == 0, done.err

    sent = [luma for luma, _ in zip(pulled(decoded(recorded)), range(FRAMES), strict=False)]
    assert len(sent) == FRAMES
    off = np.mean([before.astype(float) - limited(frame) for before, frame in zip(sent, frames, strict=True)])
    assert abs(off) < (2.5 if kind in ROUGH else 0.5)

    found = [measured(tod, sequence, tmp_path) for sequence in (path, recorded)]
    found.append(live(source, sent))
    assert max(found) - min(found) < 0.001, found


def test_distances_are_measured_as_white_as_the_source_says(tmp_path):
    """Also after the same bag has been measured with another range."""
    ramp = np.linspace(0, 5000, WIDTH).astype(np.uint16)  # mm
    frames = [np.tile(np.roll(ramp, number)[:, None], (HEIGHT, 1, 1)) for number in range(FEWEST_FRAMES)]
    bag = write_bag(tmp_path / "bag", "mcap", {"/front": list(_messages("16UC1", frames))})

    def detail(*words: str) -> float:
        words = ("source=bag", f"source.bag={bag}", "source.topic=/front", *words)
        camera = configuration(words).vehicle().cameras[CAMERA]
        return survey(BagTopic(str(bag), "/front", camera.source.depth_m), Cache(tmp_path / "cache", print), print).si

    far = detail()
    assert detail("source.depth_m=5") == pytest.approx(4 * far, rel=0.02)


def measured(tod, sequence: Path, directory: Path) -> float:
    words = ["plan=full", f"scalings=[{FACTOR}]", f"bitrates_kbps=[{KBPS},{2 * KBPS}]", "b_full_quality=0.5"]
    done = tod("model", f"camera={CAMERA}", f"sequence={sequence}", f"output={directory}", *SIZE, *words)
    assert done.status == 0, done.err
    points = json.loads((directory / f"{CAMERA}.model.json").read_text())["points"]
    return next(point["mssim"] for point in points if point["target_kbps"] == KBPS)


def live(source: list[str], sent: list[np.ndarray]) -> float:
    """Of the first pictures received over RTSP."""
    with streaming(*source, *SIZE, cameras=[CAMERA]) as (side, _, (plan,), _):
        size = (round(WIDTH * FACTOR), round(HEIGHT * FACTOR))
        values = {"roi": Roi(0, 0, WIDTH, HEIGHT), "size": size, "bitrate": KBPS, "sending": True}
        side.turn([Command(CAMERA, knob, value) for knob, value in values.items()])
        pictures = pulled(plan.receiver_into("videoconvert ! video/x-raw,format=I420"))
        meter = find_metric("mssim").meter((WIDTH, HEIGHT), Fraction(FPS))
        for number, (before, after) in enumerate(zip(sent, pictures, strict=False)):
            meter.add(number, before, cv2.resize(after, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC))
        pictures.close()
    return float(np.mean(list(meter.close().values())))


def decoded(clip: Path) -> str:
    """As `model` decodes it."""
    return decoding(clip, Fraction(FPS), discover(clip, "sequence").colorimetry)


def pulled(line: str):
    """The luma of a line's pictures."""
    pipeline = Gst.parse_launch(f"{line} ! appsink name=sink sync=false")
    pipeline.set_state(Gst.State.PLAYING)
    try:
        while sample := pipeline.get_by_name("sink").emit("try-pull-sample", 10 * Gst.SECOND):
            yield np.ascontiguousarray(luma_of(sample.get_buffer(), sample.get_caps()))
    finally:
        pipeline.set_state(Gst.State.NULL)
