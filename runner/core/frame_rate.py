"""The rate at which a camera's pictures are sent: every one, or each n-th. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from fractions import Fraction
from functools import lru_cache
from math import ceil

from runner.core.model import Camera, Mode, ModeRule

LEAST_HZ = 5  # that a camera keeps of its own rate: with less no driver can judge movement


def is_given(part: str, modes: Mapping[Mode, Iterable[ModeRule]]) -> bool:
    """Whether a rule of any mode gives a part of the draft, such as frame rates: then pipelines must be able to."""
    return any(part in call.gives for calls in modes.values() for call in calls)


def sent_rate(camera: Camera, wanted: Fraction) -> Fraction:
    """The highest rate of each n-th picture that is at most the wanted one, Hz; at least `LEAST_HZ`, if it has that.

    Only such pictures are evenly spaced.
    """
    most = max(1, camera.fps // LEAST_HZ)
    return camera.fps / max(1, min(ceil(camera.fps / wanted), most))


@lru_cache(maxsize=256)  # the same object: what is known of sets of cameras is kept
def slowed(camera: Camera, wanted: Fraction) -> Camera:
    """The camera as one of the rate at which its pictures are sent."""
    fps = sent_rate(camera, wanted)
    return camera if fps == camera.fps or camera.graph.passes else replace(camera, fps=fps)
