"""Recorded clips in place of the eight cameras of the paper's vehicle, at their sizes and one rate, lossless.

  python bench/clips.py CLIPS
  tod-runner model vehicle=tum_q7 fps_max=20 sequence=CLIPS output=MODELS
  python bench/seen.py MODELS OUT --clips CLIPS

The clips are those of the tests (TOD_SHARED_DATA): motorway and a country road by night, surround-view cameras, a car
park from above. Most are smaller than the cameras' pictures and are enlarged as `source=file` does.
"""

from __future__ import annotations

import needs_tests  # noqa: F401 (first: makes parts of the tests importable)  # isort: skip

import argparse
import sys
from pathlib import Path
from subprocess import run

from helpers import setup
from shared_data import SHARED

from runner.graph import shell
from runner.plans import compile_plans

LOSSLESS = "x264enc pass=quant quantizer=0 speed-preset=ultrafast"
FILMED = {
    "front_left": "forward_highway_day_720p25_B.mp4",
    "front_center": "forward_highway_day_540p25_C_lines.mp4",
    "front_right": "forward_highway_day_540p25_A.mp4",
    "rear_center": "forward_road_night_638p30_D_lines.mp4",
    "top_front": "fisheye_static_800p20_cam1.avi",
    "top_left": "overhead_static_432p12_E.mp4",
    "top_right": "overhead_static_432p12_E.mp4",
    "top_rear": "fisheye_static_800p20_cam3.avi",
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path)
    parser.add_argument("--fps", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=8, help="the most of a clip")
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    clips = [f"cameras.{name}.clip={SHARED / 'video' / clip}" for name, clip in FILMED.items()]
    frames = round(options.fps * options.seconds)
    for plan in compile_plans(
        setup("vehicle=tum_q7", "source=file", "recording=x264", f"fps_max={options.fps}", *clips)
    ):
        source = shell(each for each in plan.source if each.name != "pace")
        path = options.output / f"{plan.camera.name}.mkv"
        end = f"identity eos-after={frames + 1} ! {LOSSLESS} ! matroskamux ! filesink location={path}"
        print(path, file=sys.stderr)
        run(["sh", "-c", f"gst-launch-1.0 -q {source} ! {end}"], check=True)


if __name__ == "__main__":
    main()
