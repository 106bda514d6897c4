"""The only place in which tests reach for elements of running pipelines, which no side shows to anybody.

Tests do so to see what nobody outside can (that no event reaches an encoder, that a picture keeps its driver's time),
or to make an element fail or stall as hardware and networks do.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any


def camera(side: Any, name: str) -> Any:
    """The `CameraPipeline` of one camera of a `VehicleSide`."""
    return side._pipeline(name)


def sender(side: Any, name: str) -> Any:
    """The pipeline by which a `VehicleSide` sends a camera."""
    return camera(side, name)._pipeline


def receiver(side: Any, name: str) -> Any:
    """The pipeline by which an `OperatorSide` receives a camera: at the moment, since it is rebuilt when it fails."""
    return side._receivers[name]._supervised._pipeline


def requested(pipeline: Any) -> list[int]:
    """Numbers of the packets that a receiver's pipeline requests again from now on, growing."""
    from runner.gst import Gst

    numbers: list[int] = []

    def note(_pad: Any, info: Any) -> Any:
        structure = info.get_event().get_structure()
        if structure and structure.get_name() == "GstRTPRetransmissionRequest":
            numbers.append(structure.get_value("seqnum"))
        return Gst.PadProbeReturn.OK

    for element in pipeline.iterate_recurse():
        if element.get_factory().get_name() == "rtpjitterbuffer":
            element.get_static_pad("sink").add_probe(Gst.PadProbeType.EVENT_UPSTREAM, note)
    return numbers


def fail(pipeline: Any, why: str) -> None:
    """Make an element of a pipeline report an error, as one does that loses its device or its connection."""
    from runner.gst import GLib, Gst

    source = next(iter(pipeline.iterate_elements()), pipeline)
    error = GLib.Error.new_literal(Gst.ResourceError.quark(), why, Gst.ResourceError.READ)
    pipeline.post_message(Gst.Message.new_error(source, error, ""))


def holding_voice(monkeypatch: Any, flows: Any) -> None:
    """Let no packet of voice reach a vehicle's jitter buffer while an event is not set."""
    from runner.gst import Gst
    from runner.gst.loudspeaker import _Heard

    before = _Heard.on_element

    def hold(_pad: Any, _info: Any) -> Any:
        flows.wait()
        return Gst.PadProbeReturn.OK

    def on_element(heard: Any, pipeline: Any, parent: Any, element: Any) -> None:
        if element.get_factory() and element.get_factory().get_name() == "rtpjitterbuffer":
            element.get_static_pad("sink").add_probe(Gst.PadProbeType.BUFFER, hold)
        before(heard, pipeline, parent, element)

    monkeypatch.setattr(_Heard, "on_element", on_element)


def losing(monkeypatch: Any, kind: str, pad: str, is_lost: Callable[[Any], bool], stream: str | None = None) -> None:
    """Let each element of a kind in an operator's receivers lose packets at a pad.

    A relay would decide about packets of all cameras and of the control link, and could not know when it may.

    is_lost  called with each buffer
    stream   camera, or sound, whose receiver it is; None: all
    """
    from runner.gst import Gst
    from runner.gst.stream_receiver import StreamReceiver

    before = StreamReceiver._on_element

    def lose(_pad: Any, info: Any) -> Any:
        return Gst.PadProbeReturn.DROP if is_lost(info.get_buffer()) else Gst.PadProbeReturn.OK

    def on_element(receiver: Any, pipeline: Any, parent: Any, element: Any) -> None:
        before(receiver, pipeline, parent, element)
        is_meant = stream in (None, receiver._name) and element.get_factory()
        if is_meant and element.get_factory().get_name() == kind:
            element.get_static_pad(pad).add_probe(Gst.PadProbeType.BUFFER, lose)

    monkeypatch.setattr(StreamReceiver, "_on_element", on_element)


def storing_video_at(monkeypatch: Any, directory: Path, device: str, queue_bytes: int = 8_000_000) -> None:
    """Make the files of both sides' video links to a device: no directory stands for a disk that is full or hangs.

    queue_bytes  how much may wait for it
    """
    from runner import graph
    from runner.gst import lossless, video_files

    def new_file(_directory: Path, name: str, suffix: str) -> Path:
        path = directory / f"{name}.{suffix}"
        path.symlink_to(device)
        return path

    for module in (video_files, lossless):
        monkeypatch.setattr(module, "new_file", new_file)
    monkeypatch.setitem(graph._FILE_QUEUE.properties, "max-size-bytes", queue_bytes)


def nal_types(buffer):
    """Of an access unit whose NAL units have lengths in front of them."""
    data, at, types = buffer.extract_dup(0, buffer.get_size()), 0, []
    while at < len(data):
        types.append(data[at + 4] & 0x1F)
        at += 4 + int.from_bytes(data[at : at + 4], "big")
    return types
