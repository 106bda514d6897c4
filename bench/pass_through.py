"""An IP camera passed on, beside the same camera decoded and encoded again: alternating drives of the demo.

  python bench/pass_through.py CLIP.mp4 [--pairs 3] [--seconds 20] [--fps 15]

The clip, repeated, is served as an IP camera, which encodes it in H.264 with 4 Mbit/s as it plays, a key picture a
second. Processor time is that of the vehicle's process; latency is from the arrival at the
vehicle to the operator, and to its decoder. Quality is that of the delivered pictures compared with the camera's own,
at the camera's bitrate. A viewer's first picture is the first one that is not marked as damaged: of the first viewer,
for whom the camera is connected, and of later ones. The last rows are of a link of half the camera's rate, also with a
command that sets the camera's bitrate. Run it on an idle machine.
"""

from __future__ import annotations

import needs_tests  # noqa: F401 (first: makes parts of the tests importable)  # isort: skip

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray
from table import Row, show, spread
from told_camera import ToldCamera, told_camera
from usage import processor_s

from rig import children_named, streaming, until
from runner.apply import OperatorSide
from runner.core.commands import Command
from runner.drive.read import read_drive
from runner.drive.series import series
from runner.drive.statistics import CameraStatistics, statistics
from runner.graph import Plan
from runner.h264.access_unit import AccessUnit
from runner.rate_quality.metrics.mssim import meter

