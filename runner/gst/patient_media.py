"""A media of the RTSP server that may take longer than the library's 20 s until it delivers."""

from __future__ import annotations

from collections.abc import Callable

from gi.repository import GstRtspServer


class PatientMedia(GstRtspServer.RTSPMedia):  # type: ignore[misc]  # PyGObject has no types
    """Opened by `open`.

    The library (1.22 to 1.28) knows one call for starting and waiting, `prepare`, and fails what has delivered nothing
    20 s after it. But only the thread that waits counts these seconds, and after a start that failed it does not wait.
    """

    _is_started = False

    def open(self, thread: GstRtspServer.RTSPThread, wait: Callable[[], bool]) -> bool:
        """Start the pipeline, and stop it again unless it delivers; returns whether it does.

        thread  of the library, which handles the messages of the pipeline
        wait    returns, any time later, whether it may deliver within 20 s
        """
        if self.prepare(thread):
            return True  # it was open
        if not self._is_started:
            return False
        if wait() and self.prepare(None):
            return True
        self.unprepare()
        return False

    def do_prepare(self, thread: GstRtspServer.RTSPThread) -> bool:
        thread.reuse()  # since the library ends the thread of a start that fails
        self._is_started = bool(GstRtspServer.RTSPMedia.do_prepare(self, thread))
        return False
