"""Turns the knobs of a playing pipeline: all parts of one change take effect between the same two frames."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from fractions import Fraction
from typing import Any

from gi.repository import Gst

from runner.core.commands import KnobValue
from runner.core.model import Camera, Value
from runner.gst.caps import structure
from runner.gst.placed import PlacedPictures
from runner.gst.probes import IdleProbe
from runner.gst.rate_limit import RateLimit
from runner.turning import Assignment, assignments, text

_PARSERS = {"GstCaps": Gst.Caps.from_string, "GstStructure": Gst.Structure.new_from_string}
ANOTHER_RATIO = (60001, 60000)  # of 16 bits each; below 30000 px no player rounds it to another pixel


class KnobPanel:
    """The knobs of one camera's pipeline, rebuilt with the pipeline.

    Values wait in `_pending` until the streaming thread is between two frames, when an IDLE probe before the first
    element that changes sets them all together. If crop edges were set one by one while a frame passes, the crop
    could be empty in between, which ends the stream.

    on_turned  called, from any thread, after knobs were set; `applied` has the values read back
    on_report  called, from any thread, with each value that an element rejected: a bug, or an error in a graph
    """

    def __init__(
        self, pipeline: Gst.Bin, camera: Camera, on_turned: Callable[[], None], on_report: Callable[[str], None]
    ) -> None:
        self._camera, self._on_turned, self._on_report = camera, on_turned, on_report
        self._elements = [pipeline.get_by_name(element.name) for element in camera.graph.vehicle]
        of_source = {target.element for target in camera.graph.knobs.get("bitrate", ())}  # if it passes pictures on
        self._by_name = {element.get_name(): element for element in self._elements}
        self._by_name |= {name: pipeline.get_by_name(name) for name in of_source}
        # Reentrant: setting caps sends an event upstream through the probed pad, which calls the probe again.
        self._lock = threading.RLock()
        self._pending: dict[str, KnobValue] = {}
        self.applied: dict[str, KnobValue] = {}
        self._pace = 1.0
        self.placed: PlacedPictures | None = None  # is told of each turn, between two frames
        self.dropped: RateLimit | None = None  # of the pictures that the knob `fps` leaves out; likewise
        self._between_frames = IdleProbe(self._apply_pending)

    def set_now(self, values: Mapping[str, KnobValue]) -> None:
        """Set knobs of a pipeline that is not playing yet."""
        with self._lock:
            self._pending |= values
        self._apply_pending()

    def turn(self, values: Mapping[str, KnobValue]) -> None:
        """Set knobs between the next two frames; returns immediately."""
        with self._lock:
            is_only_change = not self._pending
            bitrate = {**self.applied, **self._pending}.get("bitrate")
            if "fps" in values and bitrate is not None:
                values = {"bitrate": bitrate, **values}  # an encoder that counts frames is told another one with it
            self._pending |= values
        requested = [each for knob, value in values.items() for each in self._assignments(knob, value)]
        changed = [each for each in requested if self._differs(each)] or requested[:1]
        if is_only_change and len(changed) == 1 and "roi" not in values:
            # A single property needs no synchronisation: the encoder applies it from its next frame on. Of the region
            # it must be known which frame that is.
            self._apply_pending()
            return
        names = {name for name, _, _ in changed}
        first = next((element for element in self._elements if element.get_name() in names), None)
        if first is None:  # of a graph that passes pictures on
            self._apply_pending()
            return
        # Only a source pad knows whether a frame it has pushed is still being processed downstream.
        above = first.get_static_pad("sink").get_peer()
        self._between_frames.add_to(above)

    @property
    def pace(self) -> float:
        """As in `runner.turning.assignments`."""
        return self._pace

    @pace.setter
    def pace(self, pace: float) -> None:
        with self._lock:
            self._pace = pace
            bitrate = {**self.applied, **self._pending}.get("bitrate")
            if bitrate is not None:
                self.turn({"bitrate": bitrate})

    def restart_encoder(self, knob: str) -> None:
        """Set the caps of a knob again with another pixel aspect ratio, which restarts the encoder.

        The ratio alternates between 1 and an imperceptible deviation.
        """
        with self._lock:
            if knob not in self.applied:
                return
            for name, _, _ in self._assignments(knob, self.applied[knob]):
                caps = self._by_name[name].get_property("caps").copy()
                _, above, below = structure(caps).get_fraction("pixel-aspect-ratio")
                caps.set_value("pixel-aspect-ratio", Gst.Fraction(*((1, 1) if above != below else ANOTHER_RATIO)))
                self._by_name[name].set_property("caps", caps)

    @property
    def fps(self) -> Fraction:
        """The rate in force, Hz, that of the camera or what is left of it."""
        fps = {**self.applied, **self._pending}.get("fps")
        return fps if isinstance(fps, Fraction) else self._camera.fps

    def _apply_pending(self) -> None:
        with self._lock:
            values, fps = self._pending, self.fps
            turned = {knob: self._assignments(knob, value) for knob, value in values.items()}
            self._pending = {}
            for knob, value in values.items():
                faults = [fault for each in turned[knob] if (fault := self._assign(each))]
                if not faults:
                    self.applied[knob] = value
                for fault in faults:
                    self._on_report(fault)
            if self.placed:
                self.placed.on_turned(values)
            if self.dropped and "fps" in values:
                self.dropped.turn(float(fps))
        self._on_turned()

    def _assignments(self, knob: str, value: KnobValue) -> list[Assignment]:
        return assignments(self._camera, knob, value, self._pace * float(self._camera.fps / self.fps))

    def _assign(self, assignment: Assignment) -> str | None:
        """Set one property and read it back; returns the fault, None if there is none."""
        name, key, value = assignment
        element = self._by_name[name]
        if self._differs(assignment):
            element.set_property(key, _parsed(element, key, value))
            if self._differs(assignment):
                actual = text(str(element.get_property(key)))
                return f"{name}.{key} is {actual} after it was set to {text(value)}"
        return None

    def _differs(self, assignment: Assignment) -> bool:
        name, key, value = assignment
        actual, wanted = self._by_name[name].get_property(key), _parsed(self._by_name[name], key, value)
        if actual is None or wanted is value:
            return bool(actual != wanted)
        return not actual.is_equal(wanted)


def _parsed(element: Gst.Element, key: str, value: Value) -> Any:
    """A value as the property takes it: text for caps or a structure is parsed."""
    if not isinstance(value, str):
        return value
    parse = _PARSERS.get(element.find_property(key).value_type.name)
    return parse(value) if parse else value
