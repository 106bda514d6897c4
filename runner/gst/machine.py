"""Whether this machine can stream: plugins and sources; and what is added to plans for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from runner.errors import RunError
from runner.graph import Plan
from runner.gst.registry import require_plugins
from runner.gst.source import source_problem

if TYPE_CHECKING:
    from runner.gst.lossless import LosslessFiles
    from runner.gst.video_files import VideoFiles
    from runner.sound import SoundPlan
    from runner.voice import VoicePlan


def check_machine(
    plans: Sequence[Plan], sound: SoundPlan | None = None, voice: VoicePlan | None = None, *, strict: bool = True
) -> dict[str, str]:
    """Check that every plugin of the vehicle's side is installed and every source (file, device) opens.

    strict   a source that does not open is an error
    returns  by camera whose source does not open, why; likewise of sound and loudspeaker, by their names
    raises   RunError with the remedy, for all cameras at once
    """
    streams = [*plans, *(each for each in (sound, voice) if each)]
    require_plugins(streams, ("vehicle",))
    refused = {plan.name: why for plan in streams if (why := stream_problem(plan))}
    if refused and strict:
        others = {plan.name for plan in streams if not isinstance(plan, Plan)}
        named = ((name if name in others else f"camera {name}", why) for name, why in refused.items())
        raise RunError("\n".join(f"{name}: {why}" for name, why in named))
    return refused


def stream_problem(plan: Plan | SoundPlan | VoicePlan) -> str | None:
    """Why the source of a camera or of sound, or the loudspeaker, does not open; None if it opens."""
    if isinstance(plan, Plan):
        return source_problem(plan)
    from runner.sound import SoundPlan

    if isinstance(plan, SoundPlan):
        from runner.gst.sound_pipeline import sound_problem

        return sound_problem(plan)
    from runner.gst.loudspeaker import loudspeaker_problem

    return loudspeaker_problem(plan)


def with_video(plans: Sequence[Plan], video: VideoFiles | None, side: str) -> Sequence[Plan]:
    """The plans to build: each with a video file, if requested.

    raises  RunError with the packages to install
    """
    if video is None:
        return plans
    plans = [replace(plan, video=True) for plan in plans]
    require_plugins(plans, (side,))
    return plans


def with_lossless(plans: Sequence[Plan], files: LosslessFiles | None) -> Sequence[Plan]:
    """The plans to build: none keeps whole pictures if there is nowhere to keep them."""
    return plans if files else [replace(plan, lossless=None) for plan in plans]


def with_clip_range(plans: Sequence[Plan]) -> Sequence[Plan]:
    """The plans, those of full-range clips with the conversion to limited range."""
    if not any(element.factory == "filesrc" for plan in plans for element in plan.source):
        return plans
    from runner.gst import sequence  # cameras need none of it

    return [sequence.with_clip_range(plan) for plan in plans]
