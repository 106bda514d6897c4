"""Records one camera from its source into a file: every frame as it enters the pipeline; all losses are counted."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from enum import Enum
from typing import TYPE_CHECKING

from gi.repository import GLib, Gst

from runner.graph import Plan
from runner.gst.aside import set_state_in_thread
from runner.gst.caps import structure
from runner.gst.clocks import unix_time
from runner.gst.credentials import log_in
from runner.gst.ip_camera import CameraClient, follow_cameras
from runner.gst.rtspsrc import limit_teardown
from runner.gst.source import fixed_rate, loop_clip
from runner.gst.streams import passed_counts

if TYPE_CHECKING:
    from runner.gst.bag_feed import BagFeed

CHECK_MS = 100
SOURCE_SILENT_S = 10.0  # a source that delivers nothing for this long has failed
WRITE_S = 60.0  # an encoder or a disk that makes no progress for this long has failed
LAST_S = 1.0  # in this last period each frame is checked, so that the file ends with the right one


class Stage(Enum):
    """State of a recording."""

    RECORDING = "recording"
    FINISHED = "finished"
    FAILED = "failed"


@dataclass(frozen=True, slots=True)
class Recorded:
    """Progress of one camera's recording.

    frames     frames kept
    seconds    from the first to the end of the last one, by their timestamps
    missing    frames expected in this time but absent; 0 for a bag
    overruns   frames dropped at the full queue before the encoder, even after the end
    repeated   frames that the source repeated to keep its rate, not counted for a clip
    left_out   frames that the source dropped to keep its rate, not counted for a clip
    width, height  px, 0 before the first frame
    began      time of the first frame, s since 1970; 0 before it
    failure    what failed, or None
    """

    stage: Stage = Stage.RECORDING
    frames: int = 0
    seconds: float = 0.0
    missing: int = 0
    overruns: int = 0
    repeated: int = 0
    left_out: int = 0
    width: int = 0
    height: int = 0
    began: float = 0.0
    failure: str | None = None


class Recorder:
    """Records one camera. Everything happens in the thread of GLib's main loop, unless stated otherwise.

    path        file that is written; complete as soon as the stage is FINISHED, and closed soon after
    duration_s  length of the recording, s; None: until `finish`
    """

    def __init__(self, plan: Plan, path: str, duration_s: float | None) -> None:
        self._plan, self._duration_s = plan, duration_s
        self._pipeline = Gst.parse_launch(plan.recording(path))
        self._queue, self._counter = map(self._pipeline.get_by_name, ("waiting", "recorded"))
        self._out = self._counter.get_static_pad("src")
        self._recorded = Recorded()
        self._overruns = 0
        self._first = Gst.CLOCK_TIME_NONE  # ns of running time
        self._end: tuple[int, int] | None = None  # ns of running time at which the recording is cut, frames until then
        self._counting_down = self._finishing = False
        self._progress = (0, time.monotonic())  # frames at the last change of the counter, and when
        self._rated = fixed_rate(self._pipeline) if not plan.loops else []
        self._feed = self._read_bag() if plan.bag else None
        self._clients: list[CameraClient] = []

    def _read_bag(self) -> BagFeed:
        """Record a bag as fast as the encoder accepts it: once, or repeatedly up to a given length."""
        from runner.gst.bag_feed import read_bag

        assert self._plan.bag
        self._queue.set_property("leaky", "no")
        source = self._pipeline.get_by_name(self._plan.source[0].name)
        loop = self._plan.camera.source.loop and self._duration_s is not None
        return read_bag(source, self._plan.bag, self._plan.camera.fps, loop)

    def start(self) -> None:
        """Start; a recording that cannot start is FAILED at the next check."""
        if not self._feed:  # a bag's feed waits for the queue
            self._queue.connect("overrun", self._on_overrun)
        self._out.add_probe(Gst.PadProbeType.BUFFER, self._on_first_frame)
        if self._feed and self._duration_s is not None:  # it may pass the end between two looks
            self._count_down()
        for element in self._rated:
            element.set_property("skip-to-first", True)  # otherwise the first frame is repeated for the time before it
        limit_teardown(self._pipeline)
        problem = log_in(self._pipeline, self._plan)
        self._clients = follow_cameras(self._pipeline, self._plan)
        if self._plan.loops:
            loop_clip(self._pipeline, self._plan)
        bus = self._pipeline.get_bus()
        bus.add_signal_watch()
        bus.connect("message::error", self._on_error)
        bus.connect("message::eos", self._on_eos)
        self._progress = (0, time.monotonic())
        self._watching = GLib.timeout_add(CHECK_MS, self._watch)
        if problem:
            self._close(Stage.FAILED, problem)
            return
        self._pipeline.set_state(Gst.State.PLAYING)  # a failure is reported on the bus, with its reason

    def sample(self) -> Recorded:
        """Progress so far."""
        if self._recorded.stage is Stage.RECORDING:
            self._recorded = self._count()
        return self._recorded

    def finish(self) -> None:
        """Finish the file with all frames delivered so far; the stage soon becomes FINISHED."""
        if self._recorded.stage is not Stage.RECORDING or self._finishing:
            return
        if self._first == Gst.CLOCK_TIME_NONE:
            self._close(Stage.FAILED, "stopped before its first frame")
            return
        self._finishing, self._progress = True, (0, time.monotonic())
        above = self._queue.get_static_pad("sink").get_peer()
        above.add_probe(Gst.PadProbeType.IDLE, self._end_stream)

    def stop(self) -> None:
        """Stop immediately; a file that is not FINISHED stays incomplete."""
        if self._recorded.stage is Stage.RECORDING:
            self._close(Stage.FAILED, "stopped before its file was finished")

    def _close(self, stage: Stage, why: str | None = None) -> None:
        self._recorded = replace(self._count(), stage=stage, failure=why)
        GLib.source_remove(self._watching)
        self._pipeline.get_bus().remove_signal_watch()
        set_state_in_thread(self._pipeline, Gst.State.NULL)  # a source that hangs must not keep others from finishing

    # --- counting -----------------------------------------------------------------------------------------------------

    def _count(self) -> Recorded:
        if self._first == Gst.CLOCK_TIME_NONE:
            return self._recorded
        # The counter is read last: a frame that passes meanwhile must not appear to be missing.
        end, frames = self._end or (self._out.query_position(Gst.Format.TIME)[1], passed_counts(self._counter)[0])
        seconds = max(0, end - self._first) / Gst.SECOND
        picture = structure(self._out.get_current_caps())
        return Recorded(
            frames=frames,
            seconds=seconds,
            missing=0 if self._feed else max(0, round(seconds * self._plan.camera.fps) - frames),
            overruns=self._overruns,
            repeated=sum(element.get_property("duplicate") for element in self._rated),
            left_out=sum(map(self._dropped, self._rated)),
            width=picture.get_int("width")[1],
            height=picture.get_int("height")[1],
            began=self._recorded.began or self._began(),
        )

    def _dropped(self, element: Gst.Element) -> int:
        """Frames that an element has dropped to keep a rate."""
        if self._feed:  # its own count includes the end of the bag
            return int(element.get_property("in") - element.get_property("out"))
        return int(element.get_property("drop"))

    def _began(self) -> float:
        """Wall-clock time of the first frame; for a bag, its capture time."""
        if self._feed and self._feed.first is not None:
            return float(self._feed.first / Gst.SECOND)
        clock = self._pipeline.get_clock()
        if clock is None:
            return 0.0
        return unix_time(clock, self._pipeline.get_base_time(), self._first)

    # --- watching -----------------------------------------------------------------------------------------------------

    def _watch(self) -> bool:
        """A few times a second: check that frames arrive, and whether the end is near."""
        now = self._count()
        self._recorded = replace(self._recorded, began=now.began)
        if now.frames != self._progress[0] and not self._finishing:
            self._progress = (now.frames, time.monotonic())
        if why := self._stall():
            self._close(Stage.FAILED, why)
            return False
        started = self._first != Gst.CLOCK_TIME_NONE
        if started and self._duration_s is not None and now.seconds > self._duration_s - LAST_S:
            self._count_down()
        return True

    def _stall(self) -> str | None:
        """What has made no progress for too long, or None."""
        stalled_s = time.monotonic() - self._progress[1]
        if self._finishing or self._end is not None:
            return f"the file was not finished within {WRITE_S:g} s" if stalled_s > WRITE_S else None
        if self._queue.get_property("current-level-buffers"):  # the first frame of an encoder may take seconds
            return f"frames are queued, but none was written for {WRITE_S:g} s" if stalled_s > WRITE_S else None
        if any(client.is_opening for client in self._clients):  # an IP camera has its own limit for each answer
            return None
        return f"no frame for {SOURCE_SILENT_S:g} s" if stalled_s > SOURCE_SILENT_S else None

    def _count_down(self) -> None:
        """Start checking every frame, to cut at the right one."""
        if not self._counting_down:
            self._counting_down = True
            self._out.add_probe(Gst.PadProbeType.BUFFER, self._on_late_frame)

    def _on_late_frame(self, pad: Gst.Pad, info: Gst.PadProbeInfo) -> Gst.PadProbeReturn:
        """From the streaming thread: the first frame beyond the end ends the file."""
        assert self._duration_s is not None
        frame = Gst.SECOND / float(self._plan.camera.fps)
        time_ns = info.get_buffer().pts
        if self._end is None and time_ns - self._first < self._duration_s * Gst.SECOND - frame / 2:
            return Gst.PadProbeReturn.OK
        if self._end is None:
            self._end = (time_ns, passed_counts(self._counter)[0] - 1)
            pad.get_peer().send_event(Gst.Event.new_eos())
        return Gst.PadProbeReturn.DROP

    def _on_first_frame(self, _pad: Gst.Pad, info: Gst.PadProbeInfo) -> Gst.PadProbeReturn:
        """From the streaming thread."""
        self._first = info.get_buffer().pts
        return Gst.PadProbeReturn.REMOVE

    def _end_stream(self, pad: Gst.Pad, _info: Gst.PadProbeInfo) -> Gst.PadProbeReturn:
        """Between two frames, from any thread. The pad stays blocked, so nothing follows the end."""
        pad.get_peer().send_event(Gst.Event.new_eos())
        return Gst.PadProbeReturn.OK

    def _on_overrun(self, _queue: Gst.Element) -> None:
        """From the streaming thread, for each frame that is dropped."""
        self._overruns += 1

    def _on_error(self, _bus: Gst.Bus, message: Gst.Message) -> None:
        self._close(Stage.FAILED, message.parse_error()[0].message)

    def _on_eos(self, _bus: Gst.Bus, _message: Gst.Message) -> None:
        """The muxer has written its index, and the file is complete."""
        if self._first == Gst.CLOCK_TIME_NONE:
            self._close(Stage.FAILED, "its source ended before its first frame")
        elif undecoded := self._undecoded():
            self._close(Stage.FAILED, f"{undecoded} of its bag's pictures could not be decoded")
        else:
            self._close(Stage.FINISHED)

    def _undecoded(self) -> int:
        """Pictures of a whole bag that its decoder has left out, as it does with damaged ones."""
        if not (self._feed and self._rated) or self._finishing or self._end:
            return 0
        return int(self._feed.pushed - self._rated[0].get_property("in"))
