"""Compile a camera's pipeline graph into a `Plan`: plain elements for both sides and the knobs to turn. Pure text."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace

from runner.core.commands import KnobValue
from runner.core.graph_settings import GraphSettings, KnobCommand
from runner.core.model import (
    PLACEHOLDER,
    BagTopic,
    Camera,
    Element,
    Graph,
    ModelError,
    Source,
    Value,
)
from runner.errors import suggest
from runner.settings import Endpoint, Lossless, Media, Recording
from runner.turning import per_frame_rate, text, turn_elements

_PLAIN_VALUE = re.compile(r"[\w./:,+=@%-]+")
# Without colorimetry, decoders derive it from the picture size: colours would change when a picture is scaled.
COLORIMETRY = "colorimetry=bt709"
_PICTURE = f"pixel-aspect-ratio=1/1,{COLORIMETRY}"
SRT_MOST_BYTES = 1316  # of a packet; srtsink cuts longer ones unless its URI states a `payloadsize`
# Before the encoder of a recording. Frames that find the queue full are dropped and counted, so that a slow encoder or
# disk never blocks the camera: 128 MB are 42 frames of 1920x1040. `recorded` counts the frames kept.
_QUEUE: dict[str, Value] = {
    "leaky": "upstream",
    "max-size-bytes": 128_000_000,
    "max-size-buffers": 0,
    "max-size-time": 0,
}
_RECORDED = (
    Element("waiting", "queue", _QUEUE),
    Element("recorded", "identity", {"single-segment": True}),
)
_WRITER = Element("writer", "filesink", {})
# The branch after the tee writes a side's video, as sent or received, into a file. Its element names contain a hyphen,
# which is not allowed in a graph. Its queue drops the oldest data, so that a slow disk never blocks the stream: 8 MB
# are 10 s at 6 Mbit/s. The gate closes when writing fails, see runner/gst/video_files.py. Each frame is written
# immediately, in case the process is killed.
_TEE = Element("video-tee", "tee", {})
_FILE_GATE = Element("video-gate", "valve", {})
_FILE_QUEUE = Element(
    "video-queue",
    "queue",
    {"leaky": "downstream", "max-size-bytes": 8_000_000, "max-size-buffers": 0, "max-size-time": 0},
)
_FILE_MUXER = Element("video-muxer", "mpegtsmux", {})
_FILE_SINK = Element(
    "video-file",
    "filesink",
    {"sync": False, "async": False, "enable-last-sample": False, "buffer-mode": "unbuffered"},
)
# The branch behind the source keeps whole pictures without loss, see runner/gst/lossless.py. Its gate is closed at
# first; `arrived` counts the pictures that pass it.
LOSSLESS = "lossless-"
_LOSSLESS_TEE = Element(f"{LOSSLESS}tee", "tee", {})
_LOSSLESS_GATE = Element("gate", "valve", {"drop": True})
_ARRIVED = Element("arrived", "identity", {})
_LOSSLESS_SINK = Element("file", "filesink", {"sync": False, "async": False, "enable-last-sample": False})
_COUNTERS = {"vehicle": "sent", "operator": "received"}  # by side, the identity that the tee follows
CODECS = ("h264", "h265")  # supported in video files and on the operator's page
FEEDBACK = "feedback"  # second part of a camera's path on the RTSP server: the same stream, with feedback
_FROZEN_INTERVALS = 10  # frame intervals, so that a low frame rate does not count as frozen


@dataclass(frozen=True, slots=True)
class Plan:
    """One compiled camera: everything resolved, nothing started.

    source     elements that produce raw frames; a stand-in while their clip is not rendered
    loops      whether the source is a clip that restarts at its end
    printed    the source as `print` shows it: a stand-in for frames that come from Python
    stands_in  whether that is a stand-in
    vehicle    elements after the source
    operator   elements of the operator's side
    wire_*     what `print` adds in place of RTSP server and client
    recorder   elements that follow the source when it is recorded, without the file; empty if it is not
    command    sets the bitrate in the camera, with {kbps} and {bps} in its words; None: none does
    bag        pictures that are pushed into the first element of the source; None: none
    needs      by element that only the vehicle may have, the package that provides it
    video      whether each side also writes what it sends or receives into a file
    lossless   how much of its whole pictures the vehicle keeps; None: none
    """

    camera: Camera
    source: tuple[Element, ...]
    loops: bool
    printed: tuple[Element, ...]
    stands_in: bool
    vehicle: tuple[Element, ...]
    operator: tuple[Element, ...]
    wire_vehicle: tuple[Element, ...]
    wire_operator: tuple[Element, ...]
    recorder: tuple[Element, ...] = ()
    command: KnobCommand | None = None
    bag: BagTopic | None = None
    needs: Mapping[str, str] = field(default_factory=dict)
    video: bool = False
    lossless: Lossless | None = None

    @property
    def name(self) -> str:
        return self.camera.name

    @property
    def settings(self) -> GraphSettings:
        return self.camera.graph.settings

    @property
    def serves(self) -> bool:
        """Whether an RTSP server carries the stream; otherwise the graph has its own network sink and source."""
        return self.camera.graph.transport == "rtsp"

    @property
    def frozen_s(self) -> float | None:
        """Without a frame for this long, s, the source counts as frozen and is replaced; None: it is not watched."""
        frozen_s = self.camera.source.frozen_s
        return None if frozen_s is None else max(frozen_s, _FROZEN_INTERVALS / float(self.camera.fps))

    @property
    def pipeline(self) -> str:
        """The vehicle's side as GStreamer parses it, before knobs are turned."""
        tee = (_LOSSLESS_TEE,) if self.lossless else ()
        branch = f" {_LOSSLESS_TEE.name}. ! {launch(self.lossless_elements)}" if self.lossless else ""
        return launch((*self.source, *tee, *self._teed("vehicle", self.vehicle))) + self._file_branch + branch

    @property
    def entry(self) -> str:
        """Name of the element that the source is linked to."""
        return _LOSSLESS_TEE.name if self.lossless else self.vehicle[0].name

    @property
    def server(self) -> str | None:
        """The launch string of the RTSP factory."""
        return f"( {self.pipeline} )" if self.serves else None

    @property
    def receiver(self) -> str:
        """The operator's side as GStreamer parses it."""
        return launch(self._teed("operator", self.operator)) + self._file_branch

    def receiver_into(self, sink: str) -> str:
        """The same with another sink, given as text."""
        return f"{launch(self._teed('operator', self.operator[:-1]))} ! {sink}{self._file_branch}"

    @property
    def video_elements(self) -> tuple[Element, ...]:
        """Elements between the stream and its file; none without a file."""
        if not self.video:
            return ()
        codec = video_codec(self.camera.graph)
        # A reader of the file needs the parameter sets at each keyframe.
        parser = Element("video-parser", f"{codec}parse", {"config-interval": -1})
        return (_FILE_GATE, _FILE_QUEUE, parser, _FILE_MUXER, _FILE_SINK)

    @property
    def lossless_elements(self) -> tuple[Element, ...]:
        """Elements between the source and the file that keeps its pictures; none without one."""
        if not self.lossless:
            return ()
        elements = (_LOSSLESS_GATE, _ARRIVED, *_RECORDED, *self.recorder, _LOSSLESS_SINK)
        return tuple(replace(element, name=f"{LOSSLESS}{element.name}") for element in elements)

    @property
    def _file_branch(self) -> str:
        return f" {_TEE.name}. ! {launch(self.video_elements)}" if self.video else ""

    def _teed(self, side: str, elements: tuple[Element, ...]) -> tuple[Element, ...]:
        """With a tee after the element that counts, if there is a file."""
        if not self.video:
            return elements
        after = [element.name for element in elements].index(_COUNTERS[side]) + 1
        return (*elements[:after], _TEE, *elements[after:])

    def recording(self, path: str) -> str:
        """The pipeline that records the source into a file, as GStreamer parses it."""
        return launch(self.recorded(path))

    def recorded(self, path: str) -> tuple[Element, ...]:
        """The elements of that pipeline."""
        return (*self.source, *_RECORDED, *self.recorder, replace(_WRITER, properties={"location": path}))

    def vehicle_line(self, knobs: Mapping[str, KnobValue]) -> str:
        """Arguments for gst-launch-1.0 with the knobs turned, quoted for a shell, ending in a network sink."""
        return shell(turn_elements(self.camera, (*self.printed, *self.vehicle, *self.wire_vehicle), knobs))

    def operator_line(self) -> str:
        """Arguments for gst-launch-1.0, quoted for a shell, beginning with the source that `vehicle_line` sends to."""
        # If there are wire elements, they replace the RTSP client, the first element.
        return shell((*self.wire_operator, *self.operator[1:]) if self.wire_operator else self.operator)


