"""Processor time, latency and quality of graph options on recorded frames: efforts, scaler methods, threads.

  python bench/options.py CLIP...      five minutes for each clip

The vehicle's elements, from gate to payloader, process raw frames from memory as fast as they can, at half and at full
size. The table gives processor time and wall time per frame (wall time is what one camera adds to the latency on idle
cores) and the change of MSSIM against the unchanged graph, measured by `tod-runner model` at half size and two
bitrates. A second part splits the processor time by element.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from statistics import fmean, median
from typing import Any, NamedTuple

from table import Row, show

from runner.apply import discover
from runner.configuration.config import configuration
from runner.core.commands import KnobValue
from runner.core.model import Camera, Element, Roi
from runner.core.scaling import output_size
from runner.graph import compile_graph, launch
from runner.turning import turn_elements

CAMERA = "front_center"
SCALER, ENCODER = "graph.vehicle.2.properties", "graph.encoder.0.properties"
UNCHANGED = "unchanged"
OPTIONS: Mapping[str, Sequence[str]] = {
    UNCHANGED: (),
    **{f"effort={name}": (f"graph.effort={name}",) for name in ("lowest", "low", "high")},
    **{f"scaler: {name}": (f"+{SCALER}.method={name}",) for name in ("nearest-neighbour", "4-tap", "lanczos")},
    "scaler: two threads": (f"+{SCALER}.n-threads=2",),
    "encoder: two threads, two slices": (f"{ENCODER}.threads=2",),
    **{
        f"encoder: {options}": (f'graph.efforts.medium.options="repeat-headers=0:{options}"',)
        for options in (
            "no-deblock=1",
            "subme=0",
            "aq-mode=0",
            "aq-mode=0:subme=0",
            "aq-mode=0:subme=0:weightp=0",
            "aq-mode=0:subme=0:partitions=none",
        )
    },
}
HALF, FULL = Fraction(1, 2), Fraction(1)
KBPS = 800
STUDY = ("scalings=[0.5]", "bitrates_kbps=[250,800]", "plan=full", "metric_every=4")
RUNS = 3  # of each measurement; the median counts
FEW, MANY = 10, 200  # frames; the shorter run is subtracted: start and end of the process
MEMORY = "/dev/shm"


class Spent(NamedTuple):
    """For one frame, ms."""

    processor: float
    wall: float


class Raw(NamedTuple):
    """Frames of a clip in a file in memory, I420."""

    path: Path
    width: int
    height: int
    frames: int

    @property
    def frame_bytes(self) -> int:
        return self.path.stat().st_size // self.frames

    def source(self, frames: int) -> str:
        read = f"filesrc location={self.path} blocksize={self.frame_bytes} num-buffers={frames}"
        # As the sources state it: without colorimetry, a scaler that crosses 576 lines also converts colours.
        form = f"format=i420 width={self.width} height={self.height} framerate=25/1 colorimetry=bt709"
        return f"{read} ! rawvideoparse {form}"


# --- time -------------------------------------------------------------------------------------------------------------


@contextmanager
def decoded(clip: Path) -> Iterator[Raw]:
    info = discover(clip, "CLIP")
    with tempfile.TemporaryDirectory(dir=MEMORY) as name:
        path = Path(name) / "frames"
        _run(f"filesrc location={clip} ! decodebin ! videoconvert ! video/x-raw,format=I420 ! filesink location={path}")
        luma = -(-info.width // 4) * 4 * -(-info.height // 2) * 2
        chroma = -(-info.width // 8) * 4 * -(-info.height // 2) * 2
        yield Raw(path, info.width, info.height, path.stat().st_size // (luma + chroma))


def elements(raw: Raw, words: Sequence[str], scaling: Fraction, roi: Roi | None = None) -> tuple[Element, ...]:
    """What the vehicle runs for a camera of the clip's size, from its gate to its payloader."""
    setup = configuration(("source=test", *words)).setup()
    camera: Camera = replace(setup.vehicle.cameras[CAMERA], width=raw.width, height=raw.height, native=None, crop=None)
    roi = roi or camera.full_roi
    knobs: dict[str, KnobValue] = {
        "sending": True,
        "roi": roi,
        "size": output_size(roi, scaling),
        "bitrate": KBPS,
    }
    return turn_elements(camera, compile_graph(camera, setup.media).vehicle, knobs)


