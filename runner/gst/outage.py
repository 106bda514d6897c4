"""Reports on a camera that fails repeatedly: each reason once, and the duration at the end."""

from __future__ import annotations

import threading
from collections.abc import Callable

from runner.gst.timers import later

MERGE_S = 0.3


class Outage:
    """The current outage of one camera. Times are s by the monotonic clock.

    on_report  called with a sentence for each new reason, and one at the end
    """

    def __init__(self, on_report: Callable[[str], None]) -> None:
        self._on_report = on_report
        self._reasons: list[str] = []
        self._began = 0.0

    @property
    def reason(self) -> str | None:
        """Its first reason; None while there is no outage."""
        return next(iter(tuple(self._reasons)), None)  # another thread may clear them

    def report_failure(self, why: str, since: float) -> None:
        """Record a failure.

        since  when the camera last worked; used for the first failure only
        """
        if not self._reasons:
            self._began = since
        if why not in self._reasons:
            self._reasons.append(why)
            self._on_report(why)

    def report_recovery(self, now: float) -> None:
        """End the outage: the camera works again."""
        if self._reasons:
            self._on_report(f"works again after {now - self._began:.0f} s")
        self._reasons.clear()


class ReportMerger:
    """Merges identical reports of several cameras at about the same time: `front, rear: no frame for 2 s`.

    on_report  called from GLib's thread with cameras and what happened to them
    """

    def __init__(self, on_report: Callable[[str, str], None]) -> None:
        self._on_report = on_report
        self._lock = threading.Lock()
        self._cameras: dict[str, list[str]] = {}  # by report

    def __call__(self, camera: str, what: str) -> None:
        """From any thread."""
        with self._lock:
            first = not self._cameras
            cameras = self._cameras.setdefault(what, [])
            if camera not in cameras:
                cameras.append(camera)
        if first:
            later(MERGE_S, self.flush)

    def flush(self) -> None:
        with self._lock:
            merged, self._cameras = self._cameras, {}
        for what, cameras in merged.items():
            self._on_report(", ".join(cameras), what)
