"""Builds a `Setup` from plain data: builds the parts that the schemas accept, and collects all problems."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import reduce
from ipaddress import IPv4Network, IPv6Network, ip_network
from typing import TYPE_CHECKING, Any, TypeVar

from runner import schema
from runner.clips import view
from runner.configuration.graphs import MOUNT_KEYS, given, read_graph, read_recording, read_source
from runner.configuration.origin import Composed
from runner.configuration.rule_lists import call_entry, check_order
from runner.configuration.uplinks import Ways, built_uplinks, reserves_kbps, uplink_problems
from runner.core.budget import SOUND, VOICE
from runner.core.capture import Capture
from runner.core.commands import KnobValue
from runner.core.frame_rate import is_given
from runner.core.hull import Curve, concave
from runner.core.model import Camera, Graph, Kbps, Mode, ModelError, RateQualityModel, Roi, Source, Vehicle, exact
from runner.core.mounting import Place, Pose, overlapping
from runner.core.rules import RuleCall
from runner.dropping import with_rate_knob
from runner.errors import ConfigError, Problem, suggest
from runner.graph import Plan, check_video, compile_graph
from runner.redact import redacted
from runner.refresh import with_asked_waves
from runner.settings import (
    Control,
    Dimensions,
    Inputs,
    LatencyLimit,
    LogSettings,
    Media,
    MetricsPorts,
    PageSettings,
    Recording,
    RosPrediction,
    RosQos,
    RosSettings,
    Setup,
    Sound,
    Voice,
    address_rule,
)
from runner.turning import assignments

if TYPE_CHECKING:
    from runner.configuration.experiment import LinkSettings, TimedRequest
    from runner.sound import SoundPlan
    from runner.voice import VoicePlan

SAMPLE_KNOBS: Mapping[str, KnobValue] = {"sending": True, "roi": Roi(0, 0, 16, 16), "size": (16, 16), "bitrate": 1}
TOPIC = re.compile(r"/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")  # design.ros2.org, topic and service names
TOPIC_RULE = "must be the name of a topic: letters, digits and _ between slashes, no part beginning with a digit"
CAMERA_NEEDS = ("width_px", "height_px", "fps", "rate_quality")  # keys that the schema requires, set by the kind
GRAPH_CHANGES = {"fps": with_rate_knob, "wave_s": with_asked_waves}  # that what a rule gives needs
SECTIONS = (
    *("media", "control", "page", "log", "latency", "keys", "insecure", "metrics", "ros", "strict", "uplinks"),
    *("sound", "voice"),
)

T = TypeVar("T")

PlanCheck = Callable[["Plan | SoundPlan | VoicePlan"], Iterable[ModelError]]


@dataclass
class Builder:
    """Builds model objects from plain data and collects problems; an object that cannot be built is None.

    Parts that the schema rejects are not built, so that a mistake is reported only once.
    """

    composed: Composed
    runnable: bool
    files: bool
    bags: bool
    check: PlanCheck | None
    problems: list[Problem] = field(default_factory=list)
    bad: set[schema.Path] = field(default_factory=set)
    setup: Setup | None = field(init=False)

    def __post_init__(self) -> None:
        self.setup = self._setup()

    def _setup(self) -> Setup | None:
        document = self.composed.document
        wrong = list(self._without_repeats(schema.findings(document, "composed")))
        self.problems += [self.composed.problem(f.path, f.found, f.rule) for f in wrong]
        self.bad = {f.path for f in wrong} | {f.meant for f in wrong}
        modes = {mode: self._rules(mode) for mode in Mode if self.is_valid("modes", mode)}
        self.graph_changes = [change for part, change in GRAPH_CHANGES.items() if is_given(part, modes)]
        mounted = document.get("cameras")
        cameras = {name: self._camera(name) for name in mounted} if isinstance(mounted, dict) else {}
        if not all(map(self.is_valid, SECTIONS)):
            return None
        media, control = self.part(("media",), _media), self.part(("control",), Control.of)
        if media is None or control is None:
            return None
        keys, insecure = document.get("keys"), document.get("insecure", False)
        private = None if isinstance(insecure, bool) else self.part(("insecure",), _network)
        media = replace(media, secure=keys is not None)
        built = {name: camera for name, camera in cameras.items() if camera}
        recording = self.part(("recording",), read_recording)
        page = PageSettings(**document["page"])
        inputs = self.part(("inputs",), lambda data: Inputs(**data)) if "inputs" in document else None
        ways = document.get("uplinks") or {}  # older drives have none
        self._check_uplinks(ways, built)
        known = document.get("dimensions") is not None
        dimensions = self.part(("dimensions",), lambda data: Dimensions(**data)) if known else None
        ros = _ros(document.get("ros", {}))
        for error in ros.misplaced():
            self._report(("ros",), error)
        listening = {"page.port": page.port} if page.serve else {}
        sound = self._sound(media, built) if "sound" in document else None
        voice = self._voice(media, built) if "voice" in document else None
        self._check_places(built)
        self._check_ports(built, {"media.port": media.port, "control.port": control.port, **listening})
        self._check_rtp_ports(built, media, sound, voice)
        log = self.part(("log",), lambda data: LogSettings.of(data, mounted or {}))
        for index, camera in enumerate(built.values()):
            self._check_compiles(camera, media, index, recording, log)
            if camera.source.render:
                self.attempt(("cameras", camera.name), lambda c=camera: view(c))  # type: ignore[misc]
            if self.runnable:
                self._check_inputs(camera)
            if camera.source.plays_bags or "clip" in camera.source.placeholders:
                self._check_files(camera)
        if self.problems or recording is None or log is None:
            return None
        taken = sound.wire_kbps if sound else Kbps(0)
        return Setup(
            Vehicle(document["name"], built, Mode(document["mode"]), modes, reserves_kbps(ways), taken),
            media=media,
            control=control,
            page=page,
            latency=LatencyLimit(**document.get("latency", {})),
            recording=recording,
            log=log,
            expires_s=float(document["control"]["expires_s"]),
            keys=keys,
            insecure=insecure is True,
            strict=document.get("strict", False),
            private=private,
            metrics=MetricsPorts(**document.get("metrics", {})),
            ros=ros,
            dimensions=dimensions,
            inputs=inputs or Inputs(),
            uplinks=built_uplinks(ways),
            sound=sound,
            voice=voice,
        )

    def checked(self, built: T | None) -> T:
        """The built object; raises ConfigError if there were problems."""
        if built is None or self.problems:
            raise ConfigError(self.problems)
        return built

    # --- problems -----------------------------------------------------------------------------------------------------

    def is_valid(self, *path: str | int) -> bool:
        """Whether the schema found no problem at, below or above a path."""
        return not any(bad[: len(path)] == path or bad == path[: len(bad)] for bad in self.bad)

    def _without_repeats(self, wrong: Sequence[schema.Finding]) -> Iterator[schema.Finding]:
        """Report a name below cameras without a mounted kind as one mistake, not as many missing keys."""
        missing = Counter(f.path[:2] for f in wrong if f.found == "missing" and f.path[0] == "cameras")
        unmounted = {path for path, count in missing.items() if count == len(CAMERA_NEEDS)}
        for path in sorted(unmounted, key=str):
            others = [name for name in self.composed.document["cameras"] if ("cameras", name) not in unmounted]
            hint = suggest(str(path[1]), others)
            if "did you mean" not in hint:
                hint = f"; its kind is named in the defaults list: /cameras@cameras.{path[1]}: KIND"
            yield schema.Finding(path, None, f"no camera of that name is mounted{hint}")
        yield from (f for f in wrong if f.path[:2] not in unmounted)

    def attempt(self, path: schema.Path, make: Callable[[], T]) -> T | None:
        try:
            return make()
        except ModelError as error:
            self._report(path, error)
            return None

    def _report(self, path: schema.Path, error: ModelError) -> None:
        where, *others = (self._place(path, key) for key in (error.key, *error.others))
        found = error.found if error.found is None or isinstance(error.found, str) else schema.shown(error.found)
        self.problems.append(self.composed.problem(where, found, error.rule, others))

    def _place(self, path: schema.Path, key: str) -> schema.Path:
        """Path of a key of an object. A camera's own, otherwise, as of its graph, the common one."""
        inside = _split(key)
        if path[:1] != ("cameras",) or len(path) != 2 or not inside:
            return (*path, *inside)
        camera = self.composed.document["cameras"][path[1]]
        own = inside[0] not in self.composed.document or (isinstance(camera, dict) and inside[0] in camera)
        return (*path, *inside) if own else inside

    # --- parts --------------------------------------------------------------------------------------------------------

    def _rules(self, mode: Mode) -> tuple[RuleCall, ...]:
        calls = []
        for name, entry in self.composed.document["modes"][mode].items():
            call = self.attempt(("modes", mode.value, name), lambda n=name, e=entry: call_entry(n, e))  # type: ignore[misc]
            calls.append(call)
        known = tuple(call for call in calls if call)
        if len(known) == len(calls):
            for error in check_order(mode, known):
                self._report(("modes",), error)
        return known

    def _camera(self, name: str) -> Camera | None:
        document = self.composed.document
        data, path = document["cameras"][name], ("cameras", name)
        # Parts that the schema accepts are checked further, whatever the problems elsewhere.
        graph = self.part(self._place(path, "graph"), read_graph)
        source = self.part(self._place(path, "source"), read_source)
        model = self.part((*path, "rate_quality"), lambda data: _rate_quality(data, graph))
        if graph is None or source is None or model is None or not (self.is_valid(*path) and self.is_valid("fps_max")):
            return None
        fps, limit = _rate(data["fps"]), document.get("fps_max")
        native = data.get("native")
        pose, place = data.get("pose"), data.get("place")
        options = given(data, ("fov_deg", "lens", "shed", "framing", "calibrated", "redundant"))
        options |= {key: exact(value) for key, value in given(data, ("weight", "floor_kbps", "least_scaling")).items()}
        options |= {key: Roi(**value) for key, value in given(data, ("always",)).items()}
        return self.attempt(
            path,
            lambda: Camera(
                name=name,
                width=data["width_px"],
                height=data["height_px"],
                fps=fps if limit is None else min(fps, _rate(limit)),
                rate_quality=model,
                graph=reduce(lambda changed, change: change(changed), self.graph_changes, graph),
                source=source,
                native=(native["width_px"], native["height_px"]) if native else None,
                crop=_crop(native, data["width_px"], data["height_px"]) if native else None,
                mount=given(data, MOUNT_KEYS),
                capture=_capture(source, data),
                credentials=data.get("credentials", source.credentials),
                place=Place(**place) if place else None,
                pose=Pose(**pose) if pose else None,
                **options,
            ),
        )

    def part(self, path: schema.Path, make: Callable[[Any], T]) -> T | None:
        """The object that a part of the document describes, if the schema accepts it."""
        if not self.is_valid(*path):
            return None
        data: Any = self.composed.document
        for key in path:
            data = data[key]
        return self.attempt(path, lambda: make(data))

    def _check_uplinks(self, ways: Ways, cameras: Mapping[str, Camera]) -> None:
        """Check that they are different ways, and that all cameras can use them."""
        for error in uplink_problems(ways):
            self._report(("uplinks",), error)
        for name in [name for name, camera in cameras.items() if ways and camera.graph.transport != "rtsp"][:1]:
            rule = f"support RTSP only; the graph of {name} has its own transport; choose graph=h264_rtsp, or name none"
            other = self._place(("cameras", name), "graph.transport")
            self.problems.append(self.composed.problem(("uplinks",), None, rule, [other]))

    def check_link(self, link: LinkSettings, *, needs_lanes: bool) -> None:
        """Check that all cameras can use a limited link, and that its kind supports the settings.

        needs_lanes  whether several uplinks do
        """
        from runner.configuration.experiment import lane_problems, unreachable_uplinks

        cameras = tuple(self.setup.vehicle.cameras.values()) if self.setup else ()
        dialling = [camera.name for camera in cameras if camera.graph.transport != "rtsp"]
        if dialling and link.kind == "relay":
            rule = f"supports RTSP only; the graph of {dialling[0]} has its own transport; choose link=netns"
            self._refuse_link("kind", link.kind, rule, self._place(("cameras", dialling[0]), "graph.transport"))
        elif dialling and len(dialling) < len(cameras):
            rule = f"needs all cameras on RTSP or none: the graph of {dialling[0]} has its own transport"
            self._refuse_link("kind", link.kind, rule, self._place(("cameras", dialling[0]), "graph.transport"))
        if link.limit.tcp and link.kind == "relay":
            self._refuse_link("tcp", None, "is not supported by link=relay; choose link=netns", ("link", "kind"))
        for error in lane_problems(self.composed.document["link"]):
            self._report(("link",), error)
        if self.is_valid("uplinks") and (link.lanes or needs_lanes):
            for error in unreachable_uplinks(self.composed.document):
                self._report(("uplinks",), error)

    def _refuse_link(self, key: str, found: str | None, rule: str, other: schema.Path) -> None:
        self.problems.append(self.composed.problem(("link", key), found, rule, [other]))

    def check_requests(self, requests: Sequence[TimedRequest]) -> None:
        """Check that the cameras that requests name are mounted."""
        known = self.composed.document.get("cameras") or {}
        for index, request in enumerate(requests):
            for name in {request.event.get("camera"), *request.event.get("weights", ())} - {None}:
                if name not in known:
                    path = ("experiment", "requests", index, "request")
                    self.problems.append(self.composed.problem(path, name, f"unknown camera{suggest(name, known)}"))

    def _check_inputs(self, camera: Camera) -> None:
        """Check that the clip, device or address that a camera's source needs is configured."""
        source = camera.source
        needs = {"bag"} if source.plays_bags else source.placeholders.intersection(MOUNT_KEYS)
        needs |= {"topic"} if source.subscribes else set()
        for key in () if source.render else sorted(needs):
            given = camera.mount.get(key, source.settings.get(key))
            if given is None:
                rule = f"must be given: source.{key}=, or {key} of each mounted camera"
                self._report_input(camera, ModelError(key, "null", rule))
            elif key == "address" and (broken := address_rule(str(given))):
                self._report_input(camera, ModelError(key, repr(redacted(given)), broken))
            elif key == "topic" and not TOPIC.fullmatch(str(given)):
                self._report_input(camera, ModelError(key, repr(given), TOPIC_RULE))

    def _check_files(self, camera: Camera) -> None:
        """Check that the clip or bag that a camera's source plays can be read."""
        from runner.inputs import bag_problem, clip_problem

        error = (clip_problem(camera) if self.files else None) or (bag_problem(camera) if self.bags else None)
        if error:
            self._report_input(camera, error)

    def _report_input(self, camera: Camera, error: ModelError) -> None:
        """Report a problem of what a camera's source plays or connects to: its own, or that of the source."""
        key = error.key if error.key in camera.mount else f"source.{error.key}"
        self._report(("cameras", camera.name), ModelError(key, error.found, error.rule, "bag", "source.bag"))

    def _check_compiles(
        self, camera: Camera, media: Media, index: int, recording: Recording | None, log: LogSettings | None
    ) -> None:
        """Check that everything that source, graph and recording refer to exists."""
        anything = {key: camera.mount.get(key, key) for key in MOUNT_KEYS}
        try:
            # One name for all: identical plans need not be checked against the registry again.
            named = replace(camera, name="camera", mount=anything)
            kept = log.lossless.get(camera.name) if log else None
            plan = compile_graph(named, media, index, recording=recording, lossless=kept)
            for knob, value in SAMPLE_KNOBS.items():
                assignments(camera, knob, value)
            if self.composed.document["log"]["video"]:
                check_video(camera.graph)
            errors = list(self.check(plan)) if self.check else []
        except ModelError as broken:
            errors = [broken]
        for error in errors:
            self._report(("cameras", camera.name), error)

    def _check_places(self, cameras: Mapping[str, Camera]) -> None:
        """Check that no tile of the page overlaps another one."""
        places = {name: camera.place for name, camera in cameras.items() if camera.place}
        for name, rule, other in overlapping(places):
            found = self.composed.document["cameras"][name]["place"]
            self._report((), ModelError(f"cameras.{name}.place", found, rule, f"cameras.{other}.place"))

    def _check_ports(self, cameras: Mapping[str, Camera], servers: Mapping[str, int]) -> None:
        """Check that no two servers use the same port. Cameras count up from the first port of their graph."""
        taken: dict[int, tuple[str, str]] = {}  # whose a port is, and the key that states it
        for key, port in servers.items():
            if port in taken:
                owner, other = taken[port]
                self._report((), ModelError(key, str(port), f"is already the port of {owner}", other))
            taken[port] = key, key
        for index, (name, camera) in enumerate(cameras.items()):
            key = schema.dotted(self._place(("cameras", name), "graph.first_port"))
            port = camera.graph.settings.first_port + index
            if port in taken:
                owner, other = taken[port]
                rule = f"camera {name} would get port {port}, already the port of {owner}"
                self._report((), ModelError(key, str(port - index), rule, other))
            taken[port] = f"camera {name}", key

    def _sound(self, media: Media, cameras: Mapping[str, Camera]) -> Sound | None:
        """The sound, checked: it compiles, and no camera has its name."""
        from runner.configuration.sound import read_sound, sound_problems

        sound = self.part(("sound",), read_sound)
        if sound is None:
            return None
        if SOUND in cameras:
            rule = "is the name of the vehicle's sound; give this camera another one, or choose no sound"
            self.problems.append(self.composed.problem(("cameras", SOUND), None, rule))
        for error in sound_problems(sound, media, self.check, runnable=self.runnable, files=self.files):
            self._report(("sound",), error)
        return sound

    def _voice(self, media: Media, cameras: Mapping[str, Camera]) -> Voice | None:
        """The same of the operator's voice."""
        from runner.configuration.voice import read_voice, voice_problems

        voice = self.part(("voice",), read_voice)
        if voice is None:
            return None
        if VOICE in cameras:
            rule = "is the name of the operator's voice; give this camera another one, or choose no voice"
            self.problems.append(self.composed.problem(("cameras", VOICE), None, rule))
        for error in voice_problems(voice, media, self.check, runnable=self.runnable):
            self._report(("voice",), error)
        return voice

    def _check_rtp_ports(
        self, cameras: Mapping[str, Camera], media: Media, sound: Sound | None, voice: Voice | None
    ) -> None:
        """Check that each camera behind the RTSP server finds its ports: an even one for RTP, the next for RTCP."""
        first, last = media.rtp_ports
        pairs = (last + 1) // 2 - (first + 1) // 2
        served = sum(camera.graph.transport == "rtsp" for camera in cameras.values())
        if pairs < served + bool(sound) + bool(voice):
            of_sound = " and for the sound" * bool(sound) + " and for the voice" * bool(voice)
            rule = f"must hold two ports, of which the first is even, for each of {served} cameras{of_sound}"
            self._report((), ModelError("media.rtp_ports", f"[{first}, {last}]", rule))