def spent(raw: Raw, line: str) -> Spent:
    """Time per frame of a line, minus the time for reading."""
    runs = [_slope(raw, f"{line} ! fakesink") for _ in range(RUNS)]
    reading = [_slope(raw, "fakesink") for _ in range(RUNS)]
    return Spent(*(median(run[of] for run in runs) - median(run[of] for run in reading) for of in (0, 1)))


def _slope(raw: Raw, line: str) -> Spent:
    many = min(MANY, raw.frames)
    ends = [_run(f"{raw.source(frames)} ! {line}") for frames in (FEW, many)]
    return Spent(*(1000 * (b - a) / (many - FEW) for a, b in zip(*ends, strict=True)))


def _run(line: str) -> Spent:
    """Processor and wall time of a process, s."""
    began, before = time.monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(f"exec gst-launch-1.0 -q {line}", shell=True, check=True, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return Spent(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, time.monotonic() - began)


# --- quality ----------------------------------------------------------------------------------------------------------


def qualities(clip: Path, words: Sequence[str]) -> Mapping[int, float]:
    """MSSIM by kbit/s."""
    with tempfile.TemporaryDirectory() as name:
        output = Path(name) / "model"
        arguments = (f"camera={CAMERA}", f"sequence={clip}", f"output={output}", *words, *STUDY)
        environment = {**os.environ, "XDG_CACHE_HOME": name}  # an empty cache
        command = [sys.executable, "-m", "runner", "model", *arguments]
        subprocess.run(command, check=True, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        document: dict[str, Any] = json.loads((output / f"{CAMERA}.model.json").read_text())
    return {point["target_kbps"]: point["mssim"] for point in document["points"]}


# --- tables -----------------------------------------------------------------------------------------------------------


def by_option(raw: Raw, clip: Path) -> list[Row]:
    usual, rows, before = qualities(clip, ()), [], Spent(0, 0)
    for name, words in OPTIONS.items():
        half, full = (spent(raw, launch(elements(raw, words, scaling))) for scaling in (HALF, FULL))
        before = half if name == UNCHANGED else before
        changes = [
            value - usual[kbps] for kbps, value in (usual if name == UNCHANGED else qualities(clip, words)).items()
        ]
        note = (
            f"{half.processor / before.processor:.2f} of unchanged; wall {half.wall:.2f} ms; "
            f"full size {full.processor:.2f} ms, wall {full.wall:.2f} ms; "
            f"MSSIM {min(changes):+.4f} to {max(changes):+.4f}, mean {fmean(changes):+.4f}"
        )
        rows.append(Row(name, half.processor, "ms/frame", note=note))
        print(f"{clip.stem}: {name}", file=sys.stderr)
    return rows


def by_element(raw: Raw) -> list[Row]:
    """What each element adds to those before it, at half size; and a crop to the middle half, without scaling."""
    whole, rows, before = elements(raw, (), HALF), [], 0.0
    ends = [number for number, element in enumerate(whole, 1) if element.factory != "capsfilter"]
    for end in ends:
        # The scaler does nothing until caps request a size.
        part = whole[: end + 1] if whole[end - 1].name == "scaler" else whole[:end]
        now = spent(raw, launch(part)).processor
        rows.append(Row(f"element {whole[end - 1].name}", now - before, "ms/frame"))
        before = now
    half = Roi(raw.width // 4, 0, raw.width // 2, raw.height)
    cropped = elements(raw, (), FULL, half)
    crop = [element.name for element in cropped].index("crop") + 1
    rows.append(Row("element crop, to half of the picture", spent(raw, launch(cropped[:crop])).processor, "ms/frame"))
    return rows


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    for clip in [Path(word).resolve() for word in sys.argv[1:]]:
        with decoded(clip) as raw:
            print(f"\n{clip.name}, {raw.width}x{raw.height}, {raw.frames} frames")
            show([*by_option(raw, clip), *by_element(raw)])
