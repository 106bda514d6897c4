"""VP9 in place of packaged x264: how its rate follows, what lost packets cost, processor time.

  python bench/vp9.py CLIP...                  the synthetic drive, and clips; --only rate, size, loss or time
  python bench/vp9.py --set error-resilient=0 aq-mode=3     other properties of vp9enc

Encoder, payloader, depayloader and decoder are those of GStreamer, one picture after the other; the way between them is
computed, so nothing depends on how busy the machine is: a link that carries the target and a ninth, 30 ms each way,
random loss. A missing packet is asked for and awaited as the operator's side does, or (`none`) awaited for 40 ms. A
browser gets no incomplete picture, as from the page's server. Until a key picture, or x264's refresh wave, has healed
the picture, 25 reports a second state damage, and the vehicle makes a key picture each half second at most.
Quality is that of what is on the screen at each picture of the source, 30 ms and two picture intervals after it: a
picture that was late or lost leaves the one before it there.
"""

from __future__ import annotations

import argparse
import random
import time
from collections import deque
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from statistics import fmean
from typing import NamedTuple

import numpy as np
from footage import pictures

from runner.configuration.config import configuration
from runner.core.model import Camera
from runner.graph import compile_graph, launch
from runner.gst import Gst
from runner.h264.access_unit import starts
from runner.h264.damage import Damage
from runner.plans import render_missing
from runner.clips import rendered
from runner.rate_quality.metrics import find_metric
from runner.turning import assignments, text

SIZES = {(480, 260): 300, (960, 520): 1000}  # px: kbit/s
RATES = (15, 30)  # Hz
ONE_WAY_S, WAIT_S, REORDER_S, ATTEMPTS = 0.03, 0.04, 0.005, 3  # s; as `runner.gst.repair`
REPORT_S, KEY_S = 0.04, 0.5
CARRIES = 10 / 9  # of the target
LOSSES = (0.0, 0.005, 0.02)
SECONDS, SEEDS = 20, (1, 2, 3)
HIGH, LOW, STEP_S = 2000, 300, 6  # kbit/s; s at each
PROPERTIES = {  # of vp9enc
    "deadline": 1,
    "cpu-used": 8,
    "end-usage": "cbr",
    "lag-in-frames": 0,
    "error-resilient": "default",
    "buffer-size": 200,
    "buffer-initial-size": 100,
    "buffer-optimal-size": 100,
    "max-intra-bitrate": 150,
    "keyframe-max-dist": 100_000,
    "threads": 1,
    "tile-columns": 0,
}
DEPAY = {
    "x264": "rtph264depay ! video/x-h264,stream-format=byte-stream,alignment=au",
    "vp9": "rtpvp9depay",
}
DECODE = {"x264": "avdec_h264 max-threads=1", "vp9": "vp9dec threads=1"}


class Case(NamedTuple):
    """One camera. codec: x264 or vp9."""

    codec: str
    clip: Path
    size: tuple[int, int]
    fps: int
    vp9: Mapping[str, object]

    def camera(self) -> Camera:
        words = ["vehicle=delivery_robot", "source=test", f"cameras.front.fps={self.fps}"]
        for key, px in zip(("width_px", "height_px"), self.size, strict=True):
            words += [f"cameras.front.{key}={px}"]
        words += [f"cameras.front.native={{width_px: {self.size[0]}, height_px: {self.size[1]}, top_px: 0}}"]
        if self.codec == "vp9":
            own = ", ".join(f"{key}: {value}" for key, value in self.vp9.items())
            words += [
                f"graph.encoder=[{{name: encoder, element: vp9enc, properties: {{{own}}}}}]",
                "graph.sender=[{name: sent, element: identity},"
                " {name: pay0, element: rtpvp9pay, properties: {pt: 96, mtu: '{mtu_bytes}'}}]",
                "graph.knobs.bitrate=[{element: encoder, property: target-bitrate, value: bps}]",
                "graph.key_frame=event",
                "graph.efforts=null",
            ]
        return configuration(words, runnable=False).setup().vehicle.cameras["front"]

    def frames(self, seconds: float) -> list[bytes]:
        once = pictures(self.clip, self.size, round(seconds * self.fps), self.fps)
        there_and_back = once + once[-2:0:-1]  # a cut would be the clip's, not the drive's
        return [there_and_back[number % len(there_and_back)] for number in range(round(seconds * self.fps))]


