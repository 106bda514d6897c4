"""What fewer pictures a second, and fewer refresh waves, do to the quality of recorded clips at equal bitrates.

  python bench/pictures.py CLIP...      two minutes for each clip

The packaged encoder, with the knobs `fps` and `wave_s` that rules turn, encodes 20 s of each clip at 640x360 and 25 Hz
(a shorter clip is repeated). Two figures of MSSIM: of each picture that is sent, compared with itself ("sent"), and at
every picture of the clip, compared with the last one that was sent ("held"): that counts how far the scene has moved.
Bits at equal quality: mean difference of ln(bitrate) over the range of MSSIM that both curves have.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Sequence
from fractions import Fraction
from itertools import islice
from pathlib import Path
from statistics import fmean
from typing import NamedTuple

import numpy as np
from footage import WAIT, pictures

from runner.configuration.config import configuration
from runner.core.graph_settings import NEVER_S
from runner.core.model import Camera
from runner.graph import compile_graph, launch
from runner.gst import Gst
from runner.rate_quality.metrics import find_metric
from runner.turning import assignments, text

SIZE, HZ, SECONDS = (640, 360), 25, 20
KBPS = (150, 250, 400, 700)
RATES = (1, 2, 3, 5)  # each n-th picture
WAVES = (1.5, 6.0, NEVER_S)  # s
RULES = ("modes=motion", "modes.collective.waves_by_loss={loss: 0.01, calm_s: 10}")


class Encoded(NamedTuple):
    """kbps: as encoded; sent, held: MSSIM, see above."""

    kbps: float
    sent: float
    held: float


def camera(*words: str) -> Camera:
    own = (f"cameras.front.width_px={SIZE[0]}", f"cameras.front.height_px={SIZE[1]}", f"cameras.front.fps={HZ}")
    native = (f"cameras.front.native={{width_px: {SIZE[0]}, height_px: {SIZE[1]}, top_px: 0}}",)
    setup = configuration(("vehicle=delivery_robot", "source=test", *own, *native, *words)).setup()
    return setup.vehicle.cameras["front"]


def luma(picture: bytes) -> np.ndarray:
    return np.frombuffer(picture, np.uint8, SIZE[0] * SIZE[1]).reshape(SIZE[1], SIZE[0])


def encoded(frames: Sequence[bytes], kbps: int, *, nth: int = 1, wave_s: float = WAVES[0]) -> Encoded:
    from gi.repository import GstVideo  # its version is required by `runner.gst`

    own = camera(*RULES)
    line = launch(compile_graph(own, configuration(("vehicle=delivery_robot",)).setup().media).vehicle[:-1])
    caps = f"video/x-raw,format=I420,width={SIZE[0]},height={SIZE[1]},framerate={HZ}/1,pixel-aspect-ratio=1/1"
    pipeline = Gst.parse_launch(
        f"appsrc name=frames format=time caps={caps} ! {line} ! h264parse ! avdec_h264 max-threads=1"
        " ! video/x-raw,format=I420 ! appsink name=decoded sync=false"
    )
    knobs = {"sending": True, "size": SIZE, "fps": own.fps / nth, "bitrate": kbps}
    for knob, wanted in knobs.items():
        for element, key, value in assignments(own, knob, wanted, nth):
            Gst.util_set_object_arg(pipeline.get_by_name(element), key, text(value))
    source, sink, sent = (pipeline.get_by_name(name) for name in ("frames", "decoded", "sent"))
    bits = [0]
    sent.connect("handoff", lambda _element, buffer: bits.append(8 * buffer.get_size()))
    sent.set_property("signal-handoffs", True)
    pipeline.set_state(Gst.State.PLAYING)
    for number, data in enumerate(frames):
        if number and number % round(wave_s * HZ) == 0:
            event = GstVideo.video_event_new_upstream_force_key_unit(Gst.CLOCK_TIME_NONE, True, 0)
            sent.get_static_pad("sink").push_event(event)
        buffer = Gst.Buffer.new_wrapped(data)
        buffer.pts, buffer.duration = number * Gst.SECOND // HZ, Gst.SECOND // HZ
        source.emit("push-buffer", buffer)
        while source.get_property("current-level-buffers") > 2:
            time.sleep(0.001)
    source.emit("end-of-stream")
    shown: dict[int, bytes] = {}
    while sample := sink.emit("try-pull-sample", WAIT):
        buffer = sample.get_buffer()
        began = sample.get_segment().to_running_time(Gst.Format.TIME, buffer.pts)
        shown[round(began * HZ / Gst.SECOND)] = buffer.extract_dup(0, buffer.get_size())
    assert (error := pipeline.get_bus().pop_filtered(Gst.MessageType.ERROR)) is None, error.parse_error()
    pipeline.set_state(Gst.State.NULL)
    meter = find_metric("mssim").meter(SIZE, Fraction(HZ))
    last = b""
    for number, data in enumerate(frames):
        last = shown.get(number, last)
        meter.add(number, luma(data), luma(last))
    scores = meter.close()
    return Encoded(sum(bits) / 1000 / SECONDS, fmean(scores[number] for number in shown), fmean(scores.values()))


def fewer_bits(usual: Sequence[Encoded], other: Sequence[Encoded]) -> float:
    """Change of the bitrate at equal quality, as a share."""
    curves = [([each.sent for each in curve], [math.log(each.kbps) for each in curve]) for curve in (usual, other)]
    least, most = max(x[0] for x, _ in curves), min(x[-1] for x, _ in curves)
    at = np.linspace(least, most, 50)
    before, after = (np.interp(at, x, y) for x, y in curves)
    return float(np.exp(np.mean(after - before)) - 1)


def main() -> None:
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    Gst.init(None)
    for clip in map(Path, sys.argv[1:]):
        once = pictures(clip, SIZE, HZ * SECONDS)
        frames = [once[number % len(once)] for number in range(HZ * SECONDS)]  # again from its start
        print(f"\n{clip.name}: MSSIM sent / held at kbit/s asked")
        print(" " * 12, *(f"{kbps:>16}" for kbps in KBPS))
        for nth in RATES:
            row = [encoded(frames, kbps, nth=nth) for kbps in KBPS]
            print(f"{HZ / nth:9.3g} Hz ", *(f"{each.sent:>8.4f}/{each.held:.4f}" for each in row), flush=True)
        usual = [encoded(frames, kbps) for kbps in KBPS]
        for wave_s in islice(WAVES, 1, None):
            rare = fewer_bits(usual, [encoded(frames, kbps, wave_s=wave_s) for kbps in KBPS])
            words = f"waves every {wave_s:g} s" if wave_s < NEVER_S else "no waves"
            print(f"{words} in place of every {WAVES[0]:g} s: {rare:+.1%} bits at equal MSSIM", flush=True)


if __name__ == "__main__":
    main()
