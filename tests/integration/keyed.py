"""Keys for all parties, if requested in the environment by KEYS=1."""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from functools import cache
from pathlib import Path

from runner.core.roles import Role
from runner.security.authority import Authority

VEHICLE, CONTROLLER, WATCHER = "delivery_robot", "alice", "bob"


def issue(directory: Path) -> Path:
    """Keys of a vehicle, its broker, one operator who drives and one who watches."""
    authority = Authority(directory)
    with authority.opened():
        authority.issue("broker", Role.BROKER, [])
        authority.issue(VEHICLE, Role.VEHICLE, [])
        authority.issue(CONTROLLER, Role.CONTROLLER, [])
        authority.issue(WATCHER, Role.WATCHER, [])
    return directory


@cache
def keys() -> Path | None:
    """The directory of all keys, for this process; None: nothing is encrypted."""
    if os.environ.get("KEYS", "0") in ("", "0"):
        return None
    directory = tempfile.mkdtemp(prefix="tod-soak-keys-")
    atexit.register(shutil.rmtree, directory, ignore_errors=True)
    return issue(Path(directory) / "keys")


def words(holder: str = "") -> list[str]:
    """The override that gives a side its keys, or a demo those of everybody; none without keys."""
    directory = keys()
    return [f"keys={directory / holder}"] if directory else []