class Chain:
    """Elements that work in the thread that pushes buffers into them, so that their processor time can be told."""

    def __init__(self, line: str, caps: Gst.Caps) -> None:
        self.pipeline = Gst.parse_launch(f"identity name=first ! {line} ! appsink name=last sync=false async=false")
        self._last, self._pad = self.pipeline.get_by_name("last"), Gst.Pad.new("pushed", Gst.PadDirection.SRC)
        self.pipeline.set_state(Gst.State.PLAYING)
        self._pad.link(self.pipeline.get_by_name("first").get_static_pad("sink"))
        self._pad.set_active(True)
        segment = Gst.Segment()
        segment.init(Gst.Format.TIME)
        for event in (
            Gst.Event.new_stream_start("pushed"),
            Gst.Event.new_caps(caps),
            Gst.Event.new_segment(segment),
        ):
            self._pad.push_event(event)

    def push(self, buffer: Gst.Buffer) -> tuple[list[Gst.Buffer], float]:
        """What comes out, and the processor time that it took, s."""
        began = time.thread_time()
        flow = self._pad.push(buffer)
        spent = time.thread_time() - began
        if flow != Gst.FlowReturn.OK:
            error = self.pipeline.get_bus().pop_filtered(Gst.MessageType.ERROR)
            raise RuntimeError(f"{flow.value_nick}: {error.parse_error() if error else 'no error'}")
        return self._waiting(), spent

    def end(self) -> list[Gst.Buffer]:
        self._pad.push_event(Gst.Event.new_eos())
        left = self._waiting()
        self.pipeline.set_state(Gst.State.NULL)
        return left

    def caps(self) -> Gst.Caps:
        return self._last.get_static_pad("sink").get_current_caps()

    def _waiting(self) -> list[Gst.Buffer]:
        found = []
        while sample := self._last.emit("try-pull-sample", 0):
            found.append(sample.get_buffer())
        return found


class Picture(NamedTuple):
    """An encoded picture: its packets, what the depayloader makes of them, whether a decoder can begin with it, s of
    the processor."""

    packets: list[Gst.Buffer]
    unit: Gst.Buffer
    head: bytes
    key: bool
    spent: float

    @property
    def size(self) -> int:
        return sum(packet.get_size() for packet in self.packets)