def compile_graph(
    camera: Camera,
    media: Media,
    index: int = 0,
    clip: str | None = None,
    recording: Recording | None = None,
    lossless: Lossless | None = None,
) -> Plan:
    """Fill the placeholders of a camera's source and graph.

    media      the vehicle's RTSP server
    index      number of the camera in its vehicle, for ports
    clip       path of the rendered clip, if the source renders one and it exists
    recording  how the source's frames are stored without loss
    lossless   how much of them a drive keeps; None: none
    raises     ModelError for a placeholder without a value, a name that the source shares with a later element, or
               packets that SRT would cut, and if whole pictures are to be kept of a camera that encodes by itself
    """
    graph, source = camera.graph, camera.source
    recorder = recording.elements if recording and not graph.passes else ()
    _check_names(graph, source, recorder)
    _check_packets(graph)
    if lossless and graph.passes:
        rule = "needs raw pictures, but this camera is passed on as it encodes: log.video=true keeps what it sends"
        raise ModelError("log.lossless", None, rule, "graph.passes")
    values = _values(camera, media, index, clip)

    def fill(elements: Iterable[Element], where: str) -> tuple[Element, ...]:
        return tuple(filled(element, values, f"{where}[{i}]") for i, element in enumerate(elements))

    stand_in = fill(source.stand_in, "source.stand_in")
    unrendered = bool(source.render) and clip is None
    passes = graph.passes
    if passes and passes not in source.encoded:
        raise ModelError("graph.passes", passes, "needs a source with `encoded` pictures of this format, such as rtsp")
    elements, key = (source.encoded[passes], f"encoded.{passes}") if passes else (source.elements, "elements")
    if passes:
        _check_source_knobs(camera, elements)
    frames = stand_in if unrendered else fill(elements, f"source.{key}")
    stands_in = bool(stand_in) and clip is None
    return Plan(
        camera=camera,
        source=frames,
        loops=source.loop and not unrendered and not source.plays_bags,
        printed=stand_in if stands_in else frames,
        stands_in=stands_in,
        vehicle=fill(graph.vehicle, "graph.vehicle"),
        operator=fill(graph.operator, "graph.operator"),
        wire_vehicle=fill(graph.wire_vehicle, "graph.wire.vehicle"),
        wire_operator=fill(graph.wire_operator, "graph.wire.operator"),
        recorder=fill(recorder, "recording.elements"),
        command=graph.command and _filled_command(graph.command, values),
        bag=bag_topic(camera),
        needs={**source.needs, **graph.needs, **(recording.needs if recording else {})},
        lossless=lossless,
    )


