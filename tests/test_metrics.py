"""Metrics of picture quality: exact values, other implementations, published ones; masks, meters, clear messages."""

from __future__ import annotations

import math
import os
import pickle
import signal
import subprocess
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shared_data import shared

from runner.errors import RunError, UserError

pytest.importorskip("cv2")
pytest.importorskip("numba")
import cv2

from runner.rate_quality.metrics import NAMES, VMAF_MODEL, Luma, Mask, Metric, find_metric
from runner.rate_quality.metrics import brisque as brisque_module
from runner.rate_quality.metrics import vmaf as vmaf_module
from runner.rate_quality.metrics.svr import load

FPS = Fraction(25)


def noise(seed: int, height: int = 48, width: int = 64) -> Luma:
    return np.random.default_rng(seed).integers(0, 256, (height, width), dtype=np.uint8)


@cache
def frame(number: int = 0) -> Luma:
    """Luma of a recorded drive, 1280x720."""
    clip = cv2.VideoCapture(str(shared("video/forward_highway_day_720p25_B.mp4")))
    for _ in range(number):
        clip.grab()
    return cv2.cvtColor(clip.read()[1], cv2.COLOR_BGR2GRAY)


def blurred(luma: Luma, factor: float = 0.5) -> Luma:
    """The output of a lane of that scaling factor with a perfect encoder."""
    small = cv2.resize(luma, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    return cv2.resize(small, luma.shape[::-1], interpolation=cv2.INTER_CUBIC)


def score(metric: Metric, reference: Luma, picture: Luma, mask: Mask | None = None) -> float:
    meter = metric.meter(reference.shape[::-1], FPS, 1, mask)
    meter.add(7, reference, picture)
    assert meter.close() is meter.close()
    return meter.close()[7]


PSNR, MSSIM = find_metric("psnr"), find_metric("mssim")


# --- all of them ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name, message",
    [
        ("vmav", "metric: 'vmav': unknown metric, did you mean vmaf?"),
        ("sharp", "metric: 'sharp': unknown metric; expected one of psnr, mssim, vmaf, brisque"),
    ],
)
def test_unknown_name(name: str, message: str) -> None:
    with pytest.raises(UserError) as raised:
        find_metric(name)
    assert str(raised.value) == message


@pytest.mark.slow
@pytest.mark.parametrize("metric", [PSNR, MSSIM])
def test_metric_is_sane(metric: Metric) -> None:
    low, high = metric.bounds
    assert low < metric.good < high and 0 < metric.tolerance < high - low and metric.name in NAMES
    assert pickle.loads(pickle.dumps(metric)) == metric
    assert score(pickle.loads(pickle.dumps(metric)), noise(0), noise(1)) == score(metric, noise(0), noise(1))


@pytest.mark.parametrize("metric", [PSNR, MSSIM])
def test_scores_belong_to_frames(metric: Metric) -> None:
    meter = metric.meter((64, 48), FPS, 5)
    for number in (3, 8, 13):
        meter.add(number, noise(0), noise(number))
    assert meter.close() == {number: score(metric, noise(0), noise(number)) for number in (3, 8, 13)}


@pytest.mark.parametrize("metric", [PSNR, MSSIM])
def test_crop_scores_as_its_copy(metric: Metric) -> None:
    whole, seen = noise(0, 80, 90), noise(1, 80, 90)
    crop = np.s_[10:60, 7:83]
    assert score(metric, whole[crop], seen[crop]) == score(metric, whole[crop].copy(), seen[crop].copy())


@pytest.mark.parametrize("metric", [PSNR, MSSIM])
def test_wrong_picture(metric: Metric) -> None:
    meter = metric.meter((64, 48), FPS)
    for wrong, message in (
        (noise(0, 48, 63), r"picture of uint8 \(48, 63\), must be uint8 \(48, 64\)"),
        (noise(0).astype(np.uint16), r"picture of uint16 \(48, 64\), must be uint8 \(48, 64\)"),
    ):
        with pytest.raises(ValueError, match=message):
            meter.add(0, noise(0), wrong)
    with pytest.raises(ValueError, match=r"mask of bool \(48, 63\), must be bool \(48, 64\)"):
        metric.meter((64, 48), FPS, 1, np.ones((48, 63), np.bool_))