def _media(data: Mapping[str, Any]) -> Media:
    first, last = data["rtp_ports"]
    return Media(**{**data, "rtp_ports": (first, last)})


def _network(text: str) -> IPv4Network | IPv6Network:
    try:
        return ip_network(text, strict=False)
    except ValueError:
        raise ModelError("", text, schema.NETWORK_RULE) from None


def _ros(data: Mapping[str, Any]) -> RosSettings:
    qos = {topic: RosQos(**its) for topic, its in data.get("qos", {}).items()}
    prediction = data.get("prediction")
    return RosSettings(**{**data, "qos": qos, "prediction": RosPrediction(**prediction) if prediction else None})


def _capture(source: Source, data: Mapping[str, Any]) -> Capture:
    """The capture format of a source, overridden by the camera's own settings."""
    own = data.get("capture") or {}
    requested = {**source.capture, **own}
    controls = {**source.capture.get("controls", {}), **own.get("controls", {})}
    for key in ("width", "height", "fps"):
        if key in requested and "format" not in requested:
            stated = (f"capture.{key}", f"source.capture.{key}")
            raise ModelError("capture.format", "null", f"must be given where {key} is", *stated)
    fps = requested.get("fps")
    size = given(requested, ("format", "width", "height"))
    return Capture(**size, fps=None if fps is None else _rate(fps), controls=controls)