def bag_topic(camera: Camera) -> BagTopic | None:
    """The bag and topic that a camera's source plays; None if it plays none or they are not configured."""
    path, topic = (camera.mount.get(key, camera.source.settings.get(key)) for key in ("bag", "topic"))
    if not (camera.source.plays_bags and path and topic):
        return None
    return BagTopic(str(path), str(topic), camera.source.depth_m)


def check_video(graph: Graph) -> None:
    """Check that both sides can write their video into a file.

    raises  ModelError
    """
    for side, elements in (("vehicle", graph.vehicle), ("operator", graph.operator)):
        if _COUNTERS[side] not in (element.name for element in elements):
            rule = f"log.video needs an identity named {_COUNTERS[side]} where the stream is encoded"
            raise ModelError(f"graph.{side}", None, rule, "log.video")
    if not video_codec(graph):
        raise ModelError("graph.vehicle", None, f"log.video needs one of {', '.join(CODECS)}", "log.video")


def launch(elements: Iterable[Element]) -> str:
    """Text for gst_parse_launch."""
    return " ! ".join(" ".join(_tokens(element, _quoted)) for element in elements)


def shell(elements: Iterable[Element]) -> str:
    """Arguments for gst-launch-1.0 as a shell reads them."""
    return " ! ".join(" ".join(map(shlex.quote, _tokens(element, str))) for element in elements)


