"""A camera's source that is not watched: it is neither replaced when it freezes nor when it fails."""

from __future__ import annotations

from collections.abc import Callable

from gi.repository import Gst

from runner.graph import Plan
from runner.gst.credentials import Login
from runner.gst.decoders import DecoderWatch
from runner.gst.ip_camera import follow_cameras


def prepare_source(
    pipeline: Gst.Bin, plan: Plan, login: Login, left_out: set[str], on_report: Callable[[str], None]
) -> None:
    """Set it up in a newly built pipeline; the arguments are those of `WatchedSource`."""
    bus = (pipeline.get_parent() or pipeline).get_bus()
    if problem := login.log_in(pipeline):
        on_report(problem)
    if follow_cameras(pipeline, plan, login.accept):
        login.follow(bus)
    end = pipeline.get_by_name(plan.source[-1].name).get_static_pad("src")
    DecoderWatch(pipeline, end, left_out, on_report).follow(bus)