def test_mask_without_pixels() -> None:
    mask = np.zeros((48, 64), np.bool_)
    with pytest.raises(UserError, match=r"^mask: no pixel counts$"):
        PSNR.meter((64, 48), FPS, 1, mask)
    mask[:5] = mask[:, :5] = mask[-5:] = mask[:, -5:] = True
    with pytest.raises(UserError, match=r"^mask: no pixel that is 5 px or more from the border counts$"):
        MSSIM.meter((64, 48), FPS, 1, mask)


def test_too_small() -> None:
    assert score(MSSIM, noise(0, 11, 11), noise(0, 11, 11)) == pytest.approx(1)
    with pytest.raises(UserError, match=r"^size: 64x10: mssim needs at least 11x11 px$"):
        MSSIM.meter((64, 10), FPS)


# --- PSNR -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("difference, decibel", [(1, 48.1308036), (10, 28.1308036), (255, 0)])
def test_psnr_of_a_constant_difference(difference: int, decibel: float) -> None:
    dark = np.zeros((1080, 1920), np.uint8)
    assert score(PSNR, dark, dark + np.uint8(difference)) == pytest.approx(decibel, abs=1e-7)


def test_psnr_ends_at_100_db() -> None:
    assert score(PSNR, noise(0), noise(0)) == 100
    almost = np.zeros((2000, 2000), np.uint8)
    almost[0, 0] = 1
    assert score(PSNR, 0 * almost, almost) == 100


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1), st.integers(1, 40), st.integers(1, 40))
def test_psnr_is_its_definition(seed: int, height: int, width: int) -> None:
    x, y = noise(seed, height, width), noise(seed + 1, height, width)
    mask = np.random.default_rng(seed).random((height, width)) < 0.5
    mask[0, 0] = True
    for counting in (None, mask):
        squares = np.square(x.astype(float) - y)[... if counting is None else counting]
        expected = 10 * math.log10(255**2 / squares.mean()) if squares.any() else 100
        assert score(PSNR, x, y, counting) == pytest.approx(min(100, expected), abs=1e-9)


# --- MSSIM ------------------------------------------------------------------------------------------------------------


def reference_map(x: Luma, y: Luma) -> tuple[float, Any]:
    """MSSIM and the map of SSIM by scikit-image, configured like Wang's code."""
    skimage = pytest.importorskip("skimage.metrics")
    options: Any = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 255}
    mean, found = skimage.structural_similarity(x, y, full=True, **options)
    return float(mean), found


@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1), st.integers(11, 60), st.integers(11, 60), st.integers(0, 255))
def test_mssim_of_noise(seed: int, height: int, width: int, strength: int) -> None:
    x = noise(seed, height, width)
    y = np.clip(x + np.random.default_rng(seed).normal(0, strength, x.shape), 0, 255).astype(np.uint8)
    assert score(MSSIM, x, y) == pytest.approx(reference_map(x, y)[0], abs=2e-6)
    assert score(MSSIM, x, y) == pytest.approx(score(MSSIM, y, x), abs=1e-6)
    assert score(MSSIM, x, x) == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("factor", [0.125, 0.5, 0.75])
def test_mssim_of_a_drive(factor: float) -> None:
    x, y = frame(10), blurred(frame(10), factor)
    assert score(MSSIM, x, y) == pytest.approx(reference_map(x, y)[0], abs=1e-6)


def test_mssim_where_float32_is_coarsest() -> None:
    """Black and white with a little noise: squares less grey are large, variances small."""
    for x in (np.zeros((120, 160), np.uint8), np.full((120, 160), 255, np.uint8)):
        y, z = (np.clip(x + noise(seed, 120, 160) % 5 - 2.0, 0, 255).astype(np.uint8) for seed in (1, 2))
        for a, b in ((x, y), (y, z), (x, 255 - x), (y, y)):
            assert score(MSSIM, a, b) == pytest.approx(reference_map(a, b)[0], abs=2e-6)


