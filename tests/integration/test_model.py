"""Rate-quality models measured by the real encoders: the contract, the live pipeline's own quality, interruption."""

from __future__ import annotations

import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from fractions import Fraction
from pathlib import Path

import inside
import numpy as np
import pytest

from rig import CHECKOUT, CLIPS, WAIT_S, faults, over_tcp, process, run, streaming, until
from runner import schema
from runner.__main__ import main
from runner.configuration.config import configuration
from runner.core.commands import Command
from runner.core.model import Roi
from runner.rate_quality.artefact import read_model
from runner.rate_quality.curves import Point, draw_curves, ladder_quality, mean_score
from runner.rate_quality.metrics import find_metric

pytestmark = pytest.mark.gst
cv2 = pytest.importorskip("cv2")

WIDTH, HEIGHT, FPS, FRAMES = 320, 192, 25, 40
CAMERA = ("camera=front_center",)
SMALL = ("scalings=[0.25,0.5,1.0]", "bitrates_kbps=[50,100,200,400,800]")
TINY = ("scalings=[0.5,1.0]", "bitrates_kbps=[100,400]")  # when any points will do


def picture(number: int, texture: np.ndarray) -> np.ndarray:
    """A simple street: a texture that slides, faster at the bottom, and a crossing car."""
    rows = np.arange(HEIGHT)[:, None]
    columns = (np.arange(WIDTH)[None, :] + number * (rows // 24)) % texture.shape[1]
    shown = texture[rows % texture.shape[0], columns].copy()
    shown[90:120, (5 * number) % WIDTH : (5 * number) % WIDTH + 40] = 220
    return shown


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """1.6 seconds of 320x192 at 25 Hz, nearly lossless."""
    return street(tmp_path_factory.mktemp("clip"), FRAMES)


def street(directory: Path, frames: int) -> Path:
    from runner.gst.clip_writer import write_clip

    noise = np.random.default_rng(1).integers(0, 256, (HEIGHT, 2 * WIDTH)).astype(np.uint8)
    texture = cv2.addWeighted(cv2.GaussianBlur(noise, (0, 0), 3), 2.0, cv2.GaussianBlur(noise, (0, 0), 0.8), 0.5, -190)
    chroma = bytes([128]) * (WIDTH * HEIGHT // 2)
    path = directory / "street.mp4"
    pictures = (picture(number, texture).tobytes() + chroma for number in range(frames))
    write_clip(path, pictures, WIDTH, HEIGHT, Fraction(FPS), quantizer=2)
    return path


@pytest.fixture
def cache(tmp_path: Path) -> dict[str, str]:
    return {"XDG_CACHE_HOME": str(tmp_path / "cache")}


def model(*words: str, cache: dict[str, str], figures: bool = False) -> subprocess.CompletedProcess[str]:
    """The verb in this process, which has already loaded the libraries; figures take a third of the time."""
    out, err = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out), redirect_stderr(err):
        for name, value in cache.items():
            patch.setenv(name, value)
        if not figures:
            patch.setattr("runner.rate_quality.plots.plot", lambda *_: None)
        status = main(("model", *words))
    return subprocess.CompletedProcess(words, status, out.getvalue(), err.getvalue())


@pytest.fixture(scope="module")
def measured(clip: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict, str]:
    """The full plan on the clip, measured once: directory, model file, output."""
    directory = tmp_path_factory.mktemp("measured")
    words = (
        "camera=front_center",
        f"sequence={clip}",
        f"output={directory}",
        "metric=[mssim,psnr]",
        "plan=full",
        *SMALL,
    )
    done = model(*words, cache={"XDG_CACHE_HOME": str(directory / "cache")}, figures=True)
    assert done.returncode == 0, done.stderr
    return directory, json.loads((directory / "front_center.model.json").read_text()), done.stdout


def test_a_model_writes_what_the_contract_requires(measured):
    directory, document, printed = measured
    assert schema.findings(document, "rate_quality") == []
    assert len(document["points"]) == 15
    assert {(p["scaling"], p["target_kbps"]) for p in document["points"]} >= {(0.25, 50), (1, 800)}
    assert all(0 < p["mssim"] < 1 and 10 < p["psnr"] < 60 and p["encode_ms"] > 0 for p in document["points"])
    assert [c["upper"] for c in document["crossings"]] == document["scaling"][1:]
    assert all(c["low"] <= c["kbps"] <= c["high"] for c in document["crossings"])
    clip = document["sequences"]["front_center"]
    assert (clip["frames"], clip["width"], clip["fps"], clip["lossless"]) == (FRAMES, WIDTH, FPS, False)
    assert clip["si"] > 10
    assert clip["ti"] > 1
    assert (directory / "front_center.png").read_bytes().startswith(b"\x89PNG")
    assert (directory / "front_center.pdf").read_bytes().startswith(b"%PDF")
    assert "is already compressed with loss" in printed
    assert "the sequence is 320x192 at 25 Hz, the camera 1920x1040 at 40 Hz" in printed


@pytest.mark.soak
@pytest.mark.timed
def test_its_camera_is_mounted_and_drives(tod, measured, tmp_path):
    directory, document, _ = measured
    shutil.copytree(CHECKOUT / "conf" / "cameras", tmp_path / "conf" / "cameras")
    shutil.copy(directory / "front_center.yaml", tmp_path / "conf" / "cameras" / "measured.yaml")
    words = (f"conf={tmp_path / 'conf'}", "cameras@cameras.front_center=measured")
    assert tod("validate", *words[:1], "vehicle=tum_q7", "modes=paper", "graph=h264_rtsp", "source=test").status == 0
    printed = json.loads(tod("print", *words, "format=json", "total_kbps=9000").out)["cameras"]["front_center"]
    assert printed["decision"]["demand_kbps"] == document["b_full_kbps"]
    ladder = list(zip(document["b_min_kbps"], document["scaling"], strict=True))
    assert printed["decision"]["scaling"] == max(pair for pair in ladder if pair[0] <= printed["decision"]["kbps"])[1]
    drive = ("source=test", "page.serve=false", "fps_max=5", "duration_s=2", "pqos=constant", "pqos.kbps=9000")
    done = run("demo", *words, *drive)
    assert done.returncode == 0, done.stderr
    assert "front_center" in done.stdout


@pytest.mark.timed
def test_the_live_pipeline_has_the_same_quality(clip, measured):
    _, document, _ = measured
    points = {(p["scaling"], p["target_kbps"]): p["mssim"] for p in document["points"]}
    reference = luma_of(clip)
    form = [
        f"cameras.front_center.{key}={value}"
        for key, value in (("width_px", WIDTH), ("height_px", HEIGHT), ("fps", FPS))
    ]
    for scaling, kbps in ((0.25, 100), (0.5, 200), (1.0, 400)):
        size = (round(WIDTH * scaling), round(HEIGHT * scaling))
        values = {"roi": Roi(0, 0, WIDTH, HEIGHT), "size": size, "bitrate": kbps, "sending": True}
        scores = mssim(reference, until(lambda v=values: streamed(clip, form, v), seconds=5 * WAIT_S))
        assert np.mean(scores) == pytest.approx(points[scaling, kbps], abs=1e-3)


def luma_of(path: Path) -> list[np.ndarray]:
    line = f'filesrc location="{path}" ! decodebin ! videoconvert ! video/x-raw,format=I420'
    return [picture for picture, _ in pulled(line, FRAMES)]


def streamed(clip: Path, form: list[str], knobs: dict[str, object]) -> list[np.ndarray] | None:
    """The first pictures received over RTSP; None if a busy machine left some out, or changed what each may cost."""
    with streaming("source=file", f"source.clip={clip}", *form, cameras=["front_center"]) as (side, _, plans, reported):
        side.turn([Command("front_center", knob, value) for knob, value in knobs.items()])
        line = over_tcp(plans[0]).receiver_into("videoconvert ! video/x-raw,format=I420")
        seen = [(*each, inside.camera(side, "front_center").knobs.pace) for each in pulled(line, FRAMES)]
    pictures, captured, paces = zip(*seen, strict=True)
    is_steady = set(paces) == {1.0} and np.allclose(np.diff(captured), 1 / FPS, atol=1e-3)
    return list(pictures) if is_steady and reported == faults(reported) else None


def pulled(line: str, count: int) -> Iterator[tuple[np.ndarray, float | None]]:
    """The first pictures of a pipeline, each with its capture time, s."""
    from runner.gst import Gst
    from runner.gst.pictures import luma_of
    from runner.gst.receiver import capture_time

    pipeline = Gst.parse_launch(f"{line} ! appsink name=sink sync=false")
    pipeline.set_state(Gst.State.PLAYING)
    try:
        for number in range(count):
            sample = pipeline.get_by_name("sink").emit("try-pull-sample", 10 * Gst.SECOND)
            assert sample, f"{number} of {count} pictures arrived"
            yield luma_of(sample.get_buffer(), sample.get_caps()), capture_time(sample.get_buffer())
    finally:
        pipeline.set_state(Gst.State.NULL)


def mssim(reference: list[np.ndarray], pictures: list[np.ndarray]) -> list[float]:
    meter = find_metric("mssim").meter((WIDTH, HEIGHT), Fraction(FPS))
    for number, (before, after) in enumerate(zip(reference, pictures, strict=True)):
        large = (
            after if after.shape == before.shape else cv2.resize(after, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
        )
        meter.add(number, np.ascontiguousarray(before), np.ascontiguousarray(large))
    return list(meter.close().values())


def test_what_was_measured_is_not_measured_again_and_another_metric_keeps_the_first(clip, tmp_path, cache):
    words = ("camera=front_center", f"sequence={clip}", f"output={tmp_path}", "plan=full", *TINY)
    assert "(4 encoded, 0 known)" in model(*words, cache=cache).stdout
    before = (tmp_path / "front_center.model.json").read_bytes()
    assert "(0 encoded, 4 known)" in model(*words, cache=cache).stdout
    assert (tmp_path / "front_center.model.json").read_bytes() == before
    assert "(4 encoded, 0 known)" in model(*words, "metric=psnr", cache=cache).stdout
    assert "(0 encoded, 4 known)" in model(*words, cache=cache).stdout
    assert "(4 encoded, 0 known)" in model(*words, "graph=openh264_rtsp", cache=cache).stdout  # another encoder


@pytest.mark.parametrize("graph", ["openh264_rtsp", pytest.param("h264_rtsp", marks=pytest.mark.soak)])
def test_an_encoder_that_exceeds_its_bitrate_in_a_second_is_named(graph, tmp_path, cache):
    """OpenH264 does at a hard cut to noise, x264 holds it."""
    from runner.gst.clip_writer import write_clip

    chance, clip = np.random.default_rng(1), tmp_path / "noise.mp4"
    noise = [chance.integers(0, amplitude, (HEIGHT * 3 // 2, 2 * WIDTH), np.uint8) for amplitude in (12, 120)]
    shown = (noise[number // 40][:, 7 * number % WIDTH :][:, :WIDTH].tobytes() for number in range(80))
    write_clip(clip, shown, WIDTH, HEIGHT, Fraction(FPS), quantizer=2)
    words = ("camera=front_center", f"graph={graph}", f"sequence={clip}", f"output={tmp_path}", "plan=full")
    done = model(*words, "scalings=[0.5]", "bitrates_kbps=[300,1000]", cache=cache)
    found = {p["target_kbps"]: p["second_kbps"] for p in points_of(tmp_path)}
    assert (found[300] > 1.1 * 300) == (graph == "openh264_rtsp")
    named = f"of its targets in some second: it reaches {found[300]:.0f} at a target of 300 kbit/s"
    assert (named in done.stdout) == (graph == "openh264_rtsp"), done.stdout


def test_a_cache_file_that_is_cut_in_half_is_reported_and_measured_again(clip, tmp_path, cache):
    words = ("camera=front_center", f"sequence={clip}", f"output={tmp_path}", "plan=full", *TINY)
    model(*words, cache=cache)
    before = points_of(tmp_path)
    files = sorted(Path(cache["XDG_CACHE_HOME"]).rglob("points/*.json"), key=lambda path: path.stat().st_size)
    files[-1].write_bytes(files[-1].read_bytes()[: files[-1].stat().st_size // 2])
    done = model(*words, cache=cache)
    assert done.returncode == 0
    assert f"{files[-1]}: cannot be read (" in done.stderr
    assert "(1 encoded, 3 known)" in done.stdout
    assert points_of(tmp_path) == before


@pytest.mark.parametrize("survey", [False, True])
def test_a_cache_file_with_other_content_is_reported_once_and_measured_again(clip, tmp_path, cache, survey):
    """It is valid JSON, of the survey of the clip or of one of the points."""
    words = ("camera=front_center", f"sequence={clip}", f"output={tmp_path}", "plan=full", *TINY)
    model(*words, cache=cache)
    before = (tmp_path / "front_center.model.json").read_bytes()
    files = sorted(Path(cache["XDG_CACHE_HOME"]).rglob("points/*.json"), key=lambda path: path.stat().st_size)
    damaged = files[0 if survey else -1]
    damaged.write_text(damaged.read_text().replace('"frames"', '"names"').replace('"scores"', '"stores"'))
    done = model(*words, cache=cache)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count(f"{damaged}: is damaged, measured again") == 1
    assert f"({0 if survey else 1} encoded, {4 if survey else 3} known)" in done.stdout
    assert model(*words, cache=cache).stderr.count("measured again") == 0
    if survey:
        assert (tmp_path / "front_center.model.json").read_bytes() == before


def points_of(directory: Path) -> list[dict]:
    """All points without their encoding times."""
    document = json.loads((directory / "front_center.model.json").read_text())
    return [{key: value for key, value in point.items() if key != "encode_ms"} for point in document["points"]]


def test_an_interrupted_run_continues_where_it_stopped(clip, measured, tmp_path, cache):
    words = (
        "camera=front_center",
        f"sequence={clip}",
        f"output={tmp_path}",
        "plan=full",
        "metric=[mssim,psnr]",
        *SMALL,
    )
    kept = Path(cache["XDG_CACHE_HOME"]) / "tod-runner" / "points"
    with process("model", *words, env=cache) as child:
        until(lambda: kept.is_dir() and len(list(kept.glob("*.json"))) > 5, 60)  # the survey and some points
        child.send_signal(signal.SIGINT)
        assert child.wait(timeout=30) == 130
    assert not (tmp_path / "front_center.yaml").exists()
    assert list(kept.glob(".*")) == []
    done = model(*words, cache=cache)
    known = int(done.stdout.partition("encoded, ")[2].partition(" known")[0])
    assert 5 <= known < 15
    assert points_of(tmp_path) == points_of(measured[0])


@pytest.mark.parametrize("workers", [pytest.param("threads", marks=pytest.mark.soak), "processes"])
def test_other_workers_find_the_same(clip, measured, tmp_path, cache, workers):
    words = (f"workers={workers}", "parallel=2", "plan=full", "metric=[mssim,psnr]")
    done = model("camera=front_center", f"sequence={clip}", f"output={tmp_path}", *words, *SMALL, cache=cache)
    assert done.returncode == 0, done.stderr
    assert points_of(tmp_path) == points_of(measured[0])


@pytest.mark.soak
def test_a_cluster_that_loses_a_worker_finds_the_same(clip, measured, tmp_path, cache, monkeypatch):
    distributed = pytest.importorskip("distributed")
    monkeypatch.setenv("PYTHONPATH", str(CHECKOUT))  # for the workers
    words = ("plan=full", "metric=[mssim,psnr]", "workers=dask")
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        where = f"scheduler={cluster.scheduler_address}"
        kept = Path(cache["XDG_CACHE_HOME"]) / "tod-runner" / "points"
        command = ("camera=front_center", f"sequence={clip}", f"output={tmp_path}", *words, where, *SMALL)
        with process("model", *command, env=cache) as child:
            until(lambda: kept.is_dir() and len(list(kept.glob("*.json"))) > 1, 90)  # a first set is done
            at_work = max(cluster.scheduler.workers.values(), key=lambda worker: len(worker.processing))
            os.kill(cluster.workers[at_work.name].pid, signal.SIGKILL)
            assert child.wait(timeout=120) == 0, child.stdout.read()
    assert points_of(tmp_path) == points_of(measured[0])


WATCHED = """
import gc, sys, threading, time
from runner.__main__ import main
from runner.rate_quality.workers import without_cycle_collection

def watch():
    while True:
        sys._current_frames()
        time.sleep(0.002)

gc.callbacks.append(lambda phase, info: time.sleep(0.0005))  # other threads run during this time
gc.set_threshold(50)
threading.Thread(target=watch, daemon=True).start()
sys.exit(without_cycle_collection(main, sys.argv[1:]))
"""


@pytest.mark.soak
def test_measuring_works_while_a_dask_worker_inspects_its_threads(clip, measured, tmp_path, cache):
    """As in a worker, but continuously: threads are inspected while cycles are collected."""
    words = ("model", "camera=front_center", f"sequence={clip}", f"output={tmp_path}", "plan=full", *SMALL)
    environment = {**os.environ, **cache, "PYTHONPATH": str(CHECKOUT)}
    command = [sys.executable, "-c", WATCHED, *words, "metric=[mssim,psnr]"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    assert points_of(tmp_path) == points_of(measured[0])


@pytest.mark.soak
def test_the_adaptive_plan_finds_the_same_as_the_full_one(tmp_path, cache):
    # A clip that is hardly longer than one refresh wave, 1.5 s, has no bitrate that one could interpolate.
    words = ("camera=front_center", f"sequence={street(tmp_path, 60)}", "screens=[]")
    found = {}
    for plan in ("full", "adaptive"):
        done = model(*words, f"output={tmp_path / plan}", f"plan={plan}", cache=cache)
        assert done.returncode == 0, done.stderr
        found[plan] = read_model(tmp_path / plan / "front_center.model.json")
    full, adaptive = found["full"], found["adaptive"]
    assert len(adaptive["points"]) <= len(full["points"]) / 3
    assert adaptive["metric_every"] < 5  # more frames of a short sequence are scored
    assert lost(full, adaptive) < 3e-3  # these curves span 0.6, those of recorded drives 0.1
    done = run("model", "compare", *(str(tmp_path / plan / "front_center.model.json") for plan in ("full", "adaptive")))
    assert "plan       full -> adaptive" in done.stdout
    assert "on the same sequences by the same encoder" in done.stdout


def lost(full: dict, other: dict) -> float:
    """Largest quality loss of another model's choice against the full plan's, on the curves of the full plan."""
    points = [
        Point(
            Fraction(p["scaling"]),
            *(p[key] for key in ("target_kbps", "actual_kbps", "second_kbps", "encode_ms")),
            {"mssim": (p["mssim"],)},
        )
        for p in full["points"]
    ]
    curves = draw_curves(points, mean_score("mssim"))
    best, mine = (
        ladder_quality(curves, [Fraction(factor) for factor in m["scaling"]], [c["kbps"] for c in m["crossings"]])
        for m in (full, other)
    )
    return float(np.max((best - mine)[curves.kbps < full["b_full_kbps"]]))


def test_a_mask_keeps_part_of_the_picture_out(clip, tmp_path, cache):
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[: HEIGHT // 2] = 0
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    words = ("camera=front_center", f"sequence={clip}", f"output={tmp_path}", "plan=full", *TINY)
    whole, half = (
        (model(*words, *more, cache=cache), points_of(tmp_path))[1]
        for more in ((), (f"masks.front_center={tmp_path / 'mask.png'}",))
    )
    assert [p["actual_kbps"] for p in whole] == [p["actual_kbps"] for p in half]
    assert all(w["mssim"] != h["mssim"] for w, h in zip(whole, half, strict=True))
    done = model(*words, f"masks.front_center={CHECKOUT / 'README.md'}", cache=cache)
    assert (done.returncode, done.stderr.count("cannot be read as a picture")) == (2, 1)


def test_cameras_of_a_vehicle_are_pooled(clip, tmp_path, cache):
    for name in ("front", "rear", "mast"):
        shutil.copy(clip, tmp_path / f"{name}.mp4")
    words = (
        "vehicle=delivery_robot",
        f"sequence={tmp_path}",
        f"output={tmp_path / 'out'}",
        "pool={ends: [front, rear]}",
    )
    done = model(*words, "plan=full", *TINY, cache=cache)
    assert done.returncode == 0, done.stderr
    assert sorted(path.name for path in (tmp_path / "out").glob("*.yaml")) == ["ends.yaml", "mast.yaml"]
    pooled = read_model(tmp_path / "out" / "ends.model.json")
    assert sorted(pooled["sequences"]) == ["front", "rear"]


# --- bad input --------------------------------------------------------------------------------------------------------


def launch(line: str, path: Path) -> None:
    command = ["gst-launch-1.0", "-q", *line.split(), "!", "filesink", f"location={path}"]
    subprocess.run(command, check=True, timeout=60)


def two_sizes(path: Path) -> None:
    """A stream that changes its size in the middle."""
    parts = []
    for number, size in enumerate(("320,height=192", "160,height=96")):
        part = path.with_name(f"part{number}.ts")
        launch(f"videotestsrc num-buffers=40 ! video/x-raw,width={size},framerate=25/1 ! x264enc ! mpegtsmux", part)
        parts.append(part.read_bytes())
    path.write_bytes(b"".join(parts))


@pytest.mark.parametrize(
    ("name", "content", "expected"),
    [
        ("gone.mp4", None, "no such file"),
        ("/dev/zero", None, "must be a file"),
        ("empty.mp4", b"", "the file is empty"),
        ("noise.mp4", os.urandom(4096), "cannot be read as video"),
        # GStreamer 1.28 leaves out the picture behind a seam, and with it the new size.
        ("two.ts", two_sizes, r"(size changes from 320x192 to 160x96 within|only 7\d of 80 pictures are read)"),
    ],
)
def test_an_invalid_sequence_is_reported(tod, tmp_path, cache, monkeypatch, name, content, expected):
    path = tmp_path / name
    if callable(content):
        content(path)
    elif content is not None:
        path.write_bytes(content)
    monkeypatch.setenv("XDG_CACHE_HOME", cache["XDG_CACHE_HOME"])
    status, out, err = tod("model", "camera=front_center", f"sequence={path}", f"output={tmp_path}")
    assert (status, out) == (2, "")
    line = err.splitlines()[-1]
    assert line.startswith("command line: sequence: ")
    assert re.search(expected, line)


def test_a_clip_whose_video_begins_after_its_sound(tmp_path, cache):
    line = (
        f"matroskamux name=file ! filesink location={tmp_path / 'late.mkv'}"
        " audiotestsrc num-buffers=80 ! audioconvert ! vorbisenc ! file."
        " videotestsrc num-buffers=40 timestamp-offset=100000000 ! video/x-raw,width=320,height=240,framerate=30/1"
        " ! x264enc tune=zerolatency ! h264parse ! file."
    )
    subprocess.run(["gst-launch-1.0", "-q", *line.split()], check=True, timeout=60)
    done = model(*CAMERA, *TINY, f"sequence={tmp_path / 'late.mkv'}", f"output={tmp_path}", cache=cache)
    assert "(4 encoded, 0 known)" in done.stdout, done.stderr


def test_a_short_sequence_is_reported(tmp_path, cache):
    path = tmp_path / "short.mkv"
    launch("videotestsrc num-buffers=9 ! video/x-raw,width=320,height=192,framerate=25/1 ! x264enc ! matroskamux", path)
    done = model("camera=front_center", f"sequence={path}", f"output={tmp_path}", cache=cache)
    assert done.returncode == 2
    assert f"{path}: 9 frames: is too short, at least 25 are needed" in done.stderr


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["bitrates_kbps=[100]"], "study.bitrates_kbps: [100]: must have at least 2 entries"),
        (["bitrates_kbps=[200,100]"], "study.bitrates_kbps: [200, 100]: must be strictly increasing"),
        (
            ["scalings=[0.05,1]"],
            "scalings: 0.05 of 320x192: a side would be under 16 px, the factor must be at least 0.0833",
        ),
        (["metric=mssm"], "did you mean mssim?"),
        (["metric=brisque"], "brisque"),
        (["plan=fast"], "study.plan: 'fast': must be one of adaptive, full"),
        (["pool={all: [front_center, rear]}"], "pool.all: 'rear': no such camera is measured"),
        (["scheduler=tcp://127.0.0.1:1"], "requires workers=dask"),
    ],
)
def test_a_wrong_argument_is_reported(tod, clip, tmp_path, cache, monkeypatch, words, expected):
    monkeypatch.setenv("XDG_CACHE_HOME", cache["XDG_CACHE_HOME"])
    status, _, err = tod("model", "camera=front_center", f"sequence={clip}", f"output={tmp_path / 'out'}", *words)
    assert status == 2
    assert expected in err
    assert list(tmp_path.glob("out/*")) == []


def test_a_camera_of_the_users_own_is_not_overwritten(tod, clip, tmp_path):
    own = tmp_path / "front_center.yaml"
    own.write_text("width_px: 1920\n")
    status, _, err = tod("model", "camera=front_center", f"sequence={clip}", f"output={tmp_path}")
    assert status == 2
    assert err == (
        f"command line: output: '{own}': exists and was not written by tod-runner model; choose another directory\n"
    )
    assert own.read_text() == "width_px: 1920\n"
    status, _, err = tod("model", "camera=front_center", f"sequence={clip}", "output=/proc/models")
    assert (status, err.count("command line: output: '/proc/models': cannot be written to: ")) == (2, 1)


def test_a_missing_tool_and_a_missing_scheduler_are_reported(clip, tmp_path, cache, monkeypatch):
    monkeypatch.setattr("runner.rate_quality.workers.SCHEDULER_S", 1)
    words = ("camera=front_center", f"sequence={clip}", f"output={tmp_path / 'out'}", *SMALL)
    done = model(*words, "metric=vmaf", cache={**cache, "TOD_FFMPEG": "/bin/true"})
    assert done.returncode == 1
    assert "libvmaf" in done.stderr
    done = model(*words, "workers=dask", "scheduler=tcp://127.0.0.1:1", cache=cache)
    assert done.returncode == 1
    assert "the Dask scheduler tcp://127.0.0.1:1 does not answer" in done.stderr


def test_a_full_disk_loses_nothing_that_is_finished(clip, tmp_path, cache):
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=8k", "tmpfs", str(disk)]
    if os.geteuid() or subprocess.run(mount, check=False, capture_output=True).returncode:
        pytest.skip("mounting needs root")
    words = ("camera=front_center", f"sequence={clip}", f"output={disk}", "plan=full", *TINY)
    try:
        done = model(*words, cache=cache, figures=True)
        assert done.returncode == 1
        assert f"{disk}/front_center." in done.stderr
        assert "no space left on device" in done.stderr
        assert [path.name for path in disk.iterdir() if path.name.startswith(".")] == []
    finally:
        subprocess.run(["umount", "-l", str(disk)], check=True)
    assert "(0 encoded, 4 known)" in model(*words, cache=cache).stdout


@pytest.mark.soak
@pytest.mark.skipif(not CLIPS, reason="no recorded clips next to the project")
def test_on_a_recorded_drive_each_factor_wins_a_range(tmp_path, cache):
    whole = next(path for path in CLIPS if path.name == "forward_highway_day_540p25_A.mp4")
    clip = tmp_path / "highway.mp4"
    subprocess.run(["ffmpeg", "-v", "error", "-t", "3", "-i", whole, "-c", "copy", clip], check=True)
    done = model("camera=front_center", f"sequence={clip}", f"output={tmp_path}", cache=cache)
    assert done.returncode == 0, done.stderr
    document = read_model(tmp_path / "front_center.model.json")
    assert len(document["scaling"]) >= 3
    assert len(document["points"]) <= 80  # of 160, with those for smaller screens
    assert document["b_min_kbps"] == sorted(document["b_min_kbps"])


def test_fewer_pictures_a_second_are_compared_at_the_same_bitrates(clip, tmp_path, cache):
    """Each is better than one of all, but in this street, which moves, what is held is not."""
    output = tmp_path / "models"
    words = (*CAMERA, f"sequence={clip}", f"output={output}", "screens=[]", "scalings=[0.5]")
    first = model(*words, "bitrates_kbps=[100,200]", "fps=[12.5,5]", cache=cache, figures=True)
    assert "25 Hz" in first.stdout
    assert "12.5 Hz" in first.stdout
    assert "5 Hz" in first.stdout
    assert (output / "front_center.png").stat().st_size > 20_000
    document = read_model(output / "front_center.model.json")
    all_of_them, half, fifth = document["rates"]
    assert [each["fps"] for each in document["rates"]] == [25, 12.5, 5]
    assert all_of_them["delivered"] == all_of_them["held"]
    for number in range(len(all_of_them["kbps"])):
        assert fifth["delivered"][number] > half["delivered"][number] > all_of_them["delivered"][number]
        assert fifth["held"][number] < half["held"][number] < half["delivered"][number]
    conf = tmp_path / "own" / "cameras"
    conf.mkdir(parents=True)
    shutil.copy(output / "front_center.yaml", conf / "measured.yaml")
    vehicle = configuration(["cameras@cameras.front_center=measured"], conf.parent, runnable=False).vehicle()
    rates = vehicle.cameras["front_center"].rate_quality.rates
    assert list(rates) == [25, Fraction(25, 2), 5]
    assert rates[Fraction(5)].held[0] == (100, pytest.approx(fifth["held"][0], abs=1e-4))
    again = model(*words, "bitrates_kbps=[100,200]", "fps=[12.5,5]", "metric=psnr", cache=cache)
    assert again.returncode == 2
    assert "fps: psnr: needs metric=mssim" in again.stderr
