"""What elements of sound and voice may refer to as {placeholders}."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from runner.core.model import Element, Value
from runner.graph import filled, rtsp_url
from runner.settings import Endpoint, Media, Sound, Voice

Fill = Callable[[Iterable[Element], str], tuple[Element, ...]]


def filling(stream: Sound | Voice, media: Media, name: str, **own: Value | None) -> Fill:
    """A function that resolves the placeholders of elements, which stand at a key.

    name  of the stream at the RTSP server
    own   values that this stream alone has
    """
    values: dict[str, Value | None] = {
        **own,
        "device": stream.device,
        "bps": 1000 * stream.kbps,
        "packet_ms": stream.packet_ms,
        "jitter_buffer_ms": stream.jitter_buffer_ms,
        "host": media.host,
        "url": rtsp_url(media, name),
        "port": stream.port,
        "endpoint": str(Endpoint(media.host, stream.port)),
    }

    def fill(elements: Iterable[Element], where: str) -> tuple[Element, ...]:
        return tuple(filled(element, values, f"{where}[{i}]") for i, element in enumerate(elements))

    return fill
