"""What the operator's side writes of a drive: what the vehicle says, and what comes of each camera."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from runner.control import Document
from runner.drive.log import Log
from runner.station import Station


def listener(station: Station, log: Log) -> Callable[[str, Document], None]:
    """To be added to the station's listeners: writes all that is new into the log."""

    def write(kind: str, message: Document) -> None:
        if kind == "sample":
            log.tell("sample", **_sample(station, log, message))
        elif kind == "state":
            log.tell("state", **{key: value for key, value in message.items() if key != "t"})  # `t` is the vehicle's
        elif kind == "note":
            log.tell("note", text=message["text"])

    return write


def _sample(station: Station, log: Log, message: Document) -> dict[str, Any]:
    """A sample as the station tells it, with the counters behind the rates and every access unit that came."""
    cameras = {}
    for name, camera in message["cameras"].items():
        received = station.samples[name]
        counters = {"frames": received.frames, "bytes": received.bytes}
        cameras[name] = camera | counters | {"arrivals": _arrivals(received.arrivals, log.time)}
    return {key: value for key, value in message.items() if key != "time"} | {"cameras": cameras}


def _arrivals(arrivals: Iterable[tuple[float, float | None]], began: float) -> list[tuple[float, float | None]]:
    """When each unit came, s since the beginning, and how long after its capture, ms."""
    return [
        (round(arrived - began, 4), None if captured is None else round(1000 * (arrived - captured), 2))
        for arrived, captured in arrivals
    ]