def _rate_quality(data: Mapping[str, Any], graph: Graph | None) -> RateQualityModel:
    b_full = exact(data["b_full_kbps"])
    if graph and graph.passes:  # it has one size, whatever the file of its kind says
        return RateQualityModel((Fraction(1),), (Fraction(0),), b_full)
    shown = {
        exact(its["scale"]): _model(its, b_full, ("shown", index)) for index, its in enumerate(data.get("shown", ()))
    }
    rates = RateQualityModel.rates_of(data.get("rates", ()))
    return replace(_model(data, b_full), shown=dict(sorted(shown.items())), rates=rates)


def _model(data: Mapping[str, Any], b_full: Kbps, path: schema.Path = ()) -> RateQualityModel:
    """raises ModelError, with keys below `path`"""
    try:
        scaling, b_min = (tuple(map(exact, data[key])) for key in ("scaling", "b_min_kbps"))
        return RateQualityModel(scaling, b_min, b_full, _curve(data.get("quality")))
    except ModelError as error:
        raise ModelError(schema.dotted((*path, error.key)), error.found, error.rule, *error.others) from None


def _curve(points: Sequence[Sequence[float]] | None) -> Curve | None:
    if not points:
        return None
    hull = concave([(float(kbps), float(quality)) for kbps, quality in points])
    if len(hull) < len(points):
        rule = "must be increasing and concave, each step with less quality for its bits; `tod-runner model` writes it"
        raise ModelError("quality", json.dumps(points), rule)
    kbps, quality = zip(*hull, strict=True)
    return Curve(kbps, quality)


def _rate(fps: float) -> Fraction:
    """A frame rate in Hz. Fractions of caps have 32 bits: 29.97002997002997 stands for 30000/1001."""
    rate = exact(fps)
    return rate if max(rate.as_integer_ratio()) < 2**31 else rate.limit_denominator(1001) or rate


def _crop(native: Mapping[str, int], width: int, height: int) -> Roi:
    return Roi(native.get("left_px", 0), native.get("top_px", 0), width, height)


def _split(key: str) -> schema.Path:
    """The path of a dotted key: a.b[1].c."""
    parts: list[str | int] = []
    for piece in filter(None, key.replace("]", "").replace("[", ".#").split(".")):
        parts.append(int(piece[1:]) if piece[0] == "#" else piece)
    return tuple(parts)
