"""How sizes of frames depart from bitrate / frame rate: the numbers of `runner/simulation/encoder.py`.

  python bench/frame_sizes.py CLIP...                  minutes for a clip of 30 s; --set graph=openh264_rtsp for others

Encodes each clip with the encoder of the graph at 15 Hz, at four bitrates and sizes. A row for each: mean over the
drive, deviations of means over a second and of single frames, correlation of neighbouring frames; key frames, made by
changes of the picture's size, and the two frames behind them; the frames from a change of bitrate on, to a third and to
three times as much. All in multiples of bitrate / frame rate.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from statistics import fmean, pstdev

import gi
from footage import WAIT, pictures

from runner.configuration.config import configuration
from runner.graph import launch
from runner.lanes import cut
from runner.plans import compile_plans
from runner.turning import assignments, text

gi.require_version("Gst", "1.0")
from gi.repository import Gst  # noqa: E402

FPS, FULL = 15, (960, 520)
CASES = ((100, (240, 130)), (300, (480, 260)), (600, (480, 260)), (1500, (960, 520)))  # kbit/s, px
SWITCH, MOST = 30, 600  # frames between two changes of size, and of a clip
CAMERA = ("vehicle=delivery_robot", f"fps_max={FPS}", "~cameras.rear", "~cameras.mast")
SIZED = ("cameras.front.width_px={}", "cameras.front.height_px={}")
Turns = Mapping[int, tuple[int, tuple[int, int]]]  # by frame: kbit/s, px


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clips", type=Path, nargs="+")
    parser.add_argument("--set", nargs="*", default=[], help="further overrides")
    options = parser.parse_args()
    Gst.init(None)
    words = [*CAMERA, *(word.format(px) for word, px in zip(SIZED, FULL, strict=True)), *options.set]
    (plan,) = compile_plans(configuration(words, runnable=False).setup())
    before, after = cut(plan)
    encoder = Encoder(plan.camera, launch((*before, *after[: [e.name for e in after].index("sent")])))
    print(
        "clip, kbit/s: mean, deviation of seconds, of frames, correlation | first, key, next two | a third | threefold"
    )
    for clip in options.clips:
        frames = pictures(clip, FULL, MOST, FPS)
        for kbps, size in CASES:
            print(f"{clip.stem}, {kbps}: {encoder.row(frames, kbps, size)}", flush=True)


class Encoder:
    """The encoder of a camera, offline."""

    def __init__(self, camera, line: str) -> None:
        self._camera, self._line = camera, line

    def row(self, frames: Sequence[bytes], kbps: int, size: tuple[int, int]) -> str:
        mean, other = kbps * 125 / FPS, (size[0] // 4 * 2, size[1] // 4 * 2)
        steady = [each / mean for each in self.sizes(frames, {0: (kbps, size)})]
        rest = steady[FPS:]
        seconds = [fmean(rest[at : at + FPS]) for at in range(0, len(rest) - FPS + 1, FPS)]
        middle = fmean(rest)
        pairs = sum((a - middle) * (b - middle) for a, b in pairwise(rest))
        correlation = pairs / sum((each - middle) ** 2 for each in rest)
        switches = range(SWITCH, len(frames) - 2, SWITCH)
        turns = {at: (kbps, (other, size)[at // SWITCH % 2 == 0]) for at in switches}
        switched = [each / mean for each in self.sizes(frames, {0: (kbps, size), **turns})]
        keys = [fmean(switched[at + more] for at in switches) for more in range(3)]
        steps = [
            [each / mean / share for each in self.sizes(frames[: 2 * SWITCH], {0: (kbps, size), SWITCH: (new, size)})]
            for share, new in ((1 / 3, kbps // 3), (3, 3 * kbps))
        ]
        parts = (
            [middle, pstdev(seconds), pstdev(rest), correlation],
            [steady[0], *keys],
            *(step[SWITCH : SWITCH + 5] for step in steps),
        )
        return " | ".join(", ".join(f"{each:.2f}" for each in part) for part in parts)

    def sizes(self, frames: Sequence[bytes], turns: Turns) -> list[int]:
        """Bytes of each encoded frame."""
        caps = f"video/x-raw,format=I420,width={FULL[0]},height={FULL[1]},framerate={FPS}/1,pixel-aspect-ratio=1/1"
        pipeline = Gst.parse_launch(
            f"appsrc name=frames format=time caps={caps} ! {self._line} ! h264parse "
            "! video/x-h264,stream-format=byte-stream,alignment=au ! appsink name=encoded sync=false"
        )
        source, sink, found = pipeline.get_by_name("frames"), pipeline.get_by_name("encoded"), []
        for number, data in enumerate(frames):
            for knob, value in zip(("bitrate", "size"), turns.get(number, ()), strict=False):
                for element, key, filled in assignments(self._camera, knob, value):
                    Gst.util_set_object_arg(pipeline.get_by_name(element), key, text(filled))
            if not number:
                pipeline.set_state(Gst.State.PLAYING)
            buffer = Gst.Buffer.new_wrapped(data)
            buffer.pts, buffer.duration = number * Gst.SECOND // FPS, Gst.SECOND // FPS
            source.emit("push-buffer", buffer)
            found.append(sink.emit("try-pull-sample", WAIT).get_buffer().get_size())
        pipeline.set_state(Gst.State.NULL)
        return found


if __name__ == "__main__":
    main()
