"""VP9 in place of packaged x264: how its rate follows a new target, what lost packets cost, processor time.

  python bench/vp9.py CLIP...                            the synthetic drive and clips, seven minutes for each
  python bench/vp9.py --only rate --set aq-mode=3        other properties of vp9enc

Encoder, payloader, depayloader and decoder are those of GStreamer, one picture after the other; what is between them is
computed, so that no figure but times depends on how busy the machine is: a link that carries a ninth more than the
target, 30 ms each way, random loss. The operator's side asks for missing packets and waits for them as
`runner/gst/repair.py` does, or, without retransmission, for 40 ms. Its browser gets whole pictures only, and a grey one
in place of an incomplete key picture of H.264, as `read_unit` makes it. Until a key picture or a whole refresh wave has
healed the damage, 25 reports a second state it, and the vehicle answers with a key picture twice a second at most: with
new caps, which `vp9enc` takes for a new start, too.

Quality is that of what is on the screen 30 ms and two intervals after each picture of the source was captured: where
that picture is late or lost, one before it.
"""

from __future__ import annotations

import argparse
import random
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from fractions import Fraction
from pathlib import Path
from statistics import fmean
from typing import NamedTuple

import numpy as np
from footage import pictures

from runner.clips import rendered
from runner.configuration.config import configuration
from runner.core.commands import KnobValue
from runner.core.model import Camera
from runner.graph import compile_graph, launch
from runner.gst import Gst
from runner.gst.repair import ATTEMPTS, REORDER_MS
from runner.h264.access_unit import starts
from runner.h264.damage import HEAD_BYTES, Damage
from runner.h264.keyframe import grey_idr
from runner.plans import render_missing
from runner.rate_quality.metrics import find_metric
from runner.turning import assignments, text
from runner.vehicle.repair import KEY_FRAME_S

SIZES = {(480, 260): 300, (960, 520): 1000}  # px: kbit/s
RATES = (15, 30)  # Hz
LINKS = ((0.0, True), (0.02, True), (0.005, False), (0.02, False))  # share of packets lost, whether they are sent again
ONE_WAY_S, WAIT_S, REPORT_S = 0.03, 0.04, 0.04
UDP_BYTES = 28  # of headers in front of RTP
CARRIES = 10 / 9  # times the target
STEP, STEP_S = (2000, 300), 6  # kbit/s; s at each
PROPERTIES = {  # of vp9enc
    "deadline": 1,
    "cpu-used": 8,
    "end-usage": "cbr",
    "lag-in-frames": 0,
    "error-resilient": "default",  # else a lost picture leaves the decoder with other probabilities than the encoder
    "buffer-size": 200,
    "buffer-initial-size": 100,
    "buffer-optimal-size": 100,
    "max-intra-bitrate": 100,
    "keyframe-max-dist": 100_000,
    "threads": 1,
    "tile-columns": 0,
}
X264, VP9 = "x264", "VP9"
ANEW, KEY = "VP9, anew", "VP9, key"  # which begins anew with a lower target, or is asked for a key picture by an event
DEPAYLOADER = {X264: "rtph264depay ! video/x-h264,stream-format=byte-stream,alignment=au", VP9: "rtpvp9depay"}
DECODER = {X264: "avdec_h264 max-threads=1", VP9: "vp9dec threads=1"}


