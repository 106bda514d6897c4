"""Compose the YAML tree, check it against schemas/, report every problem, return a `Vehicle`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from runner import rules, schema
from runner.compose import Composed, ConfigError, Problem, compose
from runner.model import (
    Camera,
    Element,
    Endpoint,
    Graph,
    Mode,
    ModelError,
    Place,
    Pose,
    RateQualityModel,
    Roi,
    Source,
    Turn,
    Value,
    Vehicle,
    exact,
)

MOUNT_KEYS = ("device", "address", "clip")
GRAPH_STRUCTURE = ("defaults", "transport", "verified", "vehicle", "operator", "wire", "knobs")

T = TypeVar("T")


def load(overrides: Sequence[str] = (), user: Path | None = None) -> Vehicle:
    """The vehicle that the configuration describes.

    overrides  Hydra overrides, as on the command line
    user       directory whose files shadow the packaged ones and may add any
    raises     ConfigError with all problems
    """
    return build(compose(overrides, user))


def build(composed: Composed) -> Vehicle:
    """Check a composed configuration and build the vehicle from it.

    raises  ConfigError with all problems
    """
    builder = _Builder(composed)
    vehicle = builder.vehicle()
    if vehicle is None or builder.problems:
        raise ConfigError(builder.problems)
    return vehicle


@dataclass
class _Builder:
    """Builds model objects from plain data and gathers what is wrong with it; None stands for what could not be built.

    Parts that the schema refuses are not built, so that one mistake is told once.
    """

    composed: Composed
    problems: list[Problem] = field(default_factory=list)

    def vehicle(self) -> Vehicle | None:
        document = self.composed.document
        wrong = schema.findings(document, "composed")
        self.problems += [self.composed.problem(f.path, f.found, f.rule) for f in wrong]
        self._bad = {f.path for f in wrong}
        modes = {mode: self._rule_list(mode) for mode in Mode} if self._fine("modes") else {}
        cameras = {name: self._camera(name) for name in document.get("cameras") or {} if self._fine("cameras", name)}
        if self.problems:
            return None
        media, control = (Endpoint(**document[key]) for key in ("media", "control"))
        built = {name: camera for name, camera in cameras.items() if camera}
        self._check_ports(built, {"media.port": media.port, "control.port": control.port})
        return Vehicle(
            name=document["name"],
            cameras=built,
            mode=Mode(document["mode"]),
            modes=modes,
            media=media,
            control=control,
            pqos=document["pqos"],
        )

    # --- problems -----------------------------------------------------------------------------------------------------

    def _fine(self, *path: str) -> bool:
        """Whether the schema found nothing wrong at or below a path."""
        return not any(bad[: len(path)] == path for bad in self._bad)

    def _try(self, path: schema.Path, make: Callable[[], T]) -> T | None:
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
            call = self._try(("modes", mode.value, index), lambda n=name, p=parameters: rules.call_rule(n, p))  # type: ignore[misc]
            calls.append(call)
        known = tuple(call for call in calls if call)
        if len(known) == len(calls):
            for error in rules.check_order(mode, known):
                self._report(("modes",), error)
        return known

    def _camera(self, name: str) -> Camera | None:
        document = self.composed.document
        data, path = document["cameras"][name], ("cameras", name)
        own_graph, own_source = "graph" in data, "source" in data
        graph_path = (*path, "graph") if own_graph else ("graph",)
        if not (self._fine(*graph_path) and self._fine("source")):
            return None
        graph = self._try(graph_path, lambda: _graph(data["graph"] if own_graph else document["graph"]))
        model = self._try((*path, "rate_quality"), lambda: _rate_quality(data["rate_quality"]))
        source = _source(data["source"] if own_source else document["source"])
        if graph is None or model is None:
            return None
        fps, limit = exact(data["fps"]), document["fps_max"]
        native = data.get("native")
        pose, place = data.get("pose"), data.get("place")
        return self._try(
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


def _split(key: str) -> schema.Path:
    """The path that a dotted key means: a.b[1].c."""
    parts: list[str | int] = []
    for piece in filter(None, key.replace("]", "").replace("[", ".#").split(".")):
        parts.append(int(piece[1:]) if piece[0] == "#" else piece)
    return tuple(parts)