WAYS = {"decoded and encoded again": "graph=h264_rtsp", "passed on": "graph=pass_through"}
SETTLE_S = 4.0
KBPS, WIDTH, HEIGHT = 4000, 1280, 720  # of the camera
LATER = 10  # viewers who join while another watches
CAMERA = (
    "filesrc location={clip} ! decodebin force-sw-decoders=true ! videoconvert ! videoscale ! videorate"
    " ! video/x-raw,format=I420,width={width},height={height},framerate={fps}/1 ! identity sync=true"
    " ! x264enc name=encoder tune=zerolatency speed-preset=superfast bitrate={kbps} key-int-max={fps}"
    " ! rtph264pay name=pay0 pt=96"
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clip", type=Path)
    parser.add_argument("--pairs", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=20)
    parser.add_argument("--fps", type=int, default=15)
    options = parser.parse_args()
    found: dict[str, list[tuple[float, CameraStatistics]]] = {way: [] for way in WAYS}
    half: dict[str, list[CameraStatistics]] = {}
    other: list[Row] = []
    with tempfile.TemporaryDirectory() as directory:
        sizes = {"width": WIDTH, "height": HEIGHT, "kbps": KBPS, "fps": options.fps}
        media = CAMERA.format(clip=repeated(options.clip, Path(directory) / "clip.mp4"), **sizes)
        for number in range(options.pairs):
            for way, word in WAYS.items():
                with told_camera(media) as camera:
                    out = Path(directory) / f"{number}-{word.partition('=')[2]}"
                    found[way].append(drive(camera, [word], options, out))
                print(f"pair {number + 1}: {way}", file=sys.stderr)
        for way, word in WAYS.items():
            with told_camera(media) as camera:
                other += viewed(way, camera, word, options)
        for number in range(options.pairs):
            for way, words in {**{way: [word] for way, word in WAYS.items()}, "bitrate set": SETTABLE}.items():
                with told_camera(media) as camera:
                    out = Path(directory) / f"half-{number}-{way}"
                    filled = [word.format(http=camera.http, kbps="{kbps}") for word in words]
                    half.setdefault(way, []).append(drive(camera, [*filled, *HALF], options, out)[1])
                print(f"half the rate {number + 1}: {way}", file=sys.stderr)
    drives = [row for way, drives in found.items() for row in rows(way, drives)]
    show([*drives, *other, *(row for way, each in half.items() for row in of_half(way, each))])


def repeated(clip: Path, into: Path) -> Path:
    """The clip again and again, so that no drive meets its end."""
    line = ["ffmpeg", "-v", "error", "-stream_loop", "-1", "-i", str(clip), "-t", "300", "-an", "-c", "copy", str(into)]
    subprocess.run(line, check=True)
    return into


SETTABLE = [
    "graph=pass_through",
    'graph.knobs.bitrate=[{{command: [curl, -fsS, "{http}/encoder/bitrate/{kbps}"], every_s: 0.5}}]',
]
HALF = ["link=relay", f"link.kbps={KBPS // 2}", "link.share=1"]


def drive(
    camera: ToldCamera, words: list[str], options: argparse.Namespace, out: Path
) -> tuple[float, CameraStatistics]:
    """Cores that the vehicle's process uses, and what the operator's side logs."""
    words = [f"camera={camera.rtsp}", *words, f"fps_max={options.fps}", "page.serve=false", f"log={out}"]
    words += [f"duration_s={options.seconds + SETTLE_S}", "pqos=constant", "pqos.kbps=20000"]
    with subprocess.Popen([sys.executable, "-m", "runner", "demo", *words], stdout=subprocess.DEVNULL) as demo:
        (vehicle,) = until(lambda: children_named(demo.pid, "runner\0vehicle\0"))
        time.sleep(SETTLE_S)
        used_s, began = processor_s(vehicle), time.monotonic()
        time.sleep(options.seconds - 2)
        cores = (processor_s(vehicle) - used_s) / (time.monotonic() - began)
    return cores, statistics(series(read_drive(out))).cameras["camera"]


def rows(way: str, drives: list[tuple[float, CameraStatistics]]) -> list[Row]:
    return [
        spread(f"{way}: cores", [cores for cores, _ in drives], ""),
        spread(f"{way}: arrival at the operator, median", [camera.arrival.median for _, camera in drives], "ms"),
        spread(f"{way}: decoded, median", [camera.decode.median for _, camera in drives], "ms"),
        spread(f"{way}: kbit/s", [camera.kbps for _, camera in drives], ""),
        spread(f"{way}: frames", [camera.frames for _, camera in drives], ""),
    ]


def of_half(way: str, drives: list[CameraStatistics]) -> list[Row]:
    """On a link of half the camera's rate."""
    frozen = [100 * camera.frozen for camera in drives]
    return [
        spread(f"half the rate, {way}: kbit/s", [camera.kbps for camera in drives], ""),
        spread(f"half the rate, {way}: arrival at the operator, median", [c.arrival.median for c in drives], "ms"),
        spread(f"half the rate, {way}: frozen", frozen, "% of the time"),
        spread(f"half the rate, {way}: damaged", [100 * camera.damaged for camera in drives], "% of the frames"),
    ]


def viewed(way: str, camera: ToldCamera, word: str, options: argparse.Namespace) -> list[Row]:
    """How long viewers wait for their first whole picture, and how much of its quality the pictures keep."""
    robot = ("vehicle=one_camera", "source=rtsp", word, f"fps_max={options.fps}", f'source.address="{camera.rtsp}"')
    sizes = (f"cameras.camera.width_px={WIDTH}", f"cameras.camera.height_px={HEIGHT}")
    with streaming(*robot, *sizes, cameras=("camera",)) as (side, _, (plan,), _), tempfile.TemporaryDirectory() as into:
        knobs = {"sending": True, "size": (WIDTH, HEIGHT), "bitrate": KBPS}
        side.turn([Command("camera", knob, value) for knob, value in knobs.items()])
        with Viewer(plan) as first:
            waited = [first.first_whole_s()]
            for number in range(LATER):
                time.sleep(0.37)  # at another time between two key pictures
                with Viewer(plan) as later:
                    while later.first is None:
                        side.send_key_frames(["camera"])  # as the vehicle does while an operator reports damage
                        time.sleep(0.05)
                    waited.append(later.first_whole_s())
                print(f"{way}: viewer {number + 2} after {waited[-1]:.2f} s", file=sys.stderr)
            own, since = Path(into) / "own.h264", len(first.units)
            line = ["ffmpeg", "-v", "error", "-rtsp_transport", "tcp", "-i", camera.rtsp, "-t", "10", "-c", "copy"]
            subprocess.run([*line, str(own)], check=True)
            delivered = Path(into) / "delivered.h264"
            delivered.write_bytes(b"".join(first.units))
        scores = quality(own, delivered, since)
    return [
        Row(f"{way}: first picture of the first viewer", waited[0], "s"),
        spread(f"{way}: of later viewers", waited[1:], "s"),
        Row(
            f"{way}: MSSIM against the camera's own pictures",
            float(np.mean(scores)),
            "",
            note=f"{len(scores)} pictures",
        ),
    ]


class Viewer:
    """An operator's receiver: what it receives, and when its first picture without damage came."""

    def __init__(self, plan: Plan) -> None:
        self.units: list[bytes] = []
        self.first: float | None = None
        self._began = time.monotonic()
        self._side = OperatorSide([plan], lambda *_: None, self._on_unit)

    def _on_unit(self, _camera: str, unit: AccessUnit) -> None:
        if self.first is None and not unit.damaged:
            self.first = time.monotonic()
        if self.first is not None:
            self.units.append(unit.data)

    def first_whole_s(self) -> float:
        until(lambda: self.first is not None)
        assert self.first is not None
        return self.first - self._began

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._side.stop()


def quality(own: Path, delivered: Path, since: int) -> list[float]:
    """MSSIM of each delivered picture, compared with that of the camera's own which is most like it.

    since  the number of the first one that may be among the camera's own
    """
    references = list(decoded(own))
    small = np.stack([each[::8, ::8].astype(np.int16) for each in references])
    scores = meter((WIDTH, HEIGHT), Fraction(1), 1, None)
    for number, picture in enumerate(decoded(delivered)):
        apart = np.abs(small - picture[::8, ::8].astype(np.int16)).mean(axis=(1, 2))
        nearest = int(apart.argmin())
        if number >= since and 0 < nearest < len(references) - 1:  # else its own may not be among them
            scores.add(number, references[nearest], picture)
    return list(scores.close().values())


def decoded(path: Path) -> Iterator[NDArray[np.uint8]]:
    """Luma of the pictures of a file."""
    line = ["ffmpeg", "-v", "quiet", "-f", "h264", "-i", str(path), "-fps_mode", "passthrough", "-f", "rawvideo"]
    with subprocess.Popen([*line, "-pix_fmt", "yuv420p", "-"], stdout=subprocess.PIPE) as decoder:
        assert decoder.stdout
        while data := decoder.stdout.read(WIDTH * HEIGHT * 3 // 2):
            yield np.frombuffer(data[: WIDTH * HEIGHT], np.uint8).reshape(HEIGHT, WIDTH)


if __name__ == "__main__":
    main()