class Case(NamedTuple):
    """One camera and its encoder."""

    encoder: str
    clip: Path
    size: tuple[int, int]
    fps: int
    properties: Mapping[str, object]

    @property
    def codec(self) -> str:
        return X264 if self.encoder == X264 else VP9

    @property
    def name(self) -> str:
        return f"{self.clip.stem[:15]:15} {self.size[0]:4} px {self.fps} Hz {self.encoder:9}"

    def camera(self) -> Camera:
        words = ["vehicle=delivery_robot", "source=test", f"cameras.front.fps={self.fps}"]
        words += [f"cameras.front.{side}_px={px}" for side, px in zip(("width", "height"), self.size, strict=True)]
        words += [f"cameras.front.native={{width_px: {self.size[0]}, height_px: {self.size[1]}, top_px: 0}}"]
        if self.codec == VP9:
            own = ", ".join(f"{key}: {value}" for key, value in self.properties.items())
            words += [
                f"graph.encoder=[{{name: encoder, element: vp9enc, properties: {{{own}}}}}]",
                "graph.sender=[{name: sent, element: identity},"
                " {name: pay0, element: rtpvp9pay, properties: {pt: 96, mtu: '{mtu_bytes}'}}]",
                "graph.knobs.bitrate=[{element: encoder, property: target-bitrate, value: bps}]",
                "graph.efforts=null",
            ]
        return configuration(words, runnable=False).setup().vehicle.cameras["front"]

    def frames(self, seconds: float) -> list[bytes]:
        most = round(seconds * self.fps)
        once = pictures(self.clip, self.size, most, self.fps)
        there_and_back = once + once[-2:0:-1]  # a cut would be the clip's, not the drive's
        return [there_and_back[number % len(there_and_back)] for number in range(most)]


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
        opening = Gst.Event.new_stream_start("pushed"), Gst.Event.new_caps(caps), Gst.Event.new_segment(segment)
        for event in opening:
            self._pad.push_event(event)

    def push(self, buffer: Gst.Buffer) -> tuple[list[Gst.Buffer], float]:
        """What comes out, and the processor time that it took, s."""
        began = time.thread_time()
        flow = self._pad.push(buffer)
        spent = time.thread_time() - began
        if flow != Gst.FlowReturn.OK:
            error = self.pipeline.get_bus().pop_filtered(Gst.MessageType.ERROR)
            raise RuntimeError(f"{flow.value_nick}: {error.parse_error() if error else 'no error'}")
        return list(self._come()), spent

    def end(self) -> list[Gst.Buffer]:
        """What was left inside."""
        self._pad.push_event(Gst.Event.new_eos())
        left = list(self._come())
        self.pipeline.set_state(Gst.State.NULL)
        return left

    def caps(self) -> Gst.Caps:
        return self._last.get_static_pad("sink").get_current_caps()

    def _come(self) -> Iterator[Gst.Buffer]:
        while sample := self._last.emit("try-pull-sample", 0):
            yield sample.get_buffer()


class Encoded(NamedTuple):
    """A picture: its packets, the unit that a depayloader makes of all of them, and how it begins.

    key    whether a decoder can begin with it
    spent  s of the processor
    """

    packets: list[Gst.Buffer]
    unit: Gst.Buffer
    head: bytes
    key: bool
    spent: float

    @property
    def size(self) -> int:
        return sum(packet.get_size() for packet in self.packets)

    def grey(self) -> Gst.Buffer | None:
        """What a browser gets if it is incomplete; None: nothing."""
        if not (data := grey_idr(self.head) if self.key else None):
            return None
        unit = Gst.Buffer.new_wrapped(data)
        unit.pts, unit.duration = self.unit.pts, self.unit.duration
        return unit


