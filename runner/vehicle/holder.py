"""Keeps who holds control and who asks to stop in a file: a vehicle that restarts gives neither up."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from runner.errors import RunError
from runner.mqtt.messages import OPERATOR
from runner.system.files import read_file, write_whole
from runner.system.reports import RepeatedReports

MOST_BYTES = 1000
END_S = 2.0  # how long the last write may take
SOMEBODY = "?"  # by a file that cannot be read: nobody of that name can return


class Held(NamedTuple):
    """Ids of operators, "" for nobody: the holder, and the one that has asked the vehicle to stop."""

    holder: str = ""
    stop: str = ""


NOBODY = Held()


class KeptHolder:
    """Writes in a thread of its own: the disk may hang.

    path       of the file; None: nothing is kept
    on_report  called with why it cannot be read or written

    former  as it was last written
    """

    def __init__(self, path: Path | None, on_report: Callable[[str], None]) -> None:
        self._path, self._report = path, RepeatedReports(on_report)
        self.former = self._wanted = self._written = self._read()
        self._changed, self._is_closed = threading.Condition(), False
        self._thread = threading.Thread(target=self._write, name="holder", daemon=True)
        self._thread.start()

    def keep(self, held: Held) -> None:
        """Let the next process know. Returns immediately."""
        with self._changed:
            self._wanted = held
            self._changed.notify()

    def close(self) -> None:
        with self._changed:
            self._is_closed = True
            self._changed.notify()
        self._thread.join(END_S)

    def _read(self) -> Held:
        if not self._path or not self._path.exists():
            return NOBODY
        try:
            document = json.loads(read_file(self._path, MOST_BYTES))
            held = Held(document["holder"], document.get("stop", ""))  # an earlier version had no stop
            for key, name in held._asdict().items():
                if name and not OPERATOR.fullmatch(name):
                    raise ValueError(f"{key}: {name!r} is no operator's id")
        except (ValueError, KeyError, TypeError) as error:
            rule = "somebody counts as lost in control, and as asking to stop; remove the file if the vehicle stands"
            self._report(f"{self._path}: who was in control cannot be read ({error}): {rule}")
            return Held(SOMEBODY, SOMEBODY)
        return held

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
                    write_whole(self._path, json.dumps(wanted._asdict()).encode())
                except RunError as error:
                    self._report(f"{error}: after a restart of the vehicle anybody may get control")
