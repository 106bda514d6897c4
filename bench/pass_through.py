"""An IP camera passed on, beside the same camera decoded and encoded again: alternating drives of the demo.

  python bench/pass_through.py CLIP.mp4 [--pairs 3] [--seconds 20] [--fps 15]

The clip is served as an IP camera, which encodes it in H.264 as it plays, without B-frames, and ends the stream with
the clip. Processor time is that of the vehicle's process; latency is from the arrival at the vehicle to the operator,
and to its decoder. Run it on an idle machine.
"""

from __future__ import annotations

import needs_tests  # noqa: F401 (first: makes parts of the tests importable)  # isort: skip

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from table import Row, show, spread
from usage import processor_s

from rig import children_named, free_port, ip_camera, until
from runner.drive.read import read_drive
from runner.drive.series import series
from runner.drive.statistics import CameraStatistics, statistics

WAYS = {"decoded and encoded again": "graph=h264_rtsp", "passed on": "graph=pass_through"}
SETTLE_S = 4.0
CAMERA = (
    "filesrc location={clip} ! decodebin force-sw-decoders=true ! videoconvert ! videoscale ! videorate"
    " ! video/x-raw,format=I420,width=1280,height=720,framerate={fps}/1 ! identity sync=true"
    " ! x264enc tune=zerolatency speed-preset=superfast bitrate=4000 key-int-max={fps} ! rtph264pay name=pay0 pt=96"
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clip", type=Path)
    parser.add_argument("--pairs", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=20)
    parser.add_argument("--fps", type=int, default=15)
    options = parser.parse_args()
    found: dict[str, list[tuple[float, CameraStatistics]]] = {way: [] for way in WAYS}
    with tempfile.TemporaryDirectory() as directory:
        media = CAMERA.format(clip=options.clip.resolve(), fps=options.fps)
        for number in range(options.pairs):
            for way, word in WAYS.items():
                with ip_camera(free_port(), media=media) as (address, _):
                    out = Path(directory) / f"{number}-{word.partition('=')[2]}"
                    found[way].append(drive(address, word, options, out))
                print(f"pair {number + 1}: {way}", file=sys.stderr)
    show([row for way, drives in found.items() for row in rows(way, drives)])


def drive(address: str, word: str, options: argparse.Namespace, out: Path) -> tuple[float, CameraStatistics]:
    """Cores that the vehicle's process uses, and what the operator's side logs."""
    words = [f"camera={address}", word, f"fps_max={options.fps}", "page.serve=false", f"log={out}"]
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


if __name__ == "__main__":
    main()
