"""Compose the YAML tree, check it against schemas/, report every problem, return a `Vehicle`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from runner import rules, schema, sources
from runner.commands import KnobValue
from runner.compose import Composed, compose, conf_directories, recompose
from runner.errors import ConfigError, Problem
from runner.files import why_no_file
from runner.graph import Plan, assignments, check_video, compile_graph
from runner.model import (
    Camera,
    Element,
    Endpoint,
    Graph,
    Mode,
    ModelError,
    Page,
    Place,
    Pose,
    RateQualityModel,
    Recording,
    Roi,
    Source,
    Turn,
    Value,
    Vehicle,
    exact,
    suggest,
)

if TYPE_CHECKING:
    from runner.experiment import Experiment, LinkSettings
    from runner.pqos import Pqos
    from runner.pqos.track import Track
    from runner.rate_quality.study import Study

SAMPLE_KNOBS: Mapping[str, KnobValue] = {"sending": True, "roi": Roi(0, 0, 16, 16), "size": (16, 16), "bitrate": 1}
MOUNT_KEYS = ("device", "address", "clip")
CAMERA_NEEDS = ("width_px", "height_px", "fps", "rate_quality")  # what the schema asks of a camera, given by its kind
GRAPH_STRUCTURE = ("defaults", "transport", "verified", "vehicle", "operator", "wire", "knobs")

T = TypeVar("T")


Check = Callable[[Plan], Iterable[ModelError]]
Base = tuple[dict[str, Any], str]  # a composed configuration of before, and where it stands


def load(
    overrides: Sequence[str] = (),
    user: Path | None = None,
    *,
    runnable: bool = True,
    check: Check | None = None,
    base: Base | None = None,
) -> Vehicle:
    """The vehicle that the configuration describes.

    overrides  Hydra overrides, as on the command line
    user       directory whose files shadow the packaged ones and may add any
    runnable   check also what only a run needs: that clips, devices and addresses are named and files are there
    check      what else may be wrong with a compiled plan: the GStreamer registry's view
    base       what the overrides change; None: the packaged and the user's files
    raises     ConfigError with all problems
    """
    builder = _Builder(composed(overrides, user, base), runnable, check)
    return builder.finished(builder.vehicle())


def load_run(
    overrides: Sequence[str],
    user: Path | None,
    *,
    runnable: bool = True,
    check: Check | None = None,
    base: Base | None = None,
) -> tuple[Vehicle, Pqos, Track | None]:
    """The vehicle, its source of predictions, and the drive that gives positions where no GPS does.

    raises  ConfigError with all problems, also those of maps and traces
    """
    from runner.pqos import build_pqos
    from runner.pqos.track import build_track

    builder = _Builder(composed(overrides, user, base), runnable, check)
    vehicle = builder.vehicle()
    if not builder.fine("pqos"):
        raise ConfigError(builder.problems)
    settings, bases = builder.composed.document["pqos"], [*conf_directories(user), Path.cwd()]
    pqos = builder.attempt(("pqos",), lambda: build_pqos(settings, bases))
    # A map that cannot be read is told once, though the drive goes through its points.
    track = builder.attempt(("pqos",), lambda: build_track(settings, bases)) if pqos else None
    return builder.finished(vehicle), builder.finished(pqos), track


def composed(overrides: Sequence[str], user: Path | None, base: Base | None = None) -> Composed:
    """The configuration as plain data, not yet checked.

    raises  ConfigError where it cannot be composed
    """
    return recompose(*base, overrides, user) if base else compose(overrides, user)


def load_experiment(
    overrides: Sequence[str], user: Path | None, *, runnable: bool = False, check: Check | None = None
) -> tuple[Experiment, LinkSettings | None]:
    """What the demo drives, and the limited link between its sides.

    raises  ConfigError with all problems, also those of maps and traces
    """
    from runner.experiment import Experiment, read_experiment, read_link, truth

    builder = _Builder(compose(overrides, user), runnable, check)
    vehicle = builder.vehicle()
    document, bases = builder.composed.document, [*conf_directories(user), Path.cwd()]
    experiment = builder.part(("experiment",), read_experiment) if "experiment" in document else Experiment()
    if "link" not in document:
        return builder.finished(experiment), None
    rates = builder.part(("pqos",), lambda data: truth(data, bases))
    link = builder.part(("link",), lambda data: read_link(data, rates, bases)) if rates else None
    dialling = [name for name, camera in vehicle.cameras.items() if camera.graph.transport != "rtsp"] if vehicle else []
    if link and dialling:
        rule = f"joins sides over RTSP, the graph of {dialling[0]} brings its own line"
        builder.problems.append(builder.composed.problem(("link", "kind"), link.kind, rule))
    return builder.finished(experiment), builder.finished(link)


def load_study(
    overrides: Sequence[str], user: Path | None, *, runnable: bool = False, check: Check | None = None
) -> tuple[Vehicle, Study]:
    """The vehicle, and how rate-quality models of its cameras are measured.

    raises  ConfigError with all problems
    """
    from runner.rate_quality.study import read_study

    builder = _Builder(compose(overrides, user), runnable, check)
    vehicle = builder.vehicle()
    study = builder.part(("study",), read_study)
    return builder.finished(vehicle), builder.finished(study)


@dataclass
class _Builder:
    """Builds model objects from plain data and gathers what is wrong with it; None stands for what could not be built.

    Parts that the schema refuses are not built, so that one mistake is told once.
    """

    composed: Composed
    runnable: bool
    check: Check | None
    problems: list[Problem] = field(default_factory=list)
    bad: set[schema.Path] = field(default_factory=set)

    def vehicle(self) -> Vehicle | None:
        document = self.composed.document
        wrong = list(self._told_once(schema.findings(document, "composed")))
        self.problems += [self.composed.problem(f.path, f.found, f.rule) for f in wrong]
        self.bad = {f.path for f in wrong} | {f.meant for f in wrong}
        modes = {mode: self._rule_list(mode) for mode in Mode if self.fine("modes", mode)}
        mounted = document.get("cameras")
        cameras = {name: self._camera(name) for name in mounted} if isinstance(mounted, dict) else {}
        if not all(map(self.fine, ("media", "control", "page", "log"))):
            return None
        media, control = (Endpoint(**document[key]) for key in ("media", "control"))
        built = {name: camera for name, camera in cameras.items() if camera}
        recording = self.part(("recording",), _recording)
        page = Page(**document["page"])
        listening = {"page.port": page.port} if page.serve else {}
        self._check_ports(built, {"media.port": media.port, "control.port": control.port, **listening})
        for index, camera in enumerate(built.values()):
            self._check_compiles(camera, media, index, recording)
            if camera.source.render:
                self.attempt(("cameras", camera.name), lambda c=camera: sources.view(c))  # type: ignore[misc]
            if self.runnable:
                self._check_inputs(camera)
        if self.problems or recording is None:
            return None
        return Vehicle(
            name=document["name"],
            cameras=built,
            mode=Mode(document["mode"]),
            modes=modes,
            media=media,
            control=control,
            page=page,
            pqos=document["pqos"],
            recording=recording,
            log_video=document["log"]["video"],
        )

    def finished(self, built: T | None) -> T:
        """What was built, if nothing was wrong."""
        if built is None or self.problems:
            raise ConfigError(self.problems)
        return built

    # --- problems -----------------------------------------------------------------------------------------------------

    def fine(self, *path: str | int) -> bool:
        """Whether the schema found nothing wrong at or below a path, nor with what it is a part of."""
        return not any(bad[: len(path)] == path or bad == path[: len(bad)] for bad in self.bad)

    def _told_once(self, wrong: Sequence[schema.Finding]) -> Iterator[schema.Finding]:
        """A name below cameras that no kind is mounted under is one mistake, not many missing keys."""
        missing = Counter(f.path[:2] for f in wrong if f.found == "missing" and f.path[0] == "cameras")
        unmounted = {path for path, count in missing.items() if count == len(CAMERA_NEEDS)}
        for path in sorted(unmounted, key=str):
            others = [name for name in self.composed.document["cameras"] if ("cameras", name) not in unmounted]
            hint = suggest(str(path[1]), others)
            if "did you mean" not in hint:
                hint = f"its kind is named in the defaults list: /cameras@cameras.{path[1]}: KIND"
            yield schema.Finding(path, None, f"no camera of that name is mounted, {hint}")
        yield from (f for f in wrong if f.path[:2] not in unmounted)

    def attempt(self, path: schema.Path, make: Callable[[], T]) -> T | None:
        try:
            return make()
        except ModelError as error:
            self._report(path, error)
            return None

    def _report(self, path: schema.Path, error: ModelError) -> None:
        where = (*path, *_split(error.key))
        found = error.found if error.found is None or isinstance(error.found, str) else schema.shown(error.found)
        self.problems.append(self.composed.problem(where, found, error.rule))

    # --- parts --------------------------------------------------------------------------------------------------------

    def _rule_list(self, mode: Mode) -> tuple[rules.RuleCall, ...]:
        calls = []
        for index, entry in enumerate(self.composed.document["modes"][mode]):
            ((name, parameters),) = entry.items()
            call = self.attempt(("modes", mode.value, index), lambda n=name, p=parameters: rules.call_rule(n, p))  # type: ignore[misc]
            calls.append(call)
        known = tuple(call for call in calls if call)
        if len(known) == len(calls):
            for error in rules.check_order(mode, known):
                self._report(("modes",), error)
        return known

    def _camera(self, name: str) -> Camera | None:
        document = self.composed.document
        data, path = document["cameras"][name], ("cameras", name)
        # Parts that the schema accepts are looked at further, whatever is wrong beside them.
        graph = self.part(self._of(name, "graph"), _graph)
        source = self.part(self._of(name, "source"), _source)
        model = self.part((*path, "rate_quality"), _rate_quality)
        if graph is None or source is None or model is None or not (self.fine(*path) and self.fine("fps_max")):
            return None
        fps, limit = exact(data["fps"]), document.get("fps_max")
        native = data.get("native")
        pose, place = data.get("pose"), data.get("place")
        return self.attempt(
            path,
            lambda: Camera(
                name=name,
                width=data["width_px"],
                height=data["height_px"],
                fps=fps if limit is None else min(fps, exact(limit)),
                rate_quality=model,
                graph=graph,
                source=source,
                weight=exact(data.get("weight", 1)),
                native=(native["width_px"], native["height_px"]) if native else None,
                crop=_crop(native, data["width_px"], data["height_px"]) if native else None,
                mount={key: data[key] for key in MOUNT_KEYS if key in data},
                place=Place(**place) if place else None,
                pose=Pose(**({"pitch_deg": 0.0, "roll_deg": 0.0} | pose)) if pose else None,
                fov_deg=data.get("fov_deg", 90.0),
                lens=data.get("lens", "pinhole"),
            ),
        )

    def part(self, path: schema.Path, make: Callable[[Any], T]) -> T | None:
        """What a part of the document describes, if the schema accepts it."""
        if not self.fine(*path):
            return None
        data: Any = self.composed.document
        for key in path:
            data = data[key]
        return self.attempt(path, lambda: make(data))

    def _check_inputs(self, camera: Camera) -> None:
        """Whether the clip, device or address that a camera's source asks for is named, and a clip is there."""
        source = camera.source
        for key in () if source.render else sorted(source.needs.intersection(MOUNT_KEYS)):
            where = ("cameras", camera.name) if key in camera.mount else self._of(camera.name, "source")
            given = camera.mount.get(key, source.settings.get(key))
            if given is None:
                self._report(where, ModelError(key, "null", f"must be given, here or for each mounted camera as {key}"))
            elif key == "clip" and not Path(str(given)).is_file():
                self._report(where, ModelError(key, repr(given), why_no_file(Path(str(given)))))

    def _check_compiles(self, camera: Camera, media: Endpoint, index: int, recording: Recording | None) -> None:
        """Whether everything that source, graph and recording refer to is there."""
        anything = {key: camera.mount.get(key, key) for key in MOUNT_KEYS}
        try:
            plan = compile_graph(replace(camera, mount=anything), media, index, recording=recording)
            for knob, value in SAMPLE_KNOBS.items():
                assignments(camera, knob, value)
            if self.composed.document["log"]["video"]:
                check_video(camera.graph)
            errors = list(self.check(plan)) if self.check else []
        except ModelError as broken:
            errors = [broken]
        for error in errors:
            section, _, key = error.key.partition(".")
            self._report(self._of(camera.name, section), ModelError(key, error.found, error.rule))

    def _of(self, camera: str, section: str) -> schema.Path:
        """Where a camera's graph or source stands: its own one, else the one of all."""
        data = self.composed.document["cameras"][camera]
        return ("cameras", camera, section) if isinstance(data, dict) and section in data else (section,)

    def _check_ports(self, cameras: Mapping[str, Camera], servers: Mapping[str, int]) -> None:
        """No two listeners on one port. Cameras count on from the first port of their graph."""
        taken: dict[int, str] = {}
        for path, port in servers.items():
            if port in taken:
                self._report((), ModelError(path, str(port), f"is already the port of {taken[port]}"))
            taken[port] = path
        for index, (name, camera) in enumerate(cameras.items()):
            port = int(camera.graph.settings["first_port"]) + index
            if port in taken:
                own = ("cameras", name) if "graph" in self.composed.document["cameras"][name] else ()
                rule = f"camera {name} would get port {port}, already the port of {taken[port]}"
                self._report(own, ModelError("graph.first_port", str(port - index), rule))
            taken[port] = f"camera {name}"


