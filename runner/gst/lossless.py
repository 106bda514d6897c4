"""Keeps whole pictures of cameras without loss while they are sent: parts of a few seconds, each a file of its own."""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from gi.repository import Gst

from runner.errors import reason
from runner.graph import LOSSLESS, Plan
from runner.gst.clocks import captured_at
from runner.gst.probes import BufferProbe, PassingBuffer
from runner.gst.streams import passed_counts
from runner.gst.video_files import DIRECTORY, NOT_ASKED, new_file, outermost
from runner.settings import WHOLE, Lossless

CHECK_S = 0.2
FINISH_S = 30.0  # an encoder or a disk that makes no progress for this long has failed
STOP_S = 3.0  # that a vehicle waits for its last files
LEFT_BYTES = 1_000_000_000  # of the disk, for logs and the video as sent

OnReport = Callable[[str, str], None]


@dataclass(frozen=True, slots=True)
class LosslessFiles:
    """Where whole pictures are kept.

    directory  of the drive; the files are DIRECTORY/video/CAMERA.lossless.N.mkv
    on_file    called when a file has its first picture, from another thread: camera, name of the file relative to the
               directory, capture time of that picture in s since 1970
    """

    directory: Path
    on_file: Callable[[str, str, float], None]

    def cameras(self, plans: Sequence[Plan], on_report: OnReport) -> KeptCameras:
        """The cameras whose plans keep pictures: one after the other, as far as their pauses allow."""
        found, turn_s = list[KeptCamera](), 0.0
        for plan in plans:
            if kept := plan.lossless:
                found.append(KeptCamera(plan.camera.name, kept, turn_s % kept.every_s, self, on_report))
                turn_s += kept.for_s
        return KeptCameras({camera.name: camera for camera in found})


class KeptCamera:
    """The files of one camera, over all of its pipelines.

    kept       how much of it
    turn_s     how long it waits at first, so that cameras take turns
    on_report  called, from any thread, with the camera and what is missing in its files
    """

    def __init__(self, name: str, kept: Lossless, turn_s: float, files: LosslessFiles, on_report: OnReport) -> None:
        self.name, self.kept, self.files = name, kept, files
        self._turn_s, self._on_report = turn_s, on_report
        self.next: float | None = None  # when the next part is due, time.monotonic
        self.written = 0  # bytes of complete parts
        self.ends = threading.Event()
        self._branch: _Branch | None = None  # of the newest pipeline

    def follow(self, pipeline: Gst.Bin) -> None:
        """Keep pictures of a newly built pipeline of a plan with `lossless`, from its first picture on."""
        self._branch = _Branch(self, pipeline)

    def due(self) -> float:
        """When the next part begins, time.monotonic."""
        if self.next is None:
            self.next = time.monotonic() + self._turn_s
        return self.next

    def say(self, what: str) -> None:
        self._on_report(self.name, what)

    def end(self, why: str) -> None:
        """Keep no more pictures."""
        if not self.ends.is_set():
            self.ends.set()
            self.say(f"its whole pictures are no longer kept: {why}")

    def join(self, until: float) -> None:
        """Wait until its last file is complete, at most to this time of time.monotonic."""
        if self._branch:
            self._branch.join(until)


class KeptCameras:
    """All of them, by name."""

    def __init__(self, cameras: Mapping[str, KeptCamera]) -> None:
        self._cameras = cameras

    def follow(self, name: str, pipeline: Gst.Bin) -> None:
        """Keep pictures of a camera's newly built pipeline, if that is wanted."""
        if name in self._cameras:
            self._cameras[name].follow(pipeline)

    def stop(self) -> None:
        """Let the last file of each camera become complete, within a time limit."""
        until = time.monotonic() + STOP_S
        for camera in self._cameras.values():
            camera.ends.set()
        for camera in self._cameras.values():
            camera.join(until)