class Encoder:
    """The vehicle's elements of a camera, from gate to payloader."""

    def __init__(self, case: Case) -> None:
        self._case, self._camera, self._number, self._ratio = case, case.camera(), 0, False
        media = configuration(("vehicle=delivery_robot",), runnable=False).setup().media
        caps = f"video/x-raw,format=I420,width={case.size[0]},height={case.size[1]},framerate={case.fps}/1"
        caps += ",pixel-aspect-ratio=1/1,colorimetry=bt709,interlace-mode=progressive"
        self.chain = Chain(launch(compile_graph(self._camera, media).vehicle), Gst.Caps.from_string(caps))
        self.depayloader: Chain | None = None
        self._sent = self.chain.pipeline.get_by_name("sent").get_static_pad("sink")
        self.turn("sending", True)
        self.turn("size", case.size)

    def turn(self, knob: str, value) -> None:
        for element, key, filled in assignments(self._camera, knob, value):
            Gst.util_set_object_arg(self.chain.pipeline.get_by_name(element), key, text(filled))

    def ask_for_key(self) -> None:
        """As `runner.gst.pipeline` does."""
        from gi.repository import GstVideo

        if self._camera.graph.key_frame == "event":
            self._sent.push_event(
                GstVideo.video_event_new_upstream_force_key_unit(Gst.CLOCK_TIME_NONE, True, 0)
            )
            return
        self._ratio = not self._ratio
        size = self.chain.pipeline.get_by_name("size")
        caps = size.get_property("caps").copy()
        caps.set_value("pixel-aspect-ratio", Gst.Fraction(*((1000, 1001) if self._ratio else (1, 1))))
        size.set_property("caps", caps)

    def encode(self, data: bytes) -> Picture:
        buffer = Gst.Buffer.new_wrapped(data)
        buffer.pts, buffer.duration = (
            self._number * Gst.SECOND // self._case.fps,
            Gst.SECOND // self._case.fps,
        )
        self._number += 1
        packets, spent = self.chain.push(buffer)
        self.depayloader = self.depayloader or Chain(DEPAY[self._case.codec], self.chain.caps())
        (unit,) = [unit for packet in packets for unit in self.depayloader.push(packet)[0]]
        head = unit.extract_dup(0, min(2048, unit.get_size()))
        return Picture(packets, unit, head, self._is_key(head), spent)

    def _is_key(self, head: bytes) -> bool:
        if self._case.codec == "vp9":
            return head[0] & 0x0C == 0  # show_existing_frame and frame_type (VP9 bitstream, 6.2), profile 0
        return starts(head, "h264")[0]


@dataclass
class Way:
    """The link and the operator's buffer: when each picture is handed on, or given up."""

    kbps: float
    loss: float
    repair: bool
    seed: int
    _random: random.Random = field(init=False)
    _free: float = 0.0  # when the link has sent what it has
    _handed: float = 0.0

    def __post_init__(self) -> None:
        self._random = random.Random(self.seed)

    def carry(self, packets: Sequence[Gst.Buffer], at: float) -> tuple[float, bool]:
        """When a picture of this time is handed on, and whether it is whole."""
        whole, arrived = True, at
        for packet in packets:
            self._free = max(self._free, at) + 8 * (packet.get_size() + 28) / (1000 * self.kbps)
            due = self._free + ONE_WAY_S
            came = self._came(due)
            whole, arrived = whole and came[1], max(arrived, came[0])
        self._handed = max(self._handed, arrived)
        return self._handed, whole

    def _came(self, due: float) -> tuple[float, bool]:
        if self._random.random() >= self.loss:
            return due, True
        if not self.repair:
            return due + WAIT_S, False
        for attempt in range(1, ATTEMPTS + 1):
            if self._random.random() >= self.loss:
                return due + attempt * (REORDER_S + 2 * ONE_WAY_S), True
        return due + WAIT_S + ATTEMPTS * 2 * ONE_WAY_S, False


class Healing:
    """Whether pictures are damaged, and when the vehicle is asked for a key picture."""

    def __init__(self, codec: str) -> None:
        self._codec, self._tracked, self._missing = codec, Damage("h264"), False
        self._arrived: deque[tuple[float, bool]] = deque()
        self._damaged, self._next, self._last = False, 0.0, -KEY_S

    def arrived(self, picture: Picture, at: float, whole: bool) -> bool:
        """Returns whether the picture, which is drawn if it is whole, still shows damage."""
        if self._codec == "x264":
            damaged = self._tracked.add(self._missing or not whole, lambda: picture.head, whole=whole)
        else:
            damaged = not whole or (not picture.key and (self._missing or self._tracked.is_damaged))
            self._tracked.is_damaged = damaged
        self._missing = not whole
        self._arrived.append((at, damaged))
        return damaged

    def key_due(self, now: float) -> bool:
        due = False
        while self._next + ONE_WAY_S <= now:
            while self._arrived and self._arrived[0][0] <= self._next:
                self._damaged = self._arrived.popleft()[1]
            if self._damaged and self._next + ONE_WAY_S - self._last >= KEY_S:
                due, self._last = True, self._next + ONE_WAY_S
            self._next += REPORT_S
        return due


