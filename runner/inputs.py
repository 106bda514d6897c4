"""The files that cameras play: clips and bags."""

from __future__ import annotations

from pathlib import Path

from runner.core.model import Camera, ModelError
from runner.system.files import file_problem


def input_problem(camera: Camera) -> ModelError | None:
    """Why the clip or bag that a camera's source plays cannot be read; None if it can, or none is configured."""
    return clip_problem(camera) or bag_problem(camera)


def clip_problem(camera: Camera) -> ModelError | None:
    """Why the camera's clip cannot be read; None as for `input_problem`."""
    clip = _given(camera, "clip")
    if clip is None or "clip" not in camera.source.placeholders or camera.source.render:
        return None
    why = file_problem(Path(clip))
    return ModelError("clip", repr(clip), why) if why else None


def bag_problem(camera: Camera) -> ModelError | None:
    """Why the camera's bag has no supported pictures of its topic; None as for `input_problem`."""
    bag = _given(camera, "bag")
    if bag is None or not camera.source.plays_bags:
        return None
    from runner.bag import check_topic

    try:
        check_topic(Path(bag), _given(camera, "topic"))
    except ModelError as error:
        return error
    return None


def _given(camera: Camera, key: str) -> str | None:
    value = camera.mount.get(key, camera.source.settings.get(key))
    return None if value is None else str(value)
