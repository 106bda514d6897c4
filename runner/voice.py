"""The operator's voice as a `VoicePlan`: plain elements for both sides. Pure text, as `runner.sound` is for sound."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from runner.core.budget import VOICE, sound_kbps
from runner.core.model import Element, Kbps, ModelError
from runner.graph import check_free, launch, names_of, shell
from runner.placeholders import filling
from runner.settings import Media, Voice

MICROPHONE, DEPAY = "microphone", "depay0"  # names by which elements are found


@dataclass(frozen=True, slots=True)
class VoicePlan:
    """The compiled voice: everything resolved, nothing started.

    operator     elements from the page's microphone to the RTSP client
    decoding     elements behind the vehicle's RTSP server
    loudspeaker  elements that play what these decode
    wire_*       what `print` adds in place of the page, RTSP client and server
    wire_kbps    on the downlink, with headers, while somebody speaks
    source       no elements: the vehicle receives
    others       as in `runner.sound.SoundPlan`
    """

    operator: tuple[Element, ...]
    decoding: tuple[Element, ...]
    loudspeaker: tuple[Element, ...]
    wire_microphone: tuple[Element, ...]
    wire_operator: tuple[Element, ...]
    wire_vehicle: tuple[Element, ...]
    packet_ms: int
    jitter_buffer_ms: int
    dscp: int
    wire_kbps: Kbps
    needs: Mapping[str, str] = field(default_factory=dict)
    source: tuple[Element, ...] = ()
    name: str = VOICE

    @property
    def vehicle(self) -> tuple[Element, ...]:
        return (*self.decoding, *self.loudspeaker)

    @property
    def lists(self) -> dict[str, dict[str, tuple[Element, ...]]]:
        """As of `runner.sound.SoundPlan`."""
        return {
            "vehicle": {
                "vehicle": self.decoding,
                "loudspeaker": self.loudspeaker,
                "wire.vehicle": self.wire_vehicle,
            },
            "operator": {
                "operator": self.operator,
                "wire.microphone": self.wire_microphone,
                "wire.operator": self.wire_operator,
            },
        }

    @property
    def server(self) -> str:
        """The launch string of the RTSP factory."""
        return f"( {launch(self.vehicle)} )"

    @property
    def sender(self) -> str:
        """The operator's side as GStreamer parses it."""
        return launch(self.operator)

    def vehicle_line(self) -> str:
        """Arguments for gst-launch-1.0, quoted for a shell, starting at a network source."""
        return shell((*self.wire_vehicle, *self.vehicle))

    def operator_line(self) -> str:
        """Arguments for gst-launch-1.0, quoted for a shell, ending in a network sink."""
        return shell((*self.wire_microphone, *self.operator[1:-1], *self.wire_operator))


def compile_voice(voice: Voice, media: Media) -> VoicePlan:
    """Resolve the placeholders of all elements.

    raises  ModelError for an unknown placeholder, a name that two elements have, or one by which none is found
    """
    fill = filling(voice, media, VOICE, file=voice.file)
    _check_names(voice)
    return VoicePlan(
        operator=fill(voice.operator, "operator"),
        decoding=fill(voice.vehicle, "vehicle"),
        loudspeaker=fill(voice.loudspeaker, "loudspeaker"),
        wire_microphone=fill(voice.wire_microphone, "wire.microphone"),
        wire_operator=fill(voice.wire_operator, "wire.operator"),
        wire_vehicle=fill(voice.wire_vehicle, "wire.vehicle"),
        packet_ms=voice.packet_ms,
        jitter_buffer_ms=voice.jitter_buffer_ms,
        dscp=voice.dscp,
        wire_kbps=sound_kbps(voice.kbps, voice.packet_ms, voice.header_bytes),
        needs=voice.needs,
    )


def _check_names(voice: Voice) -> None:
    """`vehicle` and `loudspeaker` become one pipeline, in which elements are found by name."""
    check_free("vehicle", voice.vehicle, {})
    check_free("loudspeaker", voice.loudspeaker, names_of("vehicle", voice.vehicle))
    for key, element, name in (("operator", voice.operator[0], MICROPHONE), ("vehicle", voice.vehicle[0], DEPAY)):
        if element.name != name:
            raise ModelError(f"{key}[0].name", repr(element.name), f"must be {name}, by which it is found")
