"""The plans of a vehicle, with the clips that its sources render."""

from __future__ import annotations

from runner.clips import View, cache_directory, rendered, view
from runner.core.model import Progress, Vehicle
from runner.errors import RunError
from runner.graph import Plan, compile_graph


def compile_plans(vehicle: Vehicle) -> list[Plan]:
    """A plan for each camera, with its rendered clip if there is one."""
    return [
        compile_graph(camera, vehicle.media, index, clip=rendered(camera), recording=vehicle.recording)
        for index, camera in enumerate(vehicle.cameras.values())
    ]


def render_missing(vehicle: Vehicle, progress: Progress) -> None:
    """Render the clips that are not in the cache yet, or damaged there.

    raises  RunError
    """
    drives: dict[float, list[View]] = {}
    for camera in vehicle.cameras.values():
        if camera.source.render and rendered(camera) is None:
            drives.setdefault(camera.source.render_s, []).append(view(camera))
    for seconds, views in drives.items():
        from runner.synthetic import render

        try:
            render(views, seconds, cache_directory(), progress)
        except (RuntimeError, OSError, ImportError) as error:  # numba may be installed, but not load
            raise RunError(f"the synthetic drive cannot be rendered: {error}") from None