def rtsp_url(media: Media, camera: str, *, feedback: bool = False) -> str:
    """Where a vehicle serves a camera; with feedback, to clients that request lost packets again (RFC 4585)."""
    path = f"{camera}/{FEEDBACK}" if feedback else camera
    return f"{'rtsps' if media.secure else 'rtsp'}://{media}/{path}"


def video_codec(graph: Graph) -> str:
    """Codec of a graph from the names of its elements (x264enc, rtph264pay, ...); "" if it is not in `CODECS`."""
    factories = [element.factory for element in (*graph.vehicle, *graph.operator)]
    return next((codec for codec in CODECS if any(codec in factory for factory in factories)), "")


def places_pictures(graph: Graph) -> bool:
    """Whether an encoded picture says which part of the full image it shows, see `runner.h264.region`."""
    return graph.passes is None and "roi" in graph.knobs and video_codec(graph) == "h264"


def may_lack_parameter_sets(plan: Plan) -> bool:
    """Whether key pictures after the first may lack parameter sets: unless a payloader repeats them at each."""
    codec = video_codec(plan.camera.graph)
    payloader = next((element for element in plan.vehicle if element.factory == f"rtp{codec}pay"), None)
    # rtph265pay does so only for IDR pictures, and x265 sends CRA pictures.
    places = ("rtph264pay", "h264parse", "h265parse")
    repeats = any(e.properties.get("config-interval") == -1 for e in plan.vehicle if e.factory in places)
    return payloader is not None and not repeats


def _check_names(graph: Graph, source: Source, recorder: Iterable[Element]) -> None:
    """Source and graph become one pipeline, source and recording another; elements are found by name."""
    sent = names_of("graph.wire.vehicle", graph.wire_vehicle) | names_of("graph.vehicle", graph.vehicle)
    played = names_of("source.stand_in", source.stand_in) | names_of("source.elements", source.elements)
    check_free("source.elements", source.elements, sent)
    check_free("source.stand_in", source.stand_in, sent)
    check_free("recording.elements", recorder, played | names_of("recording.elements", (*_RECORDED, _WRITER)))


def names_of(where: str, elements: Iterable[Element]) -> dict[str, str]:
    """By name of an element, its key."""
    return {element.name: f"{where}[{index}].name" for index, element in enumerate(elements)}


def check_free(where: str, elements: Iterable[Element], taken: Mapping[str, str]) -> None:
    """Check that elements have names of their own.

    taken  names of others, with the key of each
    """
    known = dict(taken)
    for name, key in ((element.name, f"{where}[{index}].name") for index, element in enumerate(elements)):
        if name in known:
            raise ModelError(key, repr(name), "is already the name of another element", known[name])
        known[name] = key


def _check_source_knobs(camera: Camera, elements: tuple[Element, ...]) -> None:
    """Knobs of a graph that passes pictures on may turn elements of the source, where these stay."""
    names = [element.name for element in camera.graph.vehicle]
    for index, target in enumerate(camera.graph.knobs["bitrate"]):
        known = [*names, *(element.name for element in elements)]
        where = f"graph.knobs.bitrate[{index}].element"
        if target.element not in known:
            raise ModelError(where, repr(target.element), f"no such element{suggest(target.element, known)}")
        if target.element not in names and camera.source.frozen_s is not None:
            rule = "is of a source that is replaced when it freezes: it must be monitored by nobody (null)"
            raise ModelError("source.frozen_s", camera.source.frozen_s, rule, where)


