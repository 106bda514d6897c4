"""The vehicle's sound as a `SoundPlan`: plain elements for both sides. Pure text, as `runner.graph` is for cameras."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from runner.core.budget import SOUND
from runner.core.graph_settings import GraphSettings
from runner.core.model import Element, Kbps, ModelError
from runner.graph import check_free, launch, names_of, shell
from runner.placeholders import filling
from runner.settings import Media, Sound


@dataclass(frozen=True, slots=True)
class SoundPlan:
    """The compiled sound: everything resolved, nothing started.

    settings   what the RTSP server and the receiver's session read themselves, as of a camera's graph
    source     elements that produce raw sound
    vehicle    elements after the source
    operator   elements of the operator's side
    wire_*     what `print` adds in place of RTSP server and client
    packet_ms  of sound in a packet
    wire_kbps  of one copy, with headers
    repeats    whether its source is a clip that begins again when it has ended
    needs      by element that only the vehicle may have, the package that provides it
    """

    settings: GraphSettings
    source: tuple[Element, ...]
    vehicle: tuple[Element, ...]
    operator: tuple[Element, ...]
    wire_vehicle: tuple[Element, ...]
    wire_operator: tuple[Element, ...]
    packet_ms: int
    wire_kbps: Kbps
    repeats: bool = False
    needs: Mapping[str, str] = field(default_factory=dict)
    name: str = SOUND

    @property
    def lists(self) -> dict[str, dict[str, tuple[Element, ...]]]:
        """By side, its elements by the key that lists them."""
        return {
            "vehicle": {"source": self.source, "vehicle": self.vehicle, "wire.vehicle": self.wire_vehicle},
            "operator": {"operator": self.operator, "wire.operator": self.wire_operator},
        }

    @property
    def pipeline(self) -> str:
        """The vehicle's side as GStreamer parses it."""
        return launch((*self.source, *self.vehicle))

    @property
    def server(self) -> str:
        """The launch string of the RTSP factory."""
        return f"( {self.pipeline} )"

    @property
    def receiver(self) -> str:
        """The operator's side as GStreamer parses it."""
        return launch(self.operator)

    def receiver_into(self, sink: str) -> str:
        """The same with another sink, given as text."""
        return f"{launch(self.operator[:-1])} ! {sink}"

    def vehicle_line(self) -> str:
        """Arguments for gst-launch-1.0, quoted for a shell, ending in a network sink."""
        return shell((*self.source, *self.vehicle, *self.wire_vehicle))

    def operator_line(self) -> str:
        """Arguments for gst-launch-1.0, quoted for a shell, starting at a network source."""
        return shell((*self.wire_operator, *self.operator[1:]))


def compile_sound(sound: Sound, media: Media) -> SoundPlan:
    """Resolve the placeholders of all elements.

    raises  ModelError for an unknown placeholder, a name that two elements have, or a last element that is not pay0
    """
    fill = filling(sound, media, SOUND, clip=sound.clip)
    _check_names(sound)
    return SoundPlan(
        settings=GraphSettings(
            sound.port, header_bytes=sound.header_bytes, jitter_buffer_ms=sound.jitter_buffer_ms, dscp=sound.dscp
        ),
        source=fill(sound.source, "source"),
        vehicle=fill(sound.vehicle, "vehicle"),
        operator=fill(sound.operator, "operator"),
        wire_vehicle=fill(sound.wire_vehicle, "wire.vehicle"),
        wire_operator=fill(sound.wire_operator, "wire.operator"),
        packet_ms=sound.packet_ms,
        wire_kbps=sound.wire_kbps,
        repeats=sound.needs_clip,
        needs=sound.needs,
    )


def _check_names(sound: Sound) -> None:
    """Source and vehicle become one pipeline, in which elements are found by name."""
    check_free("source", sound.source, {})
    check_free("vehicle", sound.vehicle, names_of("source", sound.source))
    if sound.vehicle[-1].name != "pay0":
        key = f"vehicle[{len(sound.vehicle) - 1}].name"
        raise ModelError(key, repr(sound.vehicle[-1].name), "must be pay0, as the RTSP server requires")
    if "depay" not in (element.name for element in sound.operator):
        raise ModelError("operator", None, "must have a depayloader named depay, in front of which packets are counted")