class Delivered(NamedTuple):
    """Shares of time; s; quality on the screen."""

    damaged: float
    stale: float
    recovery: float
    keys: int
    key_size: float
    largest: float
    kbps: float
    mssim: float
    p5: float
    vmaf: float
    encode_ms: float
    encode_p95: float
    decode_ms: float


def deliver(case: Case, kbps: int, loss: float, repair: bool, seed: int, seconds: float = SECONDS, vmaf=True) -> Delivered:
    Gst.init(None)
    frames, encoder = case.frames(seconds), Encoder(case)
    encoder.turn("bitrate", kbps)
    way, healing = Way(kbps * CARRIES, loss, repair, seed), Healing(case.codec)
    decoder: Chain | None = None
    shown: dict[int, bytes] = {}
    numbers: dict[int, int] = {}  # of pictures, by PTS: x264enc moves these
    handed: list[tuple[float, bool, bool]] = []
    sizes, keys, spent, decoding = [], [], [], []

    def draw(buffers: Sequence[Gst.Buffer]) -> None:
        for buffer in buffers:
            shown[numbers[buffer.pts]] = buffer.extract_dup(0, case.size[0] * case.size[1])

    for number, data in enumerate(frames):
        now = number / case.fps
        if healing.key_due(now):
            encoder.ask_for_key()
        picture = encoder.encode(data)
        sizes.append(picture.size)
        spent.append(picture.spent)
        if picture.key and number:
            keys.append(picture.size)
        decoder = decoder or Chain(DECODE[case.codec], encoder.depayloader.caps())
        numbers[picture.unit.pts] = number
        at, whole = way.carry(picture.packets, now)
        handed.append((at, whole, healing.arrived(picture, at, whole)))
        if whole:
            drawn, took = decoder.push(picture.unit)
            draw(drawn)
            decoding.append(took)
    draw(decoder.end())
    encoder.chain.end()
    budget = ONE_WAY_S + 2 / case.fps
    meters = {name: find_metric(name).meter(case.size, Fraction(case.fps)) for name in ("mssim", "vmaf")[: 1 + vmaf]}
    newest, damaged, stale, on_screen = 0, 0, 0, b""
    arrived = 0
    began, recoveries = None, []
    for number, data in enumerate(frames):
        while arrived < len(handed) and handed[arrived][0] <= number / case.fps + budget:
            if handed[arrived][1] and arrived in shown:
                newest, on_screen = arrived, shown[arrived]
            arrived += 1
        hurt = arrived > 0 and handed[arrived - 1][2]
        damaged += hurt
        stale += newest < number
        if hurt and began is None:
            began = number
        if not hurt and began is not None:
            recoveries.append((number - began) / case.fps)
            began = None
        for meter in meters.values():
            meter.add(number, luma(data, case.size), luma(on_screen or bytes(len(data)), case.size))
    scores = {name: meter.close() for name, meter in meters.items()}
    steady = sizes[case.fps :]
    mean = kbps * 125 / case.fps
    mssim = list(scores["mssim"].values())
    return Delivered(
        damaged / len(frames),
        stale / len(frames),
        fmean(recoveries) if recoveries else 0.0,
        len(keys),
        fmean(keys) / mean if keys else 0.0,
        max(steady) / mean,
        sum(steady) * 8 / 1000 / (len(steady) / case.fps),
        fmean(mssim),
        float(np.percentile(mssim, 5)),
        fmean(scores["vmaf"].values()) if vmaf else 0.0,
        1000 * fmean(spent),
        1000 * float(np.percentile(spent, 95)),
        1000 * fmean(decoding),
    )


def luma(picture: bytes, size: tuple[int, int]) -> np.ndarray:
    return np.frombuffer(picture, np.uint8, size[0] * size[1]).reshape(size[1], size[0])


