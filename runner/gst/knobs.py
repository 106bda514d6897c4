"""Turn the knobs of a playing pipeline: all parts of one change between the same two frames."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from typing import Any

from gi.repository import Gst

from runner.core.commands import KnobValue
from runner.core.model import Camera
from runner.graph import Assignment, assignments, text
from runner.gst.caps import structure

ANOTHER_RATIO = (60001, 60000)  # of 16 bits each; below 30000 px no player rounds it to another pixel


class KnobPanel:
    """The knobs of one camera's pipeline, rebuilt with the pipeline.

    Values wait in `_waiting` until the streaming thread is between two frames: an IDLE probe before the first element
    that changes then sets them all at once. If crop edges were set one by one while a frame passes, the crop could
    be empty for a moment, which ends the stream.

    on_turned  called, from any thread, after knobs were set: `applied` holds the values read back
    """

    def __init__(self, pipeline: Gst.Bin, camera: Camera, on_turned: Callable[[], None]) -> None:
        self._camera, self._on_turned = camera, on_turned
        self._elements = [pipeline.get_by_name(element.name) for element in camera.graph.vehicle]
        self._by_name = {element.get_name(): element for element in self._elements}
        # Reentrant: new caps send an event upstream through the pad whose probe sets them, which calls the probe again.
        self._lock = threading.RLock()
        self._waiting: dict[str, KnobValue] = {}
        self.applied: dict[str, KnobValue] = {}
        self.faults: list[str] = []

    def set_now(self, values: Mapping[str, KnobValue]) -> None:
        """Set knobs of a pipeline that is not playing yet."""
        with self._lock:
            self._waiting |= values
        self._set_waiting()

    def turn(self, values: Mapping[str, KnobValue]) -> None:
        """Set knobs at the next gap between two frames; returns at once."""
        with self._lock:
            alone = not self._waiting
            self._waiting |= values
        every = [turned for knob, value in values.items() for turned in self._assignments(knob, value)]
        turned = [each for each in every if self._differs(each)] or every[:1]
        if alone and len(turned) == 1:
            # A single property needs no synchronisation: the encoder applies it from its next frame on.
            self._set_waiting()
            return
        touched = {element for element, _, _ in turned}
        first = next(element for element in self._elements if element.get_name() in touched)
        # Only a source pad knows whether a frame it has pushed is still being processed downstream.
        above = first.get_static_pad("sink").get_peer()
        above.add_probe(Gst.PadProbeType.IDLE, self._between_frames)

    def set_anew(self, knob: str) -> None:
        """Set the caps of a knob anew, with a pixel aspect ratio that differs: the encoder starts anew.

        The ratio changes between 1 and one that nobody sees.
        """
        with self._lock:
            if knob not in self.applied:
                return
            for name, _, _ in self._assignments(knob, self.applied[knob]):
                caps = self._by_name[name].get_property("caps").copy()
                _, above, below = structure(caps).get_fraction("pixel-aspect-ratio")
                caps.set_value("pixel-aspect-ratio", Gst.Fraction(*((1, 1) if above != below else ANOTHER_RATIO)))
                self._by_name[name].set_property("caps", caps)

    def _between_frames(self, _pad: Gst.Pad, _info: Gst.PadProbeInfo) -> Gst.PadProbeReturn:
        self._set_waiting()
        return Gst.PadProbeReturn.REMOVE

    def _set_waiting(self) -> None:
        with self._lock:
            values, self._waiting = self._waiting, {}
            for knob, value in values.items():
                wrong = [fault for turned in self._assignments(knob, value) if (fault := self._assign(turned))]
                self.faults += wrong
                if not wrong:
                    self.applied[knob] = value
        self._on_turned()

    def _assignments(self, knob: str, value: KnobValue) -> list[Assignment]:
        return assignments(self._camera, knob, value)

    def _assign(self, turned: Assignment) -> str | None:
        """Set one property and read it back; returns the fault, None if there is none."""
        name, key, value = turned
        element = self._by_name[name]
        if self._differs(turned):
            element.set_property(key, _property(turned))
            if self._differs(turned):
                held = text(str(element.get_property(key)))
                return f"{self._camera.name}: {name}.{key} is {held} after it was set to {text(value)}"
        return None

    def _differs(self, turned: Assignment) -> bool:
        name, key, _ = turned
        held, wanted = self._by_name[name].get_property(key), _property(turned)
        return not held.is_equal(wanted) if key == "caps" else bool(held != wanted)


def _property(turned: Assignment) -> Any:
    _, key, value = turned
    return Gst.Caps.from_string(value) if key == "caps" else value