class Encoder:
    """The vehicle's elements of a camera, from gate to payloader, and the depayloader."""

    def __init__(self, case: Case, kbps: int) -> None:
        self._case, self._camera, self._number, self._is_square = case, case.camera(), 0, True
        media = configuration(("vehicle=delivery_robot",), runnable=False).setup().media
        caps = f"video/x-raw,format=I420,width={case.size[0]},height={case.size[1]},framerate={case.fps}/1"
        caps += ",pixel-aspect-ratio=1/1,colorimetry=bt709,interlace-mode=progressive"
        self._chain = Chain(launch(compile_graph(self._camera, media).vehicle), Gst.Caps.from_string(caps))
        self._depayloader: Chain | None = None
        for knob, value in {"sending": True, "size": case.size, "bitrate": kbps}.items():
            self.turn(knob, value)

    def turn(self, knob: str, value: KnobValue) -> None:
        for element, key, filled in assignments(self._camera, knob, value):
            Gst.util_set_object_arg(self._chain.pipeline.get_by_name(element), key, text(filled))

    def begin_anew(self) -> None:
        """With a key picture, as `KnobPanel.restart_encoder` does."""
        self._is_square = not self._is_square
        size = self._chain.pipeline.get_by_name("size")
        caps = size.get_property("caps").copy()
        caps.set_value("pixel-aspect-ratio", Gst.Fraction(*((1, 1) if self._is_square else (1000, 1001))))
        size.set_property("caps", caps)

    def ask_for_key(self) -> None:
        """By an event, which x264 answers with a refresh wave."""
        from gi.repository import GstVideo  # its version is required by `runner.gst`

        event = GstVideo.video_event_new_upstream_force_key_unit(Gst.CLOCK_TIME_NONE, True, 0)
        self._chain.pipeline.get_by_name("sent").get_static_pad("sink").push_event(event)

    def encode(self, data: bytes) -> Encoded:
        buffer = Gst.Buffer.new_wrapped(data)
        buffer.pts, buffer.duration = self._number * Gst.SECOND // self._case.fps, Gst.SECOND // self._case.fps
        self._number += 1
        packets, spent = self._chain.push(buffer)
        self._depayloader = self._depayloader or Chain(DEPAYLOADER[self._case.codec], self._chain.caps())
        (unit,) = [unit for packet in packets for unit in self._depayloader.push(packet)[0]]
        head = unit.extract_dup(0, min(HEAD_BYTES, unit.get_size()))
        # VP9: show_existing_frame and frame_type (bitstream specification, 6.2), of profile 0.
        key = starts(head, "h264")[0] if self._case.codec == X264 else head[0] & 0x0C == 0
        return Encoded(packets, unit, head, key, spent)

    def decoder(self) -> Chain:
        """Of what it has encoded."""
        assert self._depayloader
        return Chain(DECODER[self._case.codec], self._depayloader.caps())

    def end(self) -> None:
        self._chain.end()


class Way:
    """The link, and the operator's buffer: when each picture is handed on, or given up."""

    def __init__(self, kbps: float, loss: float, is_repaired: bool, seed: int) -> None:
        self._kbps, self._loss, self._is_repaired, self._random = kbps, loss, is_repaired, random.Random(seed)
        self._free = self._handed = 0.0  # when the link has sent all it has; when the last picture was handed on

    def carry(self, packets: Sequence[Gst.Buffer], at: float) -> tuple[float, bool]:
        """When a picture of this time is handed on, and whether it is whole."""
        is_whole = True
        for packet in packets:
            self._free = max(self._free, at) + 8 * (packet.get_size() + UDP_BYTES) / (1000 * self._kbps)
            came, has_come = self._arrival(self._free + ONE_WAY_S)
            self._handed, is_whole = max(self._handed, came), is_whole and has_come
        return self._handed, is_whole

    def _arrival(self, due: float) -> tuple[float, bool]:
        if self._random.random() >= self._loss:
            return due, True
        if not self._is_repaired:
            return due + WAIT_S, False
        for attempt in range(1, ATTEMPTS + 1):
            if self._random.random() >= self._loss:
                return due + attempt * (REORDER_MS / 1000 + 2 * ONE_WAY_S), True
        return due + WAIT_S + ATTEMPTS * 2 * ONE_WAY_S, False


class Healing:
    """Whether pictures show damage, and when the vehicle is asked for a key picture."""

    def __init__(self, codec: str) -> None:
        self._codec, self._damage, self._is_missing = codec, Damage("h264"), False
        self._reported: deque[tuple[float, bool]] = deque()
        self._is_damaged, self._next_report, self._asked = False, 0.0, -KEY_FRAME_S

    def hand_on(self, picture: Encoded, at: float, is_whole: bool) -> bool:
        """Returns whether the screen shows damage now."""
        is_incomplete, self._is_missing = self._is_missing or not is_whole, not is_whole
        if self._codec == X264:
            damaged = self._damage.add(is_incomplete, lambda: picture.head, whole=is_whole)
        else:
            damaged = not (is_whole and picture.key) and (is_incomplete or self._damage.is_damaged)
            self._damage.is_damaged = damaged
        self._reported.append((at, damaged))
        return damaged

    def is_key_due(self, now: float) -> bool:
        is_due = False
        while (arrives := self._next_report + ONE_WAY_S) <= now:
            while self._reported and self._reported[0][0] <= self._next_report:
                self._is_damaged = self._reported.popleft()[1]
            if self._is_damaged and arrives - self._asked >= KEY_FRAME_S:
                is_due, self._asked = True, arrives
            self._next_report += REPORT_S
        return is_due