def follow(case: Case) -> str:
    """A step of the target down and up."""
    Gst.init(None)
    frames, encoder = case.frames(3 * STEP_S), Encoder(case)
    sizes, keys = [], []
    for number, data in enumerate(frames):
        if number % (STEP_S * case.fps) == 0:
            encoder.turn("bitrate", (HIGH, LOW, HIGH)[number // (STEP_S * case.fps)])
        picture = encoder.encode(data)
        sizes.append(picture.size)
        if picture.key and number:
            keys.append(number / case.fps)
    encoder.chain.end()

    def rate(begin: float, end: float, target: int) -> float:
        part = sizes[round(begin * case.fps) : round(end * case.fps)]
        return sum(part) * 8 / 1000 / (end - begin) / target

    rows = []
    for at, target in ((STEP_S, LOW), (2 * STEP_S, HIGH)):
        part = sizes[at * case.fps : (at + STEP_S) * case.fps]
        seconds = [rate(at + more, at + more + 1, target) for more in range(1, STEP_S)]
        rows.append(
            f"{rate(at, at + .2, target):5.2f} {rate(at, at + .5, target):5.2f} {rate(at, at + 1, target):5.2f}"
            f" {rate(at + .5, at + 1, target):5.2f} {rate(at + 1, at + 2, target):5.2f}"
            f"  1 s {min(seconds):.2f}..{max(seconds):.2f}"
            f"  largest {max(part) * case.fps / 125 / target:.1f} = {max(part) * 8 / target / CARRIES:.0f} ms"
        )
    return f"down {rows[0]} | up {rows[1]} | keys {keys}"


def cases(clips: Sequence[Path], vp9: Mapping[str, object]) -> list[Case]:
    return [
        Case(codec, clip, size, fps, vp9)
        for clip in clips
        for size in SIZES
        for fps in RATES
        for codec in ("x264", "vp9")
    ]


def synthetic() -> Path:
    vehicle = configuration(("vehicle=delivery_robot", "source=synthetic", "fps_max=30", "~cameras.rear", "~cameras.mast")).setup().vehicle
    render_missing(vehicle, lambda *_: None)
    return Path(rendered(vehicle.cameras["front"]) or "")


def named(case: Case) -> str:
    return f"{case.clip.stem[:12]:12} {case.size[0]:4} {case.fps:2} Hz {case.codec:4}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clips", type=Path, nargs="*")
    parser.add_argument("--only", choices=("rate", "loss"))
    parser.add_argument("--set", nargs="*", default=[])
    parser.add_argument("--seconds", type=float, default=SECONDS)
    parser.add_argument("--rates", type=int, nargs="*", default=RATES)
    options = parser.parse_args()
    vp9 = {**PROPERTIES, **dict(word.split("=") for word in options.set)}
    every = [case for case in cases([synthetic(), *options.clips], vp9) if case.fps in options.rates]
    with ProcessPoolExecutor(2) as pool:
        if options.only != "loss":
            for case, row in zip(every, pool.map(follow, every), strict=True):
                print(named(case), row, flush=True)
        if options.only != "rate":
            jobs = [
                (case, loss, repair)
                for case in every
                for loss, repair in ((0.0, True), (0.005, True), (0.02, True), (0.005, False), (0.02, False))
            ]
            args = [(case, SIZES[case.size], loss, repair, 1, options.seconds) for case, loss, repair in jobs]
            for job, row in zip(jobs, pool.map(_deliver, args), strict=True):
                print(
                    named(job[0]), f"{job[1]:.1%} {'rtx ' if job[2] else 'none'}",
                    f"damaged {row.damaged:.3f} stale {row.stale:.3f} rec {row.recovery:.2f} keys {row.keys} {row.key_size:.1f}x"
                    f" max {row.largest:.1f} kbps {row.kbps:.0f} mssim {row.mssim:.4f} p5 {row.p5:.3f} vmaf {row.vmaf:.1f}"
                    f" enc {row.encode_ms:.2f}/{row.encode_p95:.2f} dec {row.decode_ms:.2f}", flush=True,
                )


def _deliver(arguments) -> Delivered:
    return deliver(*arguments)


if __name__ == "__main__":
    main()
