"""Keeps who holds control in a file, so that a vehicle that restarts does not give control to somebody else."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from pathlib import Path

from runner.errors import RunError
from runner.mqtt.messages import OPERATOR
from runner.system.files import read_file, write_whole
from runner.system.reports import RepeatedReports

MOST_BYTES = 1000
END_S = 2.0  # how long the last write may take
SOMEBODY = "?"  # the holder by a file that cannot be read: nobody of that name can return


class KeptHolder:
    """Writes in a thread of its own: the disk may hang.

    path       of the file; None: nothing is kept
    on_report  called with why it cannot be read or written

    former  who held control when it was last written, "" for nobody
    """

    def __init__(self, path: Path | None, on_report: Callable[[str], None]) -> None:
        self._path, self._report = path, RepeatedReports(on_report)
        self.former = self._wanted = self._written = self._read()
        self._changed, self._is_closed = threading.Condition(), False
        self._thread = threading.Thread(target=self._write, name="holder", daemon=True)
        self._thread.start()

    def keep(self, holder: str) -> None:
        """Let the next process know who holds control, "" for nobody. Returns immediately."""
        with self._changed:
            self._wanted = holder
            self._changed.notify()

    def close(self) -> None:
        with self._changed:
            self._is_closed = True
            self._changed.notify()
        self._thread.join(END_S)

    def _read(self) -> str:
        if not self._path or not self._path.exists():
            return ""
        try:
            holder = json.loads(read_file(self._path, MOST_BYTES))["holder"]
            if holder and not OPERATOR.fullmatch(holder):
                raise ValueError(f"holder: {holder!r} is no operator's id")
        except (ValueError, KeyError, TypeError) as error:
            rule = "somebody counts as in control and lost; remove the file if the vehicle stands"
            self._report(f"{self._path}: who was in control cannot be read ({error}): {rule}")
            return SOMEBODY
        return str(holder)

    def _write(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._is_closed or self._wanted != self._written)
                wanted = self._wanted
                if wanted == self._written:
                    return
                self._written = wanted  # also if it fails: the next change is tried again
            if self._path:
                try:
                    write_whole(self._path, json.dumps({"holder": wanted}).encode())
                except RunError as error:
                    self._report(f"{error}: after a restart of the vehicle anybody may get control")
