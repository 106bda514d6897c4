"""User names and passwords of IP cameras, from files: they appear in no configuration, printout or process list."""

from __future__ import annotations

from pathlib import Path

from gi.repository import Gst

from runner.graph import Plan
from runner.system.files import exposure, read_file

LONGEST = 1000  # bytes


def log_in(pipeline: Gst.Bin, plan: Plan) -> str | None:
    """Set the user name and password of the elements of a new source.

    returns  why it cannot, such as a file that others may read; None if it can, or no file is configured
    """
    if plan.camera.credentials is None:
        return None
    path = Path(plan.camera.credentials)
    try:
        user, password = _read(path)
    except ValueError as error:
        return f"credentials {path}: {error}"
    for element in (pipeline.get_by_name(element.name) for element in plan.source):
        if element and element.find_property("user-id") and element.find_property("user-pw"):
            element.set_property("user-id", user)
            element.set_property("user-pw", password)
    return None


def _read(path: Path) -> tuple[str, str]:
    """raises  ValueError with the rule that the file breaks"""
    lines = read_file(path, LONGEST).decode(errors="replace").splitlines()
    if exposed := exposure(path):
        raise ValueError(exposed)
    user, _, password = lines[0].partition(":") if len(lines) == 1 else ("", "", "")
    if not user or not password:
        raise ValueError("must contain one line user:password")
    return user, password
