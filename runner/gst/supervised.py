"""Vehicle pipelines that bring their own network sink: they run by themselves and are built anew when they fail."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from gi.repository import GLib, Gst

from runner.graph import Plan
from runner.gst.pipeline import Build, CameraPipeline

RETRY_MS = 500


class SupervisedPipeline:
    """A pipeline that is torn down and built anew when it fails or ends; it is never repaired in place.

    on_built  told of each new pipeline before it starts
    report    told what happened
    """

    def __init__(self, launch: str, on_built: Callable[[Gst.Pipeline], None], report: Callable[[str], None]) -> None:
        self._launch, self._on_built, self._report = launch, on_built, report
        self._pipeline: Gst.Pipeline | None = None
        self._retry = 0
        self.rebuilt = -1

    def start(self) -> None:
        self.rebuilt += 1
        pipeline = Gst.parse_launch(self._launch)
        if not isinstance(pipeline, Gst.Pipeline):  # a single element comes without one
            element, pipeline = pipeline, Gst.Pipeline.new(None)
            pipeline.add(element)
        self._pipeline = pipeline
        bus = pipeline.get_bus()
        bus.add_signal_watch()
        bus.connect("message::error", self._on_failed)
        bus.connect("message::eos", self._on_failed)
        self._on_built(pipeline)
        pipeline.set_state(Gst.State.PLAYING)

    def stop(self) -> None:
        if self._retry:
            GLib.source_remove(self._retry)
            self._retry = 0
        if self._pipeline is not None:
            self._pipeline.get_bus().remove_signal_watch()
            self._pipeline.set_state(Gst.State.NULL)
            self._pipeline = None

    def restart(self, why: str) -> None:
        """Tear down now, build anew soon."""
        if self._retry:
            return
        self._report(why)
        self.stop()
        self._retry = GLib.timeout_add(RETRY_MS, self._again)

    def _again(self) -> bool:
        self._retry = 0
        self.start()
        return False

    def _on_failed(self, _bus: Gst.Bus, message: Gst.Message) -> None:
        failed = message.type == Gst.MessageType.ERROR
        self.restart(message.parse_error()[0].message if failed else "the stream ended")


class CameraCaller:
    """One camera's supervised pipeline on the vehicle.

    build  makes a `CameraPipeline` of each that was built
    """

    def __init__(self, plan: Plan, build: Build, report: Callable[[str, str], None]) -> None:
        self._plan, self._build = plan, build
        name = plan.camera.name
        self.pipeline: CameraPipeline | None = None
        self._supervised = SupervisedPipeline(plan.pipeline, self._on_built, lambda what: report(name, what))

    def start(self) -> None:
        self._supervised.start()

    def stop(self) -> None:
        self.pipeline = None
        self._supervised.stop()

    def _on_built(self, pipeline: Any) -> None:
        self.pipeline = self._build(pipeline, self._plan)