class Handed(NamedTuple):
    """A picture at the operator: when, its luma if it is whole, whether the screen shows damage from then on."""

    at: float
    picture: bytes | None
    damaged: bool


class Delivered(NamedTuple):
    """damaged, frozen: shares of time; healed_s: mean; key: mean size, as a multiple of the mean picture."""

    damaged: float
    frozen: float
    healed_s: float
    key: float
    mssim: float
    vmaf: float
    encode_ms: float
    encode_p95_ms: float
    decode_ms: float


def deliver(case: Case, loss: float, is_repaired: bool, seconds: float, seed: int) -> Delivered:
    Gst.init(None)
    kbps, frames = SIZES[case.size], case.frames(seconds)
    encoder, decoder = Encoder(case, kbps), None
    way, healing = Way(kbps * CARRIES, loss, is_repaired, seed), Healing(case.codec)
    came: list[tuple[float, int, bool]] = []  # when, PTS, damage
    decoded: dict[int, bytes] = {}  # by PTS, which x264enc moves
    keys, encoding, decoding = [], [], []
    for number, data in enumerate(frames):
        now = number / case.fps
        if healing.is_key_due(now):
            encoder.begin_anew()
        picture = encoder.encode(data)
        encoding.append(1000 * picture.spent)
        keys += [picture.size] if picture.key and number else []
        at, is_whole = way.carry(picture.packets, now)
        came.append((at, picture.unit.pts, healing.hand_on(picture, at, is_whole)))
        decoder = decoder or encoder.decoder()
        if unit := picture.unit if is_whole else picture.grey():
            drawn, spent = decoder.push(unit)
            decoding.append(1000 * spent)
            decoded |= {each.pts: _luma(each, case.size) for each in drawn}
    encoder.end()
    decoded |= {each.pts: _luma(each, case.size) for each in decoder.end()} if decoder else {}
    handed = [Handed(at, decoded.get(pts), damaged) for at, pts, damaged in came]
    damaged, frozen, healed_s, scores = _on_screen(case, frames, handed)
    return Delivered(
        damaged,
        frozen,
        healed_s,
        fmean(keys) / (kbps * 125 / case.fps) if keys else 0.0,
        *scores,
        fmean(encoding),
        float(np.percentile(encoding, 95)),
        fmean(decoding),
    )


def _on_screen(
    case: Case, frames: Sequence[bytes], handed: Sequence[Handed]
) -> tuple[float, float, float, tuple[float, float]]:
    """Shares of time, time until healed, and MSSIM and VMAF of what the screen shows when each picture is due."""
    meters = [find_metric(name).meter(case.size, Fraction(case.fps)) for name in ("mssim", "vmaf")]
    shown, newest, arrived, damaged = bytes(case.size[0] * case.size[1]), -1, 0, []
    frozen = 0
    for number, data in enumerate(frames):
        due = number / case.fps + ONE_WAY_S + 2 / case.fps
        while arrived <= number and handed[arrived].at <= due:
            if picture := handed[arrived].picture:
                shown, newest = picture, arrived
            arrived += 1
        damaged.append(arrived > 0 and handed[arrived - 1].damaged)
        frozen += newest < number
        for meter in meters:
            meter.add(number, *(_rows(each, case.size) for each in (data, shown)))
    episodes = sum(now and not before for before, now in zip([False, *damaged], damaged, strict=False))
    mssim, vmaf = (fmean(meter.close().values()) for meter in meters)
    healed_s = sum(damaged) / case.fps / episodes if episodes else 0.0
    return sum(damaged) / len(frames), frozen / len(frames), healed_s, (mssim, vmaf)