def test_mssim_with_a_mask() -> None:
    x, y = frame(0), blurred(frame(0))
    down, right = np.mgrid[:720, :1280]
    mask = np.hypot(down - 360, right - 640) < 500  # the circle of a fisheye
    inside = mask[5:-5, 5:-5]
    expected = reference_map(x, y)[1][5:-5, 5:-5][inside].mean()
    assert score(MSSIM, x, y, mask) == pytest.approx(expected, abs=1e-6)
    assert score(MSSIM, x, y, np.ones_like(mask)) == score(MSSIM, x, y)


# --- VMAF -------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def vmaf() -> Metric:
    try:
        return find_metric("vmaf")
    except RunError as error:
        pytest.skip(str(error))


def score_files(reference: Path, picture: Path, size: tuple[int, int], pixel_format: str) -> list[float]:
    """Score of each picture of a raw video; pixel_format of both files, as ffmpeg names it."""
    tool = vmaf_module.find_tool()
    layout = vmaf_module.picture_format(size, pixel_format, Fraction(25))
    inputs = [[*layout, "-i", str(path.resolve())] for path in (picture, reference)]
    with TemporaryDirectory() as name, (Path(name) / vmaf_module.STDERR_FILE).open("w") as stderr:
        words = vmaf_module.command(tool.exe, inputs, VMAF_MODEL, 1)
        status = subprocess.run(words, check=False, cwd=name, stdout=subprocess.DEVNULL, stderr=stderr).returncode
        return list(vmaf_module.read_log(Path(name), status).by_picture.values())


def test_vmaf_of_the_published_pair(vmaf: Metric) -> None:
    reference, distorted = (shared(f"reference/sparks_{which}_480x270_yuv420p10le.yuv") for which in ("ref", "dis"))
    for picture, published in ((distorted, 97.9006316), (reference, 98.4716976)):
        scores = score_files(reference, picture, (480, 270), "yuv420p10le")
        assert len(scores) == 5 and np.mean(scores) == pytest.approx(published, abs=1e-4)


def test_vmaf_states_its_identity(vmaf: Metric) -> None:
    tool = vmaf_module.find_tool()
    assert vmaf.identity.startswith("vmaf of luma, vmaf_v0.6.1, 8 bit, libvmaf ")
    assert vmaf.identity.endswith(f", ffmpeg {tool.version}")
    assert vmaf.every_frame and vmaf.higher_is_better and vmaf.bounds[0] < vmaf.good < vmaf.bounds[1]
    assert pickle.loads(pickle.dumps(vmaf)) == vmaf


