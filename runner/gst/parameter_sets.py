"""Whether a viewer who joins later can decode a graph's stream: its later key pictures need parameter sets."""

from __future__ import annotations

from functools import lru_cache

from gi.repository import Gst, GstVideo

from runner.graph import Plan, launch, video_codec
from runner.gst.registry import missing_plugins
from runner.h264.access_unit import has_parameter_sets, starts

PICTURES, LATER, FPS = 10, 5, 25  # of a short stream, the one that is requested as a key picture, and Hz
SOURCE = f"videotestsrc num-buffers={PICTURES} ! video/x-raw,format=I420,width=320,height=192,framerate={FPS}/1"
WAIT_NS = 2 * Gst.SECOND


def parameter_set_notes(plan: Plan) -> list[str]:
    """One sentence if later key pictures lack them; a short stream is encoded to find out.

    plan  one that `may_lack_parameter_sets`

    Nothing about graphs that this machine cannot run.
    """
    if missing_plugins(plan, ("vehicle",)):
        return []
    graph, codec = plan.camera.graph, video_codec(plan.camera.graph)
    first = [element.name for element in plan.vehicle].index(graph.knobs["size"][0].element) + 1
    last = [element.factory for element in plan.vehicle].index(f"rtp{codec}pay")
    if not _lacks_sets(launch(plan.vehicle[first : last + 1]), codec):
        return []
    path = " ! ".join(element.factory for element in plan.vehicle[first : last + 1])
    cure = f"{codec}parse with config-interval: -1 in front of {plan.vehicle[last].name} adds them"
    return [f"graph.vehicle: {path}: later key pictures lack parameter sets, who joins later sees nothing; {cure}"]


@lru_cache(maxsize=64)
def _lacks_sets(elements: str, codec: str) -> bool:
    return any(not has_parameter_sets(unit, codec) for unit in _units(elements, codec)[1:] if starts(unit, codec)[0])


def _units(elements: str, codec: str) -> list[bytes]:
    """The units of a short stream as a receiver sees them; fewer if a machine cannot encode it."""
    units = f"video/x-{codec},stream-format=byte-stream,alignment=au"
    line = f"{SOURCE} ! {elements} ! rtp{codec}depay ! {units} ! appsink name=units sync=false"
    pipeline = Gst.parse_launch(line)
    try:
        pipeline.set_state(Gst.State.PAUSED)
        pipeline.get_state(WAIT_NS)
        at = LATER * Gst.SECOND // FPS
        request = GstVideo.video_event_new_upstream_force_key_unit(at, False, 1)
        sink = pipeline.get_by_name("units")
        sink.get_static_pad("sink").push_event(request)
        pipeline.set_state(Gst.State.PLAYING)
        found = []
        while sample := sink.emit("try-pull-sample", WAIT_NS):
            found.append(sample.get_buffer().extract_dup(0, sample.get_buffer().get_size()))
        return found
    finally:
        pipeline.set_state(Gst.State.NULL)