def _luma(picture: Gst.Buffer, size: tuple[int, int]) -> bytes:
    luma: bytes = picture.extract_dup(0, size[0] * size[1])
    return luma


def _rows(picture: bytes, size: tuple[int, int]) -> np.ndarray:
    return np.frombuffer(picture, np.uint8, size[0] * size[1]).reshape(size[1], size[0])


def follow(case: Case, high: int, low: int) -> str:
    """A step of the target down and up: shares of the new target in the time after it."""
    Gst.init(None)
    encoder, sizes = Encoder(case, high), []
    for number, data in enumerate(case.frames(3 * STEP_S)):
        step, rest = divmod(number, STEP_S * case.fps)
        if step and not rest:
            encoder.turn("bitrate", (high, low, high)[step])
        if (step, rest) == (1, 0) and case.encoder == ANEW:
            encoder.begin_anew()
        elif (step, rest) == (1, 0) and case.encoder == KEY:
            encoder.ask_for_key()
        sizes.append(encoder.encode(data).size)
    encoder.end()
    return " | ".join(
        f"{name}: {_followed(sizes[at * case.fps : (at + STEP_S) * case.fps], case.fps, target)}"
        for name, at, target in (("down", STEP_S, low), ("up", 2 * STEP_S, high))
    )


def _followed(sizes: Sequence[int], fps: int, target: int) -> str:
    per_picture = target * 125 / fps

    def share(begin: float, end: float) -> float:
        part = sizes[round(begin * fps) : round(end * fps)]
        return sum(part) / len(part) / per_picture

    seconds = [share(second, second + 1) for second in range(1, STEP_S)]
    first = f"0.5 s {share(0, 0.5):.2f}, 1 s {share(0, 1):.2f}, then {min(seconds):.2f} to {max(seconds):.2f} a second"
    return f"{first}, largest {max(sizes) / per_picture:.1f}, {8 * max(sizes) / target / CARRIES:.0f} ms of the link"


def synthetic() -> Path:
    """The front camera's clip of the synthetic drive."""
    words = ("vehicle=delivery_robot", "source=synthetic", "fps_max=30", "~cameras.rear", "~cameras.mast")
    vehicle = configuration(words).setup().vehicle
    render_missing(vehicle, lambda *_: None)
    return Path(rendered(vehicle.cameras["front"]) or "")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clips", type=Path, nargs="*")
    parser.add_argument("--only", choices=("rate", "loss"))
    parser.add_argument(
        "--step", nargs=2, type=int, default=STEP, metavar=("HIGH", "LOW"), help="of the target, kbit/s"
    )
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE", help="properties of vp9enc")
    parser.add_argument("--seconds", type=float, default=15, help="of each clip, with losses")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    properties = {**PROPERTIES, **dict(word.split("=") for word in options.set)}
    places = [(clip, size, fps) for clip in (synthetic(), *options.clips) for size in SIZES for fps in RATES]
    with ProcessPoolExecutor(2) as pool:
        if options.only != "loss":
            cases = [Case(encoder, *place, properties) for place in places for encoder in (X264, VP9, ANEW, KEY)]
            rates = ([kbps] * len(cases) for kbps in options.step)
            for case, row in zip(cases, pool.map(follow, cases, *rates), strict=True):
                print(case.name, row, flush=True)
        if options.only != "rate":
            runs = [
                (Case(encoder, *place, properties), *link, options.seconds, options.seed)
                for place in places
                for link in LINKS
                for encoder in (X264, VP9)
            ]
            for (case, loss, is_repaired, *_), row in zip(runs, pool.map(_deliver, runs), strict=True):
                link = f"{loss:.1%} lost, {'sent again' if is_repaired else 'for good'}"
                figures = ", ".join(f"{key} {value:.3f}" for key, value in row._asdict().items())
                print(case.name, f"{link:23}", figures, flush=True)


def _deliver(run: tuple[Case, float, bool, float, int]) -> Delivered:
    return deliver(*run)


if __name__ == "__main__":
    main()