@pytest.mark.parametrize("width, height", [(320, 180), (161, 91)])
def test_vmaf_of_pipes_is_that_of_files(vmaf: Metric, tmp_path: Path, width: int, height: int) -> None:
    crop = np.s_[300 : 300 + height, 400 : 400 + width]
    pairs = [(frame(n)[crop], blurred(frame(n), 0.25)[crop]) for n in range(4)]
    chroma = bytes([128]) * (2 * ((width + 1) // 2) * ((height + 1) // 2))
    for name, which in (("reference", 0), ("picture", 1)):
        (tmp_path / name).write_bytes(b"".join(pair[which].tobytes() + chroma for pair in pairs))
    files = tmp_path / "reference", tmp_path / "picture"
    expected = score_files(*files, (width, height), "yuv420p")
    meter = vmaf.meter((width, height), FPS)
    for number, pair in enumerate(pairs):
        meter.add(10 + number, *pair)
    assert meter.close() == dict(zip(range(10, 14), expected, strict=True))
    assert max(expected) < 100 and len(set(expected)) == 4


def test_vmaf_stride_picks_of_the_same_scores(vmaf: Metric) -> None:
    def scores(stride: int) -> dict[int, float]:
        meter = vmaf.meter((640, 360), Fraction(30000, 1001), stride)
        for number in range(8):
            picture = frame(number)[:360, :640]
            meter.add(number, picture, blurred(picture))
        return meter.close()

    every, third = scores(1), scores(3)
    assert list(every) == list(range(8)) and third == {number: every[number] for number in (0, 3, 6)}


def test_vmaf_of_lanes_side_by_side(vmaf: Metric) -> None:
    """From one thread and from several: no process waits for the pipes of another."""
    pictures = [frame(n)[:180, :320] for n in range(6)]

    def lane(number: int) -> dict[int, float]:
        meter = vmaf.meter((320, 180), FPS)
        for n, picture in enumerate(pictures):
            meter.add(n, picture, np.roll(picture, number, 1))
        return meter.close()

    meters = [vmaf.meter((320, 180), FPS) for _ in range(3)]
    for n, picture in enumerate(pictures):
        for number, meter in enumerate(meters):
            meter.add(n, picture, np.roll(picture, number, 1))
    with ThreadPoolExecutor(3) as pool:
        assert list(pool.map(lane, range(3))) == [meter.close() for meter in meters]


@pytest.fixture
def left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], list[str]]:
    """The processes and temporary files of this one that are left."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))

    def found() -> list[str]:
        children = [task.read_text() for task in Path("/proc/self/task").glob("*/children")]
        return [*" ".join(children).split(), *(path.name for path in tmp_path.iterdir() if path.is_dir())]

    return found


def test_vmaf_leaves_nothing_behind(vmaf: Metric, left: Callable[[], list[str]]) -> None:
    before = left()
    for pictures in (0, 2):
        meter = vmaf.meter((64, 48), FPS)
        for number in range(pictures):
            meter.add(number, noise(0), noise(1))
        descriptors = len(os.listdir("/proc/self/fd"))
        assert list(meter.close()) == list(range(pictures)) and meter.close() is meter.close()
        assert len(os.listdir("/proc/self/fd")) == descriptors - 2
        assert left() == before
        with pytest.raises(ValueError, match="ended"):
            meter.add(9, noise(0), noise(1))


@pytest.mark.parametrize("when", ["before add", "before close"])
def test_vmaf_process_that_dies(vmaf: Metric, when: str, left: Callable[[], list[str]]) -> None:
    before = left()
    meter = vmaf.meter((640, 360), FPS)
    big = noise(0, 360, 640)
    meter.add(0, big, big)
    (ffmpeg,) = (name for name in left() if name.isdecimal() and name not in before)
    os.kill(int(ffmpeg), signal.SIGKILL)
    with pytest.raises(RunError) as raised:
        if when == "before add":
            for number in range(1, 20):  # pipes hold a few
                meter.add(number, big, big)
        else:
            meter.close()
    assert str(raised.value) == "ffmpeg failed to score VMAF: status -9"
    assert meter.close() == {} and left() == before


@pytest.fixture
def fake(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], str]:
    """An ffmpeg that has libvmaf and runs the given shell words instead of scoring."""

    def write(words: str, filters: str = " .. libvmaf           VV->V      Calculate the VMAF") -> str:
        exe = tmp_path_factory.mktemp("tool") / "ffmpeg"  # what is known of an earlier one concerns it alone
        exe.write_text(
            f"#!/bin/sh\ncase $2 in\n-filters) echo '{filters}';;\n"
            f"-version) echo 'ffmpeg version 1.2.3 Copyright';;\n*) {words};;\nesac\n"
        )
        exe.chmod(0o755)
        monkeypatch.setenv("TOD_FFMPEG", str(exe))
        vmaf_module.libvmaf_version.cache_clear()
        return str(exe)

    return write


def test_vmaf_reports_why_ffmpeg_ended(fake: Callable[[str], str]) -> None:
    fake("echo '[libvmaf @ 0x1] no memory left' >&2; echo 'Conversion failed!' >&2; exit 3")
    with pytest.raises(RunError, match=r"^ffmpeg failed to score VMAF: no memory left$"):
        find_metric("vmaf")


def test_vmaf_without_scores(fake: Callable[[str], str]) -> None:
    """As libvmaf does with some models when pictures are too small for them: status 0, and no log."""
    read_all = 'for w in "$@"; do case $w in pipe:*) cat /dev/fd/${w#pipe:} >/dev/null & ;; esac; done; wait'
    exe = fake(f"{read_all}; echo 'libvmaf ERROR no feature' >&2")
    meter = vmaf_module.VmafMeter(vmaf_module.Tool(exe, ""), VMAF_MODEL, (64, 48), FPS, 1)
    meter.add(0, noise(0), noise(0))
    with pytest.raises(RunError, match=r"^ffmpeg failed to score VMAF: libvmaf ERROR no feature$"):
        meter.close()


def test_vmaf_gives_up_on_a_process_that_hangs(
    fake: Callable[[str], str], left: Callable[[], list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    before = left()
    monkeypatch.setattr(vmaf_module, "TIMEOUT_S", 0.2)
    exe = fake("exec sleep 60")
    meter = vmaf_module.VmafMeter(vmaf_module.Tool(exe, ""), VMAF_MODEL, (1280, 720), FPS, 1)
    with pytest.raises(RunError, match=r"^ffmpeg has accepted no picture for 0\.2 s$"):
        for number in range(20):
            meter.add(number, noise(0, 720, 1280), noise(0, 720, 1280))
    assert meter.close() == {} and left() == before
    small = vmaf_module.VmafMeter(vmaf_module.Tool(exe, ""), VMAF_MODEL, (64, 48), FPS, 1)
    small.add(0, noise(0), noise(0))
    with pytest.raises(RunError, match=r"^ffmpeg has not ended for 0\.2 s$"):
        small.close()
    assert left() == before


def test_vmaf_without_a_tool(fake: Callable[..., str], monkeypatch: pytest.MonkeyPatch) -> None:
    exe = fake("exit 0", filters=" .. vmafmotion V->V nothing")
    with pytest.raises(RunError) as raised:
        find_metric("vmaf")
    assert (
        str(raised.value)
        == f"TOD_FFMPEG={exe} is not an ffmpeg with libvmaf: install the extra vmaf, see docs/install.md"
    )
    monkeypatch.delenv("TOD_FFMPEG")
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", exe)
    monkeypatch.setenv("PATH", str(Path(exe).parent))
    with pytest.raises(RunError) as raised:
        find_metric("vmaf")
    assert str(raised.value) == "VMAF needs an ffmpeg with libvmaf: install the extra vmaf, see docs/install.md"
    exe = fake("exit 0")
    monkeypatch.chdir(Path(exe).parent)
    monkeypatch.setenv("PATH", str(Path(exe).parent))
    monkeypatch.setenv("TOD_FFMPEG", "./ffmpeg")
    assert vmaf_module.find_tool() == vmaf_module.Tool(exe, "1.2.3")
    monkeypatch.delenv("TOD_FFMPEG")  # it is on the PATH, too
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", "/nowhere")
    assert vmaf_module.find_tool() == vmaf_module.Tool(exe, "1.2.3")


@pytest.mark.parametrize(
    "model, message",
    [
        ("vmaf_v0.6.9", "vmaf_model: 'vmaf_v0.6.9': libvmaf has no such model built in"),
        ("a:path=/b", "vmaf_model: 'a:path=/b': must be the name of a model, such as vmaf_v0.6.1"),
    ],
)
def test_vmaf_without_the_model(vmaf: Metric, model: str, message: str) -> None:
    with pytest.raises(UserError) as raised:
        find_metric("vmaf", vmaf_model=model)
    assert str(raised.value) == message


@pytest.mark.parametrize("model", ["vmaf_v1.0.16_3d0h", "vmaf_v1.0.16_hfr", "vmaf_4k_v2.0.0"])
def test_vmaf_refuses_models_that_score_more_than_luma(model: str) -> None:
    rule = "scores chroma and the encoded size, which are not measured: choose one of version 0, such as vmaf_v0.6.1"
    with pytest.raises(UserError) as raised:
        find_metric("vmaf", vmaf_model=model)
    assert str(raised.value) == f"vmaf_model: {model!r}: {rule}"


# --- BRISQUE ----------------------------------------------------------------------------------------------------------


def slow_features(luma: Luma) -> Any:
    """The 36 features from the equations of the papers: float64, window by taps, shapes by root finding."""
    special, optimize = pytest.importorskip("scipy.special"), pytest.importorskip("scipy.optimize")
    gamma = special.gamma

    def solve(ratio: float) -> float:
        return float(optimize.brentq(lambda a: gamma(2 / a) ** 2 / gamma(1 / a) / gamma(3 / a) - ratio, 0.2, 10))

    def smooth(plane: Any) -> Any:
        taps = np.exp(-(np.arange(-3, 4.0) ** 2) / 2 / (7 / 6) ** 2)
        window = np.outer(taps, taps) / taps.sum() ** 2
        padded = np.pad(plane, 3, "edge")
        height, width = plane.shape
        return sum(window[i, j] * padded[i : i + height, j : j + width] for i in range(7) for j in range(7))

    def half(plane: Any) -> Any:
        for _ in range(2):  # columns, then rows; the cubic of a = -0.75 half way between samples
            padded = np.pad(plane, ((0, 0), (1, 1)), "edge")
            count = plane.shape[1] // 2
            weights = (-0.09375, 0.59375, 0.59375, -0.09375)
            plane = sum(w * padded[:, i : i + 2 * count : 2] for i, w in enumerate(weights)).T
        return plane

    found, plane = [], luma.astype(float)
    for scale in range(2):
        plane = half(plane) if scale else plane
        mean = smooth(plane)
        mscn = (plane - mean) / (np.sqrt(np.maximum(smooth((plane - 128) ** 2) - (mean - 128) ** 2, 0)) + 1)
        mscn[np.abs(mscn) < 1e-4] = 0
        found += [solve(np.abs(mscn).mean() ** 2 / (mscn**2).mean()), (mscn**2).mean()]
        pairs = ((mscn[:, :-1], mscn[:, 1:]), (mscn[:-1], mscn[1:]))
        diagonals = ((mscn[:-1, :-1], mscn[1:, 1:]), (mscn[:-1, 1:], mscn[1:, :-1]))
        for a, b in (*pairs, *diagonals):
            x = a * b
            left, right = (math.sqrt((side**2).mean()) for side in (x[x < 0], x[x > 0]))
            g = left / right
            shape = solve(np.abs(x).mean() ** 2 / (x**2).mean() * (g**3 + 1) * (g + 1) / (g**2 + 1) ** 2)
            beta_left, beta_right = (side * math.sqrt(gamma(1 / shape) / gamma(3 / shape)) for side in (left, right))
            found += [shape, (beta_right - beta_left) * gamma(2 / shape) / gamma(1 / shape), left**2, right**2]
    return np.array(found)


@pytest.mark.slow
def test_brisque_features_of_a_drive() -> None:
    for picture in (frame(0)[-360:, :400], blurred(frame(0))[:180], blurred(noise(3, 180, 240))):
        assert brisque_module.features(picture) == pytest.approx(slow_features(picture), abs=2e-4)


def test_brisque_features_of_artificial_pictures() -> None:
    """Flat pictures and odd sizes give numbers, not warnings."""
    for picture in (np.full((40, 40), 255, np.uint8), np.zeros((14, 14), np.uint8), noise(0, 31, 45)):
        assert np.isfinite(brisque_module.features(picture)).all()


def libsvm_files(directory: Path) -> tuple[Path, Path]:
    """A regression of two vectors: feature 1 from [0, 4], 2 from [-1, 1], 3 a constant; the others from [0, 1]."""
    model, ranges = directory / "allmodel", directory / "allrange"
    model.write_text(
        "svm_type epsilon_svr\nkernel_type rbf\ngamma 0.05\nnr_class 2\ntotal_sv 2\nrho -30.5\nprobA 1.5\nSV\n"
        "12.5 1:0.5 2:-1 36:0.25 \n-7 3:0.75 \n"
    )
    ranges.write_text("x\n-1 1\n1 0 4\n2 -1 1\n3 6 6\n" + "".join(f"{i} 0 1\n" for i in range(4, 37)))
    return model, ranges


def opencv_files(directory: Path) -> tuple[Path, Path]:
    """The same in OpenCV's form."""
    first, second = [0.0] * 36, [0.0] * 36
    first[0], first[1], first[35], second[2] = 0.5, -1.0, 0.25, 0.75
    rows = "".join(f"      - [ {', '.join(map(repr, row))} ]\n" for row in (first, second))
    model, ranges = directory / "model.yml", directory / "range.yml"
    model.write_text(
        "%YAML:1.0\n---\nopencv_ml_svm:\n   format: 3\n   svmType: EPS_SVR\n   kernel:\n      type: RBF\n"
        "      gamma: 5.0000000000000003e-02\n   C: 1024.\n   p: 1.0000000000000001e-01\n"
        "   term_criteria: { epsilon:1.0000000000000000e-03, iterations:1000 }\n   var_count: 36\n   sv_total: 2\n"
        f"   support_vectors:\n{rows}   decision_functions:\n      -\n         sv_count: 2\n         rho: -30.5\n"
        "         alpha: [ 12.5, -7. ]\n"
    )
    low, high = [0, -1, 6, *[0] * 33], [4, 1, 6, *[1] * 33]
    ranges.write_text(
        "%YAML:1.0\n---\nrange: !!opencv-matrix\n   rows: 2\n   cols: 36\n   dt: f\n"
        f"   data: [ {', '.join(f'{value}.' for value in low + high)} ]\n"
    )
    return model, ranges


