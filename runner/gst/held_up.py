"""Whether the network holds up what leaves a pipeline, from looks: no Python runs for a picture."""

from __future__ import annotations

from gi.repository import Gst

from runner.gst.probes import IdleProbe


class HeldUp:
    """Whether what is behind a pad holds up what passes it, as a viewer over TCP does whose link is jammed."""

    def __init__(self, pad: Gst.Pad) -> None:
        self._pad, self._idle = pad, IdleProbe(self._on_idle)
        self._is_busy = False

    def look(self, is_overdue: bool) -> bool:
        """Look whether what passed last is still on its way, since the last look at least; from one thread.

        is_overdue  whether a picture is missing: else the pad is left alone
        """
        was_busy = self._is_busy
        if is_overdue and not was_busy:
            self._is_busy = True
            self._idle.add_to(self._pad)  # between two pictures it is called at once
        return was_busy

    def _on_idle(self) -> None:
        self._is_busy = False
