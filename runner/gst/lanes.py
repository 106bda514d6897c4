"""Runs many encoders on one sequence: decoded once, scaled once per factor, encoded and decoded in lanes.

Offline work, so Python per frame is fine here.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path

from gi.repository import GLib, Gst

from runner.errors import RunError
from runner.gst.caps import structure
from runner.gst.pictures import LumaPlane, luma_of
from runner.gst.stream_times import joined_units
from runner.lanes import BAG, FRAMES, LEFT_OUT, LaneSet

POLL_NS = 200 * 1_000_000
STALLED_S = 60  # without a frame for this long the pipeline is deadlocked

OnFrame = Callable[[int, LumaPlane], None]  # number of the frame from 0, its luma
OnDecoded = Callable[[int, int, LumaPlane], None]  # lane, number of the frame, its luma as decoded


@dataclass(slots=True)
class Encoded:
    """Result of one lane.

    frames    decoded pictures
    sent      of coded video: times, s, and bytes
    encode_s  CPU time of the encoder in its own thread, s
    """

    frames: int = 0
    sent: list[tuple[float, int]] = field(default_factory=list)
    encode_s: float = 0.0


@dataclass(slots=True)
class _Run:
    """State of one run, shared by its streaming threads.

    frames, read  pictures that have passed at the constant rate of the sequence, and before it was made constant
    ends_ns       when the last one that was read is over
    """

    fps: Fraction
    form: str = ""
    frames: int = 0
    read: int = 0
    ends_ns: int = 0
    first_ns: int = 0  # running time of the first frame: in a clip with sound it may be later than 0
    last_frame: float = field(default_factory=time.monotonic)  # time at which a frame last passed
    error: BaseException | None = None


def run_lanes(
    lanes: LaneSet, on_frame: OnFrame, on_picture: OnDecoded, on_progress: Callable[[int], None]
) -> list[Encoded]:
    """Run a sequence through all lanes, as fast as possible.

    on_frame     called with each frame of the sequence before any lane gets it, from one thread
    on_picture   called with each decoded picture, from one thread per lane; it may block
    on_progress  called with the number of frames so far, a few times a second
    returns      by lane
    raises       RunError with GStreamer's message; exceptions from the callbacks
    """
    pipeline = _parsed(lanes.line)
    if lanes.bag:
        from runner.gst.bag_feed import read_bag

        read_bag(pipeline.get_by_name(BAG), lanes.bag, lanes.fps)
    run = _Run(lanes.fps)
    pipeline.get_by_name(FRAMES).get_static_pad("sink").add_probe(
        Gst.PadProbeType.BUFFER | Gst.PadProbeType.EVENT_DOWNSTREAM,
        lambda pad, info: _on_source(run, pad, info, on_frame),
    )
    for rate in (each for each in _elements(pipeline, "videorate") if not each.get_name().startswith(LEFT_OUT)):
        rate.get_static_pad("sink").add_probe(Gst.PadProbeType.BUFFER, lambda _, info: _on_read(run, info.get_buffer()))
    results = [Encoded() for _ in lanes.lanes]
    for number, lane in enumerate(lanes.lanes):
        _watch_encoder(pipeline.get_by_name(lane.encoder), results[number])
        _watch_sizes(pipeline.get_by_name(lane.counter), results[number])
        sink = pipeline.get_by_name(lane.sink)
        sink.connect("new-sample", lambda s, n=number: _on_sample(run, s, n, results[n], on_picture))
    try:
        if pipeline.set_state(Gst.State.PLAYING) == Gst.StateChangeReturn.FAILURE:
            raise RunError(_message(pipeline.get_bus().pop_filtered(Gst.MessageType.ERROR)))
        _wait(pipeline, run, on_progress)
        if not lanes.lanes:
            _check_seams(pipeline, run.read)
    finally:
        pipeline.set_state(Gst.State.NULL)
    return results


def _elements(pipeline: Gst.Pipeline, factory: str) -> list[Gst.Element]:
    return [element for element in pipeline.children if element.get_factory().get_name() == factory]


def _check_seams(pipeline: Gst.Pipeline, read: int) -> None:
    """raises RunError if a picture behind a seam of joined files was left out, perhaps with a new size"""
    units = sum(joined_units(Path(file.get_property("location"))) for file in _elements(pipeline, "filesrc"))
    if read < units:
        made_anew = "`ffmpeg -i FILE -c copy WHOLE.ts` makes it one"
        raise RunError(f"it was joined from several files, and only {read} of {units} pictures are read; {made_anew}")


def _parsed(line: str) -> Gst.Pipeline:
    try:
        return Gst.parse_launch(line)
    except GLib.Error as error:
        raise RunError(f"GStreamer: {error.message}") from None


def _wait(pipeline: Gst.Pipeline, run: _Run, on_progress: Callable[[int], None]) -> None:
    """Wait for the end of the sequence."""
    bus = pipeline.get_bus()
    while True:
        message = bus.timed_pop_filtered(POLL_NS, Gst.MessageType.ERROR | Gst.MessageType.EOS)
        if run.error:
            raise run.error
        if message and message.type == Gst.MessageType.ERROR:
            raise RunError(_message(message))
        if message:
            return
        on_progress(run.frames)
        if time.monotonic() - run.last_frame > STALLED_S:
            raise RunError(f"no frame has passed for {STALLED_S} s")


def _message(message: Gst.Message | None) -> str:
    if message is None:
        return "the pipeline does not start"
    error, detail = message.parse_error()
    where = message.src.get_name() if message.src else "pipeline"
    reason = str(detail or "").strip().splitlines()
    return f"{where}: {error.message}" + (f" ({reason[-1]})" if reason else "")


def _on_read(run: _Run, picture: Gst.Buffer) -> Gst.PadProbeReturn:
    lasts = round(Gst.SECOND / run.fps) if picture.duration == Gst.CLOCK_TIME_NONE else picture.duration
    run.read, run.ends_ns = run.read + 1, picture.pts + lasts
    return Gst.PadProbeReturn.OK


def _on_source(run: _Run, pad: Gst.Pad, info: Gst.PadProbeInfo, on_frame: OnFrame) -> Gst.PadProbeReturn:
    event = info.get_event() if info.type & Gst.PadProbeType.EVENT_DOWNSTREAM else None
    if event is not None:
        if event.type == Gst.EventType.CAPS:
            _check_form(run, event.parse_caps())
        return Gst.PadProbeReturn.OK
    if 0 < run.read <= run.frames and info.get_buffer().pts >= run.ends_ns:
        return Gst.PadProbeReturn.DROP  # GStreamer 1.28 repeats the last picture even if the rate was right
    number, run.frames, run.last_frame = run.frames, run.frames + 1, time.monotonic()
    if number == 0:
        segment = pad.get_sticky_event(Gst.EventType.SEGMENT, 0).parse_segment()
        run.first_ns = segment.to_running_time(Gst.Format.TIME, info.get_buffer().pts)
    _guarded(run, lambda: on_frame(number, luma_of(info.get_buffer(), pad.get_current_caps())))
    return Gst.PadProbeReturn.OK


def _check_form(run: _Run, caps: Gst.Caps) -> None:
    picture = structure(caps)
    form = f"{picture.get_int('width')[1]}x{picture.get_int('height')[1]}"
    if run.form and form != run.form:
        run.error = run.error or RunError(f"the size changes from {run.form} to {form} within the sequence")
    run.form = form


def _watch_encoder(encoder: Gst.Element, result: Encoded) -> None:
    """Add up the CPU time of the encoder's thread from each frame's input to its output."""
    began: dict[int, float] = {}

    def on_input(_pad: Gst.Pad, _info: Gst.PadProbeInfo) -> Gst.PadProbeReturn:
        began[threading.get_ident()] = time.thread_time()
        return Gst.PadProbeReturn.OK

    def on_output(_pad: Gst.Pad, _info: Gst.PadProbeInfo) -> Gst.PadProbeReturn:
        start = began.pop(threading.get_ident(), None)
        result.encode_s += 0.0 if start is None else time.thread_time() - start
        return Gst.PadProbeReturn.OK

    encoder.get_static_pad("sink").add_probe(Gst.PadProbeType.BUFFER, on_input)
    encoder.get_static_pad("src").add_probe(Gst.PadProbeType.BUFFER, on_output)


def _watch_sizes(counter: Gst.Element, result: Encoded) -> None:
    def on_coded(_pad: Gst.Pad, info: Gst.PadProbeInfo) -> Gst.PadProbeReturn:
        unit = info.get_buffer()
        result.sent.append((unit.pts / Gst.SECOND, unit.get_size()))
        return Gst.PadProbeReturn.OK

    counter.get_static_pad("src").add_probe(Gst.PadProbeType.BUFFER, on_coded)


def _on_sample(run: _Run, sink: Gst.Element, lane: int, result: Encoded, on_picture: OnDecoded) -> Gst.FlowReturn:
    sample = sink.emit("pull-sample")
    buffer = sample.get_buffer()
    running_ns = sample.get_segment().to_running_time(Gst.Format.TIME, buffer.pts)
    # An encoder may skip frames; the timestamp identifies this one.
    number = round(Fraction(running_ns - run.first_ns, Gst.SECOND) * run.fps)
    result.frames += 1
    run.last_frame = time.monotonic()
    _guarded(run, lambda: on_picture(lane, number, luma_of(buffer, sample.get_caps())))
    return Gst.FlowReturn.ERROR if run.error else Gst.FlowReturn.OK


def _guarded(run: _Run, work: Callable[[], None]) -> None:
    """Run work in a streaming thread; the waiting thread raises its exceptions."""
    if run.error:
        return
    try:
        work()
    except BaseException as error:
        run.error = error