def test_regression_by_hand(tmp_path: Path) -> None:
    features = np.full(36, 0.5)  # the middle of each range, scaled to 0, except for
    features[:3] = 3, 0.5, 9  # these: 0.5, 0.5 and, as it has no range, 0
    # Squared distances: 1.5^2 + 0.25^2, and 0.5^2 + 0.5^2 + 0.75^2
    expected = 12.5 * math.exp(-0.05 * 2.3125) - 7 * math.exp(-0.05 * 1.0625) + 30.5
    identities = set()
    for files in (libsvm_files(tmp_path), opencv_files(tmp_path)):
        regression = load(*files, 36)
        assert regression(features) == pytest.approx(expected, abs=1e-12)
        identities.add(regression.identity)
    assert len(identities) == 2


@pytest.mark.parametrize("files", [libsvm_files, opencv_files])
def test_brisque_scores_the_picture_alone(files: Callable[[Path], tuple[Path, Path]], tmp_path: Path) -> None:
    model, ranges = files(tmp_path)
    metric = find_metric("brisque", brisque_model=model, brisque_range=ranges)
    expected = load(model, ranges, 36)(brisque_module.features(noise(1)))
    assert 0 < expected < 100
    assert score(metric, noise(0), noise(1)) == score(metric, noise(2), noise(1)) == pytest.approx(expected)
    assert not metric.higher_is_better and not metric.every_frame
    copy = pickle.loads(pickle.dumps(metric))
    assert copy == metric and score(copy, noise(0), noise(1)) == pytest.approx(expected)