def _filled_command(command: KnobCommand, values: Mapping[str, Value | None]) -> KnobCommand:
    kept = {**values, **{name: f"{{{name}}}" for name in ("kbps", "bps")}}
    words = enumerate(command.words)
    filled = (str(_fill_value(word, kept, f"graph.knobs.bitrate[0].command[{at}]")) for at, word in words)
    return replace(command, words=tuple(filled))


def _check_packets(graph: Graph) -> None:
    size = graph.settings.mtu_bytes
    uris = {n: str(e.properties.get("uri")) for n, e in enumerate(graph.vehicle) if e.factory == "srtsink"}
    sinks = [place for place, uri in uris.items() if "payloadsize=" not in uri]
    if size > SRT_MOST_BYTES and sinks:
        rule = f"must be at most {SRT_MOST_BYTES} with srtsink, which cuts longer packets"
        raise ModelError("graph.mtu_bytes", str(size), rule, f"graph.vehicle[{sinks[0]}].properties.uri")


def _values(camera: Camera, media: Media, index: int, clip: str | None) -> dict[str, Value | None]:
    """The values of the placeholders of a camera's source and graph; None: the property keeps its default."""
    width, height = camera.source_size
    rate = f"{camera.fps.numerator}/{camera.fps.denominator}"
    settings = camera.graph.settings
    port = settings.first_port + index
    values: dict[str, Value | None] = {
        **camera.source.settings,
        **camera.graph.placeholders,
        **camera.mount,
        "camera": camera.name,
        "width": width,
        "height": height,
        "framerate": rate,
        "raw_caps": f"video/x-raw,format=I420,width={width},height={height},framerate={rate},{_PICTURE}",
        "capture_caps": camera.capture.caps,
        "controls": camera.capture.controls_text if camera.capture.controls else None,
        "host": media.host,
        "url": rtsp_url(media, camera.name, feedback=bool(settings.retransmission_ms)),
        "port": port,
        "endpoint": str(Endpoint(media.host, port)),
        "iptos": 4 * settings.dscp if settings.dscp >= 0 else -1,  # the byte of the IP header
        **per_frame_rate(settings, camera.fps),
    }
    return values if clip is None else values | {"clip": clip}


def filled(element: Element, values: Mapping[str, Value | None], where: str) -> Element:
    """An element with the placeholders of its properties resolved; where: its key."""
    given = element.properties.items()
    known = {key: _fill_value(value, values, f"{where}.properties.{key}") for key, value in given}
    return replace(element, properties={key: value for key, value in known.items() if value is not None})


def _fill_value(value: Value, values: Mapping[str, Value | None], where: str) -> Value | None:
    if not isinstance(value, str):
        return value
    for name in PLACEHOLDER.findall(value):
        if name not in values:
            raise ModelError(where, repr(value), f"unknown placeholder {{{name}}}{suggest(name, values)}")
    whole = PLACEHOLDER.fullmatch(value)
    if whole:
        return values[whole[1]]  # keeps its type
    parts: dict[str, Value] = {}
    for name in PLACEHOLDER.findall(value):
        if (part := values[name]) is None:
            raise ModelError(where, repr(value), f"{{{name}}} may be unset, so it must be the whole value")
        parts[name] = part
    return PLACEHOLDER.sub(lambda match: text(parts[match[1]]), value)


def _tokens(element: Element, quote: Callable[[str], str]) -> list[str]:
    pairs = (f"{key}={quote(text(value))}" for key, value in element.properties.items())
    sink, src = ([f"{element.name}.{pad}"] if pad else [] for pad in (element.sink, element.src))
    return [*sink, element.factory, f"name={element.name}", *pairs, *src]


def _quoted(value: str) -> str:
    if _PLAIN_VALUE.fullmatch(value):
        return value
    escaped = value.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'