def _rate_quality(data: Mapping[str, Any]) -> RateQualityModel:
    return RateQualityModel(
        scaling=tuple(map(exact, data["scaling"])),
        b_min=tuple(map(exact, data["b_min_kbps"])),
        b_full=exact(data["b_full_kbps"]),
    )


def _crop(native: Mapping[str, int], width: int, height: int) -> Roi:
    return Roi(native.get("left_px", 0), native.get("top_px", 0), width, height)


def _elements(data: Sequence[Mapping[str, Any]] | None) -> tuple[Element, ...]:
    return tuple(Element(e["name"], e["element"], e.get("properties") or {}) for e in data or ())


def _graph(data: Mapping[str, Any]) -> Graph:
    wire = data.get("wire") or {}
    settings: dict[str, Value] = {key: value for key, value in data.items() if key not in GRAPH_STRUCTURE}
    return Graph(
        transport=data["transport"],
        vehicle=_elements(data["vehicle"]),
        operator=_elements(data["operator"]),
        wire_vehicle=_elements(wire.get("vehicle")),
        wire_operator=_elements(wire.get("operator")),
        knobs={knob: tuple(Turn(**turn) for turn in turns) for knob, turns in data["knobs"].items()},
        settings=settings,
        verified=data.get("verified", True),
    )


def _source(data: Mapping[str, Any]) -> Source:
    render = data.get("render")
    return Source(
        elements=_elements(data["elements"]),
        settings={key: data[key] for key in MOUNT_KEYS if data.get(key) is not None},
        loop=data.get("loop", False),
        render=render["drive"] if render else "",
        render_s=render["seconds"] if render else 0,
        stand_in=_elements(data.get("stand_in")),
    )


def _recording(data: Mapping[str, Any]) -> Recording:
    return Recording(data["codec"], data["of_raw"], _elements(data["elements"]))


def _split(key: str) -> schema.Path:
    """The path that a dotted key means: a.b[1].c."""
    parts: list[str | int] = []
    for piece in filter(None, key.replace("]", "").replace("[", ".#").split(".")):
        parts.append(int(piece[1:]) if piece[0] == "#" else piece)
    return tuple(parts)
