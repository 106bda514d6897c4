"""Clips that a source renders before a run, and the plans of a vehicle with those that are there."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from runner.errors import RunError
from runner.graph import Plan, compile_graph
from runner.model import Camera, Pose, Progress, Vehicle

if TYPE_CHECKING:
    from runner.synthetic import View

# A camera without a pose looks ahead from the height of a driver's eyes.
DRIVER = Pose(0.0, 0.0, 1.5, 0.0, 5.0, 0.0)


def cache_directory() -> Path:
    """The user's cache (XDG Base Directory Specification)."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "tod-runner"


def compile_plans(vehicle: Vehicle) -> list[Plan]:
    """A plan for each camera, with its rendered clip where there is one."""
    return [
        compile_graph(camera, vehicle.media, index, clip=_rendered(camera), recording=vehicle.recording)
        for index, camera in enumerate(vehicle.cameras.values())
    ]


def render_missing(vehicle: Vehicle, progress: Progress) -> None:
    """Render the clips that are not in the cache yet.

    raises  RunError
    """
    drives: dict[float, list[View]] = {}
    for camera in vehicle.cameras.values():
        if camera.source.render and _rendered(camera) is None:
            drives.setdefault(camera.source.render_s, []).append(view(camera))
    for seconds, views in drives.items():
        from runner.synthetic import render

        try:
            render(views, seconds, cache_directory(), progress)
        except (RuntimeError, OSError) as error:
            raise RunError(f"the synthetic drive cannot be rendered: {error}") from None


def view(camera: Camera) -> View:
    """What a camera sees of the synthetic drive.

    raises  ModelError where the drive cannot be rendered so
    """
    from runner.synthetic import View

    width, height = camera.source_size
    return View(width, height, camera.fps, camera.pose or DRIVER, camera.fov_deg, camera.lens)


def _rendered(camera: Camera) -> str | None:
    if not camera.source.render:
        return None
    from runner.synthetic import clip_path

    path = clip_path(view(camera), camera.source.render_s, cache_directory())
    return str(path) if path.exists() else None
