"""Time that a rate-quality model takes, against the obvious alternatives, as ratios in one run.

  python bench/model.py CLIP

Whole processes are timed, with an empty cache, the adaptive plan of `tod-runner model` first. It is compared with the
full plan; the full grid with two ffmpeg processes for each point, one that scales and encodes, one that decodes, scales
up and compares with its ssim filter; and the full grid with scikit-image's MSSIM on every frame, extrapolated from one
point and some frames. It also prints the factors that each plan chooses.
"""

from __future__ import annotations

import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from runner.configuration.files import conf_directories
from runner.configuration.yaml_file import load_file

STUDY = load_file(conf_directories(None)[0] / "study" / "paper.yaml")
X264 = "tune=zerolatency:intra-refresh=1:threads=1"
SAMPLED_FRAMES = 12


def main() -> None:
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    clip = Path(sys.argv[1]).resolve()
    with tempfile.TemporaryDirectory() as directory:
        model(clip, Path(directory), "full", "scalings=[0.5]", "bitrates_kbps=[200,400]")  # libraries, fonts, registry
        adaptive, adaptive_s = model(clip, Path(directory), "adaptive")
        full, full_s = model(clip, Path(directory), "full")
        print(f"adaptive plan: {adaptive_s:.1f} s, {len(adaptive['points'])} encodings")
        print(f"full plan: {full_s:.1f} s, {len(full['points'])} encodings: {full_s / adaptive_s:.1f} times as long")
        print(f"memory: {memory_mb():.0f} MB at most in either")
        for found, name in ((adaptive, "adaptive"), (full, "full")):
            print(
                f"  {name}: factors {found['scaling']} from {found['b_min_kbps']} kbit/s, b_full {found['b_full_kbps']}"
            )
        spent = two_processes(clip, Path(directory))
        print(f"two ffmpeg processes per point: {spent:.1f} s: {spent / adaptive_s:.1f} times as long")
        spent = scikit_image(clip, Path(directory))
        print(f"scikit-image on every frame, extrapolated: {spent:.0f} s: {spent / adaptive_s:.0f} times as long")


def model(clip: Path, directory: Path, plan: str, *words: str) -> tuple[dict[str, Any], float]:
    """A model file, and the seconds that it took with no point in the cache."""
    output, cache = directory / plan, directory / "cache"
    shutil.rmtree(cache / "tod-runner", ignore_errors=True)
    words = ("camera=front_center", f"sequence={clip}", f"output={output}", f"plan={plan}", "screens=[]", *words)
    began = time.perf_counter()
    run([sys.executable, "-m", "runner", "model", *words], env={**os.environ, "XDG_CACHE_HOME": str(cache)})
    spent = time.perf_counter() - began
    return json.loads((output / "front_center.model.json").read_text()), spent


def memory_mb() -> float:
    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024


def two_processes(clip: Path, directory: Path) -> float:
    """Seconds for the full grid as a script would do it, one point at a time; ffmpeg uses all cores that it can."""
    began = time.perf_counter()
    for factor in STUDY["scalings"]:
        for kbps in STUDY["bitrates_kbps"]:
            encode(clip, directory / "point.mp4", factor, kbps)
            graph = "[0:v][1:v]scale2ref=flags=bicubic[up][reference];[up][reference]ssim"
            run(
                ["ffmpeg", "-v", "error", "-i", directory / "point.mp4", "-i", clip, "-lavfi", graph, "-f", "null", "-"]
            )
    return time.perf_counter() - began


def encode(clip: Path, output: Path, factor: float, kbps: int) -> None:
    scale = f"scale=trunc(iw*{factor}/2)*2:trunc(ih*{factor}/2)*2"
    rate = ["-b:v", f"{kbps}k", "-maxrate", f"{kbps}k", "-bufsize", f"{max(1, kbps // 16)}k"]
    coder = ["-c:v", "libx264", "-preset", "superfast", "-x264-params", X264, *rate]
    run(["ffmpeg", "-v", "error", "-y", "-i", clip, "-vf", scale, *coder, "-an", output])


def scikit_image(clip: Path, directory: Path) -> float:
    """Seconds for the full grid: a point's encoding and decoding as above, and MSSIM of each of its frames."""
    from skimage.metrics import structural_similarity

    began = time.perf_counter()
    encode(clip, directory / "point.mp4", 0.5, 400)
    original, coded = luma(clip), luma(directory / "point.mp4")
    prepared = time.perf_counter() - began
    size = original[0].shape[::-1]
    began = time.perf_counter()
    for reference, picture in list(zip(original, coded, strict=False))[:SAMPLED_FRAMES]:
        enlarged = cv2.resize(picture, size, interpolation=cv2.INTER_CUBIC)
        structural_similarity(
            reference, enlarged, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=255
        )
    compared = (time.perf_counter() - began) / SAMPLED_FRAMES * len(original)
    return (prepared + compared) * len(STUDY["scalings"]) * len(STUDY["bitrates_kbps"])


def luma(clip: Path) -> list[np.ndarray]:
    """All frames, grey."""
    video, frames = cv2.VideoCapture(str(clip)), []
    while (read := video.read())[0]:
        frames.append(cv2.cvtColor(read[1], cv2.COLOR_BGR2GRAY))
    return frames


def run(command: Sequence[object], **options: Any) -> None:
    subprocess.run([str(word) for word in command], check=True, stdout=subprocess.DEVNULL, **options)


if __name__ == "__main__":
    main()
