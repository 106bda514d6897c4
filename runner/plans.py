"""The plans of a vehicle, with the clips that its sources render."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING

from runner.clips import View, cache_directory, rendered, view
from runner.core.model import Camera, Progress, Vehicle
from runner.errors import RunError
from runner.graph import Plan, compile_graph, rtsp_url
from runner.settings import Media, Setup

if TYPE_CHECKING:
    from runner.sound import SoundPlan
    from runner.voice import VoicePlan


def compile_plans(setup: Setup) -> list[Plan]:
    """A plan for each camera, with its rendered clip if there is one."""
    return [
        compile_graph(
            camera,
            setup.media,
            index,
            clip=rendered(camera),
            recording=setup.recording,
            lossless=setup.log.lossless.get(camera.name),
        )
        for index, camera in enumerate(setup.vehicle.cameras.values())
    ]


def sound_plan(setup: Setup) -> SoundPlan | None:
    """That of the vehicle's sound; None: it sends none."""
    if setup.sound is None:
        return None
    from runner.sound import compile_sound

    return compile_sound(setup.sound, setup.media)


def voice_plan(setup: Setup) -> VoicePlan | None:
    """That of the operator's voice; None: the vehicle has no loudspeaker."""
    if setup.voice is None:
        return None
    from runner.voice import compile_voice

    return compile_voice(setup.voice, setup.media)


def other_plans(setup: Setup) -> tuple[SoundPlan | None, VoicePlan | None]:
    """Those of streams beside the cameras'."""
    return sound_plan(setup), voice_plan(setup)


def stream_addresses(media: Media, plans: Iterable[Plan], *others: SoundPlan | VoicePlan | None) -> Iterator[str]:
    """Where each stream of a vehicle is, in words."""
    for plan in plans:
        yield f"{plan.camera.name}: {rtsp_url(media, plan.camera.name) if plan.serves else 'connects to the operator'}"
    yield from (f"{other.name}: {rtsp_url(media, other.name)}" for other in others if other)


def as_offered(setup: Setup, report: Callable[[str], None]) -> Setup:
    """The setup with the rates that V4L2 devices state: 29.97 Hz stands for 30000/1001. Reports each change."""
    cameras = dict(setup.vehicle.cameras)
    for name, camera in setup.vehicle.cameras.items():
        if (rate := nearest_rate(camera)) and camera.capture.fps:
            report(f"{name}: {camera.device} captures at {rate} Hz, the nearest to {float(camera.capture.fps):g}")
            cameras[name] = replace(camera, capture=replace(camera.capture, fps=rate))
    return setup.with_cameras(cameras)


def nearest_rate(camera: Camera) -> Fraction | None:
    """The rate that a camera's device offers in place of the configured one; None: that one, none close, or unknown."""
    if camera.device is None or camera.capture.fps is None:
        return None
    from runner.system.v4l2 import Device, offered_rate

    try:
        device = Device(Path(camera.device))
    except OSError:
        return None
    with closing(device):
        rate = offered_rate(device.formats(), camera.capture) if device.capability.captures else None
    return rate if rate != camera.capture.fps else None


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


def drive_steering(setup: Setup) -> Callable[[float], float] | None:
    """The steering angle in the pictures of a synthetic drive: rad, by s of the monotonic clock, which they follow.

    returns  None: no camera shows such a drive, or the vehicle's dimensions are unknown
    """
    lengths = [camera.source.render_s for camera in setup.vehicle.cameras.values() if camera.source.render]
    if not (lengths and setup.dimensions):
        return None
    from runner.synthetic.course import plan_course

    course, seconds, wheelbase_m = plan_course(lengths[0]), lengths[0], setup.dimensions.wheelbase_m
    return lambda now: course.steering(now % seconds / seconds, wheelbase_m)