class _Branch:
    """The elements behind the tee of one pipeline.

    What follows the queue changes its state by itself: it plays during parts only, and goes on after its pipeline has
    ended, until the file is complete. The stream's thread passes pictures to the queue and never waits: a full queue
    drops them, and the gate is closed before anything behind it fails or stops. All else is done by a thread, which may
    wait for the disk. It alone keeps the pipeline, as long as it runs; the pipeline's bus keeps this object.
    """

    def __init__(self, camera: KeptCamera, pipeline: Gst.Bin) -> None:
        self._camera = camera
        self._failed: str | None = None  # in this part
        self._path: Path | None = None  # of this part's file
        gate = pipeline.get_by_name(f"{LOSSLESS}gate")
        for element in _behind(gate):
            element.set_locked_state(True)
        NOT_ASKED.add_to(gate.get_static_pad("sink"))
        self._begins = BufferProbe(gate.get_static_pad("sink"), self._on_first_buffer)
        self._begins.arm()
        self._first = BufferProbe(gate.get_static_pad("src"), self._on_first_of_part)
        self._thread: threading.Thread | None = None
        bus = outermost(pipeline).get_bus()
        bus.enable_sync_message_emission()
        bus.connect("sync-message::error", self._on_error)

    def join(self, until: float) -> None:
        if self._thread:
            self._thread.join(max(0.0, until - time.monotonic()))

    # --- called by streaming threads ----------------------------------------------------------------------------------

    def _on_first_buffer(self, pad: Gst.Pad, _picture: PassingBuffer) -> bool:
        gate = pad.get_parent_element()
        arguments = (gate.get_parent(), gate)
        self._thread = threading.Thread(target=self._run, args=arguments, name=f"keeping {self._camera.name}")
        self._thread.daemon = True
        self._thread.start()
        return True

    def _on_first_of_part(self, pad: Gst.Pad, picture: PassingBuffer) -> bool:
        files, path = self._camera.files, self._path
        if path and picture.pts is not None:
            name = str(path.relative_to(files.directory))
            files.on_file(self._camera.name, name, captured_at(pad, picture.pts))
        return True

    def _on_error(self, _bus: Gst.Bus, message: Gst.Message) -> None:
        """From the thread in which it occurred, which is still blocked."""
        # A bin that fails to start resets all elements, even locked ones; a file sink without a name then fails.
        if self._path and message.src and message.src.get_name().startswith(LOSSLESS):
            message.src.get_parent().get_by_name(f"{LOSSLESS}gate").set_property("drop", True)
            self._failed = self._failed or message.parse_error()[0].message

    # --- the thread ---------------------------------------------------------------------------------------------------

    def _run(self, _pipeline: Gst.Bin, gate: Gst.Element) -> None:
        camera = self._camera
        while self._waits(gate, camera.due()):
            self._keep(gate)
            camera.next = max(camera.due() + camera.kept.every_s, time.monotonic())

    def _waits(self, gate: Gst.Element, until: float, check: Callable[[], bool] = lambda: True) -> bool:
        """Wait; returns False as soon as the pipeline or the keeping ends, or `check` does."""
        while (left := until - time.monotonic()) > 0:
            ended = self._camera.ends.wait(min(CHECK_S, left)) or gate.get_state(0)[1] < Gst.State.PAUSED
            if ended or self._failed or not check():
                return False
        return not self._camera.ends.is_set()

    def _keep(self, gate: Gst.Element) -> None:
        """Write one part."""
        camera, elements = self._camera, _behind(gate)
        if not self._has_room(0):
            return
        try:
            self._path = path = new_file(camera.files.directory / DIRECTORY, f"{camera.name}{WHOLE}", "mkv")
        except OSError as error:
            camera.end(reason(error))
            return
        elements[-1].set_property("location", str(path))
        self._first.arm()
        for element in reversed(elements):
            element.set_state(Gst.State.PLAYING)
        arrived, recorded = (gate.get_parent().get_by_name(f"{LOSSLESS}{name}") for name in ("arrived", "recorded"))
        before = passed_counts(arrived)[0]
        gate.set_property("drop", False)
        self._waits(gate, time.monotonic() + camera.kept.for_s, lambda: self._has_room(path.stat().st_size))
        gate.set_property("drop", True)
        if not self._is_finished(elements):
            camera.end(self._failed or f"{path.name} was not finished within {FINISH_S:g} s")
        of = passed_counts(arrived)[0] - before
        missing = of - passed_counts(recorded)[0]
        for element in elements:
            element.set_state(Gst.State.NULL)  # waits for a disk that hangs, as only this thread may
        camera.written += path.stat().st_size
        self._conclude(path, missing, of)

    def _conclude(self, path: Path, missing: int, of: int) -> None:
        if not of:
            path.unlink()
        elif missing > 0 and not self._failed:
            slow = "the encoder or the disk is too slow"
            self._camera.say(f"{missing} of {of} whole pictures are missing in {path.name}: {slow}")

    def _has_room(self, growing: int) -> bool:
        """Whether a file that has this many bytes may become larger."""
        camera = self._camera
        if camera.written + growing > camera.kept.most_gb * 1e9:
            camera.end(f"the {camera.kept.most_gb:g} GB of log.lossless.{camera.name}.most_gb are full")
        elif shutil.disk_usage(camera.files.directory).free < LEFT_BYTES:
            camera.end(f"the disk has less than {LEFT_BYTES / 1e9:g} GB left")
        return not camera.ends.is_set()

    def _is_finished(self, elements: Sequence[Gst.Element]) -> bool:
        """Send the end of the stream through the branch, and wait until the file is complete."""
        entry, end = elements[0].get_static_pad("sink"), elements[-1].get_static_pad("sink")
        entry.send_event(Gst.Event.new_eos())
        until = time.monotonic() + FINISH_S
        while not self._failed and end.get_sticky_event(Gst.EventType.EOS, 0) is None:
            if time.monotonic() > until:
                return False
            time.sleep(CHECK_S / 10)
        return not self._failed


def _behind(gate: Gst.Element) -> list[Gst.Element]:
    """The elements from the queue to the file, in order."""
    found, element = list[Gst.Element](), gate
    while (pad := element.get_static_pad("src")) is not None:
        element = pad.get_peer().get_parent_element()
        found.append(element)
    return found[1:]  # the first one counts
