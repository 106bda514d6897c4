"""Speed of lossless encoders in recording and decoding, and size of their files; docs/models.md quotes it.

python bench/recording.py CLIP ...

The first frames of each clip are decoded into memory beforehand; only the encoder with its muxer, and the demuxer with
its decoder, are timed. It prints the best of three runs, and the processor time per frame, which other processes
disturb less. GStreamer's Matroska muxer does not accept FFVHuff: it is timed without a container, its decoder as the
difference between encoding with and without decoding.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from runner.configuration.config import configuration
from runner.graph import launch
from runner.gst import Gst
from runner.gst.caps import structure

FRAMES = 60
RUNS = 3


class Spent(NamedTuple):
    seconds: float
    processor_s: float

    def __sub__(self, other: Spent) -> Spent:  # type: ignore[override]
        return Spent(self.seconds - other.seconds, self.processor_s - other.processor_s)

    def per_frame(self, frames: int) -> str:
        return f"{frames / self.seconds:5.0f} fps {1000 * self.processor_s / frames:5.1f} ms"


def play(line: str) -> Spent:
    pipeline = Gst.parse_launch(line)
    began, processor = time.perf_counter(), time.process_time()
    pipeline.set_state(Gst.State.PLAYING)
    message = pipeline.get_bus().timed_pop_filtered(Gst.CLOCK_TIME_NONE, Gst.MessageType.EOS | Gst.MessageType.ERROR)
    spent = Spent(time.perf_counter() - began, time.process_time() - processor)
    pipeline.set_state(Gst.State.NULL)
    if message.type == Gst.MessageType.ERROR:
        raise RuntimeError(message.parse_error()[0].message)
    return spent


def best(line: str) -> Spent:
    return min(play(line) for _ in range(RUNS))


def decode(clip: Path, raw: Path) -> tuple[int, int]:
    """The first frames of a clip as bare I420; returns their size in px."""
    sized = "videoconvert ! videoscale ! video/x-raw,format=I420,pixel-aspect-ratio=1/1"
    pipeline = Gst.parse_launch(
        f'filesrc location="{clip}" ! decodebin ! {sized} ! identity name=size eos-after={FRAMES + 1} '
        f'! filesink location="{raw}"'
    )
    pipeline.set_state(Gst.State.PLAYING)
    pipeline.get_bus().timed_pop_filtered(Gst.CLOCK_TIME_NONE, Gst.MessageType.EOS | Gst.MessageType.ERROR)
    caps = structure(pipeline.get_by_name("size").get_static_pad("src").get_current_caps())
    pipeline.set_state(Gst.State.NULL)
    return caps.get_int("width")[1], caps.get_int("height")[1]


def measure(name: str, encode: str, source: str, raw: Path, frame_bytes: int, *, contained: bool = True) -> None:
    file, again = raw.with_suffix(".mkv"), raw.with_suffix(".again")
    frames = raw.stat().st_size // frame_bytes
    encoding = best(f"{source} ! {encode} ! filesink location={file}")
    reader = f"filesrc location={file} ! matroskademux ! decodebin" if contained else f"{source} ! {encode} ! decodebin"
    decoding = best(f"{reader} ! fakesink")
    if not contained:
        decoding = decoding - best(f"{source} ! {encode} ! fakesink")
    play(f"{reader} ! video/x-raw,format=I420 ! filesink location={again}")
    exact = "bit exact" if again.read_bytes() == raw.read_bytes() else "NOT EXACT"
    share = file.stat().st_size / raw.stat().st_size
    print(f"  {name:10} record {encoding.per_frame(frames)}   decode {decoding.per_frame(frames)}   "
          f"{share:.2f} of raw   {exact}")  # fmt: skip


def main() -> None:
    candidates = {
        name: launch(configuration([f"recording={name}"], runnable=False).setup().recording.elements)
        for name in ("x264", "ffv1")
    }
    with tempfile.TemporaryDirectory(dir="/dev/shm") as directory:
        raw = Path(directory) / "frames.yuv"
        for clip in map(Path, sys.argv[1:]):
            width, height = decode(clip, raw)
            frame_bytes = width * height * 3 // 2
            parse = f"rawvideoparse format=i420 width={width} height={height} framerate=30/1"
            source = f"filesrc location={raw} blocksize={frame_bytes} ! {parse}"
            print(f"{clip.name}, {width}x{height}")
            for name, encode in candidates.items():
                measure(name, encode, source, raw, frame_bytes)
            measure("ffvhuff", "avenc_ffvhuff", source, raw, frame_bytes, contained=False)


if __name__ == "__main__":
    main()