@pytest.mark.parametrize("rho, cut", [("-3000", 100), ("3000", 0)])
def test_brisque_is_clipped(tmp_path: Path, rho: str, cut: float) -> None:
    model, ranges = libsvm_files(tmp_path)
    model.write_text(model.read_text().replace("-30.5", rho))
    assert score(find_metric("brisque", brisque_model=model, brisque_range=ranges), noise(0), noise(1)) == cut


@pytest.mark.parametrize(
    "which, old, new, message",
    [
        ("libsvm model", "epsilon_svr", "c_svc", "svm_type: 'c_svc': must be epsilon_svr"),
        ("libsvm model", "rbf", "linear", "kernel_type: 'linear': must be rbf"),
        ("libsvm model", "gamma 0.05\n", "", "gamma: '': must be a finite number"),
        ("libsvm model", "total_sv 2", "total_sv 3", "SV: 2: must have 3 lines, as total_sv states"),
        ("libsvm model", "3:0.75", "37:0.75", "SV 2: '37': must be the number of a feature, 1 to 36"),
        ("libsvm model", "3:0.75", "3:x", "SV 2: 'x': must be a finite number"),
        ("libsvm range", "x\n", "", "[]: must have a line x before the ranges of features"),
        ("libsvm range", "2 -1 1", "2 -1", "line 4: '2 -1': must have 2 numbers, then 3"),
        ("libsvm range", "2 -1 1", "2 -1 nan", "x: 'nan': must be a finite number"),
        ("opencv model", "EPS_SVR", "NU_SVR", "svmType: 'NU_SVR': must be EPS_SVR"),
        ("opencv model", "RBF", "CHI2", "kernel.type: 'CHI2': must be RBF"),
        ("opencv model", "alpha: [ 12.5, -7. ]", "alpha: [ 12.5 ]", "alpha: 1: must have 2 numbers"),
        ("opencv model", "0.25 ]", "0.25, 1.0 ]", "support_vectors: [36, 37]: each must have 36 features"),
        ("opencv model", "rho: -30.5", "rho: many", "rho: 'many': must be a finite number"),
        ("opencv model", "svmType: EPS_SVR", "svmType: [", "is not what OpenCV writes"),
        ("opencv range", "range:", "ranges:", "range: None: must be a matrix of 2 x 36"),
    ],
)
def test_bad_regression(tmp_path: Path, which: str, old: str, new: str, message: str) -> None:
    kind, file = which.split()
    files = (libsvm_files if kind == "libsvm" else opencv_files)(tmp_path)
    broken = files[file == "range"]
    assert old in broken.read_text()
    broken.write_text(broken.read_text().replace(old, new))
    with pytest.raises(UserError) as raised:
        find_metric("brisque", brisque_model=files[0], brisque_range=files[1])
    assert str(raised.value) == f"{broken}: {message}"


