"""Cameras of the vehicle, recorded without the rest of its side."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from runner.graph import Plan
from runner.gst.glib_thread import GlibThread
from runner.gst.recorder import Recorded, Recorder
from runner.gst.sequence import with_clip_range


class RecordingSide:
    """Records cameras of the vehicle, each from its source into a file.

    files       by camera, the file that is written
    duration_s  length of the recordings, s; None: until `finish`
    """

    def __init__(self, plans: Sequence[Plan], files: Mapping[str, Path], duration_s: float | None) -> None:
        self._glib = GlibThread()
        plans = [with_clip_range(plan) for plan in plans]
        self._recorders = {p.camera.name: Recorder(p, str(files[p.camera.name]), duration_s) for p in plans}
        self._glib.call("starting the recorders", self._for_each(Recorder.start))

    def sample(self) -> dict[str, Recorded]:
        """Progress of each camera's recording."""
        recorders = self._recorders
        return self._glib.call("reading the recorders' counters", lambda: {n: r.sample() for n, r in recorders.items()})

    def finish(self) -> None:
        """Finish every file with all frames delivered so far; returns immediately."""
        self._glib.call("ending the files", self._for_each(Recorder.finish))

    def stop(self) -> None:
        """Stop immediately; unfinished files stay incomplete."""
        self._glib.end(self._for_each(Recorder.stop))

    def _for_each(self, do: Callable[[Recorder], None]) -> Callable[[], None]:
        def each() -> None:
            for recorder in self._recorders.values():
                do(recorder)

        return each
