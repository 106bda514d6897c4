"""Writes one camera's stream on one side into a file, unchanged: MPEG-TS, which is readable even if cut off."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import count
from pathlib import Path

from gi.repository import Gst

from runner.graph import LOSSLESS
from runner.gst.probes import BufferProbe, PassingBuffer, TypeProbe

DIRECTORY = "video"  # below the drive's directory
SHIFT_S = 0.0005  # tolerance for times in the file
_MARK = "video-"  # prefix of the names of the elements that write the file, see runner/graph.py

# The file's branch accepts any stream, and must not influence its format or latency. Otherwise an encoder would choose
# the format that the file prefers, and the stream's sink would hold packets back until the slowest branch is ready.
NOT_ASKED = TypeProbe(
    Gst.PadProbeType.QUERY_DOWNSTREAM | Gst.PadProbeType.QUERY_UPSTREAM,
    {
        Gst.QueryType.CAPS: Gst.PadProbeReturn.DROP,  # without an answer the element assumes no limit
        Gst.QueryType.LATENCY: Gst.PadProbeReturn.HANDLED,  # answered unchanged: no latency
    },
)

Captured = Callable[[Gst.Pad, PassingBuffer], float | None]  # when a frame was captured, s since 1970; None: unknown


@dataclass(frozen=True, slots=True)
class VideoFiles:
    """Where the video of the cameras is stored.

    directory  of the drive; the files are DIRECTORY/video/CAMERA.SIDE.N.ts, N counts the pipelines with a frame
    on_video   called when a file has its first frame, from another thread: camera, name of the file relative to the
               directory, capture time of that frame in s since 1970
    on_shift   called when the offset between capture times and times in the file changes at a frame: camera, name of
               the file, the frame's time since the first one by the file, s, and its capture time, s since 1970
    """

    directory: Path
    on_video: Callable[[str, str, float], None]
    on_shift: Callable[[str, str, float, float], None]


class VideoFile:
    """The file of one pipeline. It begins with the first frame: a pipeline without frames leaves none.

    Any failure here ends the file, is reported once, and does not affect the stream. The pipeline's bus keeps this
    object, which must not keep the pipeline: elements are looked up when needed.

    side       vehicle or operator
    captured   returns a frame's capture time; called between queue and parser
    on_report  called with camera and what failed
    """

    def __init__(
        self, files: VideoFiles, camera: str, side: str, captured: Captured, on_report: Callable[[str, str], None]
    ) -> None:
        self._files, self._camera, self._side = files, camera, side
        self._captured, self._on_report = captured, on_report
        self._capture_times: dict[int | None, float] = {}  # by stream time, ns, until the file begins
        self._file = ""  # its name
        self._first: int | None = None  # the stream time of its first frame
        self._ahead = 0.0  # s by which capture times exceed times in the file
        self._begun = self._failed = self._overran = False

    def follow(self, pipeline: Gst.Bin) -> None:
        """Watch a newly built pipeline of a plan with `video`."""
        elements = {name: pipeline.get_by_name(f"{_MARK}{name}") for name in ("gate", "queue", "parser", "file")}
        elements["file"].set_locked_state(True)  # not opened with the pipeline, so that it cannot fail the pipeline
        NOT_ASKED.add_to(elements["gate"].get_static_pad("sink"))
        elements["queue"].connect("overrun", self._on_overrun)
        self._probes = (
            BufferProbe(elements["queue"].get_static_pad("src"), self._on_unit),
            BufferProbe(elements["parser"].get_static_pad("src"), self._on_first_parsed),
        )
        for probe in self._probes:
            probe.arm()
        bus = outermost(pipeline).get_bus()
        bus.enable_sync_message_emission()
        bus.connect("sync-message::error", self._on_error)

    def _on_unit(self, pad: Gst.Pad, unit: PassingBuffer) -> bool:
        """From the queue's thread. The parser outputs nothing before parameter sets."""
        captured, pts = self._captured(pad, unit), unit.pts
        if not self._begun:
            self._capture_times[pts] = time.time() if captured is None else captured
        elif self._file and not self._failed and captured is not None and pts is not None and self._first is not None:
            after_s = (pts - self._first) / Gst.SECOND
            if after_s >= 0 and abs(captured - after_s - self._ahead) > SHIFT_S:
                self._ahead = captured - after_s
                self._files.on_shift(self._camera, self._file, after_s, captured)
        return False

    def _on_first_parsed(self, pad: Gst.Pad, unit: PassingBuffer) -> bool:
        """From the queue's thread: open the file, just before its first frame."""
        self._begun = True
        first = unit.pts
        captured = self._capture_times.get(first) or max(self._capture_times.values(), default=time.time())
        self._capture_times.clear()
        parts = pad.get_parent_element().get_parent()
        try:
            path = new_file(self._files.directory / DIRECTORY, f"{self._camera}.{self._side}", "ts")
        except OSError as error:
            self._fail(parts, str(error))
            return True
        sink = parts.get_by_name(f"{_MARK}file")
        sink.set_property("location", str(path))
        sink.set_locked_state(False)
        if sink.sync_state_with_parent():  # otherwise it has posted an error
            self._file, self._first = str(path.relative_to(self._files.directory)), first
            self._ahead = captured
            self._files.on_video(self._camera, self._file, captured)
        return True

    def _on_error(self, _bus: Gst.Bus, message: Gst.Message) -> None:
        """From the thread in which it occurred, which is still blocked."""
        # A bin that fails to start resets all elements, even locked ones; a file sink without a name then fails.
        name = message.src.get_name() if message.src else ""
        if name.startswith(_MARK) and (self._begun or name != f"{_MARK}file"):
            self._fail(message.src.get_parent(), message.parse_error()[0].message)

    def _fail(self, parts: Gst.Bin, why: str) -> None:
        """Close the gate, which discards all further frames and hides the failure of the frame in flight."""
        parts.get_by_name(f"{_MARK}gate").set_property("drop", True)
        if not self._failed:
            self._failed = True
            self._on_report(self._camera, f"video is not recorded: {why}")

    def _on_overrun(self, queue: Gst.Element) -> None:
        """From the stream's thread, when the queue is full for the first time."""
        queue.set_property("silent", True)  # once is enough
        if not (self._overran or self._failed):
            self._overran = True
            self._on_report(self._camera, "the disk is too slow: frames are missing in the video file")


def concerns_file(message: Gst.Message) -> bool:
    """Whether a message comes from an element that only serves the file."""
    return bool(message.src) and message.src.get_name().startswith((_MARK, LOSSLESS))


def new_file(directory: Path, name: str, suffix: str) -> Path:
    """Create an empty file that did not exist before, with the next free number behind its name.

    raises  OSError
    """
    directory.mkdir(parents=True, exist_ok=True)
    for number in count():
        path = directory / f"{name}.{number}.{suffix}"
        try:
            os.close(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
        except FileExistsError:
            continue
        return path
    raise AssertionError("numbers never end")


def outermost(element: Gst.Element) -> Gst.Element:
    while (parent := element.get_parent()) is not None:
        element = parent
    return element