def test_brisque_without_files(tmp_path: Path) -> None:
    model, ranges = libsvm_files(tmp_path)
    missing, binary = tmp_path / "missing", tmp_path / "binary"
    binary.write_bytes(bytes([0xFF, 0xFE, 0xFD]))
    regression = "the regression as libsvm's text or OpenCV's brisque_model_live.yml"
    of_features = "the ranges of the features as svm-scale's text or OpenCV's brisque_range_live.yml"
    for given_files, message in (
        ((None, ranges), f"brisque_model: brisque needs a file that you provide, {regression}"),
        ((model, None), f"brisque_range: brisque needs a file that you provide, {of_features}"),
        ((missing, ranges), f"{missing}: no such file or directory"),
        ((model, binary), f"{binary}: is not text"),
    ):
        with pytest.raises(UserError) as raised:
            find_metric("brisque", brisque_model=given_files[0], brisque_range=given_files[1])
        assert str(raised.value) == message


def test_masks_that_are_refused(tmp_path: Path, vmaf: Metric) -> None:
    model, ranges = libsvm_files(tmp_path)
    for metric in (vmaf, find_metric("brisque", brisque_model=model, brisque_range=ranges)):
        with pytest.raises(UserError) as raised:
            metric.meter((64, 48), FPS, 1, np.ones((48, 64), np.bool_))
        assert str(raised.value) == f"mask: {metric.name}: this metric takes no mask; psnr and mssim do"
