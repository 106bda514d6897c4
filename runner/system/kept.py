"""What a side keeps on its machine from one process to the next."""

from __future__ import annotations

import fcntl
import os
import re
import uuid
from pathlib import Path
from typing import IO

MOST_OPERATORS = 64  # of a vehicle at once, on one machine without keys; further ones have ids for one process
IDENTITY = re.compile(r"[0-9a-f]{12}")


def state_directory() -> Path:
    return Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local/state") / "tod-runner"


class KeptIdentity:
    """An id for an operator without keys: its own until `close`, then that of the next one here for this vehicle.

    So one that crashes and is started again is known to the vehicle, which gives control back to it.
    """

    def __init__(self, vehicle: str) -> None:
        self._file: IO[str] | None = None
        self.value = uuid.uuid4().hex[:12]
        try:
            self._lock_one(state_directory() / "operators", vehicle)
        except OSError:
            self.close()  # nothing can be kept here: the id is of this process only

    def _lock_one(self, directory: Path, vehicle: str) -> None:
        directory.mkdir(parents=True, exist_ok=True)
        for number in range(1, MOST_OPERATORS + 1):
            file = self._file = (directory / f"{vehicle}.{number}").open("a+", encoding="ascii", errors="replace")
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                self.close()
                continue
            file.seek(0)
            if IDENTITY.fullmatch(kept := file.read(100)):
                self.value = kept
                return
            file.truncate(0)
            file.write(self.value)
            file.flush()
            return

    def close(self) -> None:
        if self._file:
            self._file.close()
        self._file = None
