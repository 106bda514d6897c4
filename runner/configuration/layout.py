"""Layouts that operators save on the page: one file per operator in the user's directory, with places by vehicle."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from runner import schema
from runner.configuration.files import LAYOUT
from runner.configuration.yaml_file import label, load_file
from runner.core.model import Vehicle
from runner.core.mounting import Place, overlapping
from runner.errors import ConfigError, Problem, UserError, os_errors_as, suggest

WITHOUT_KEYS = "operator"  # name of an operator without keys
MAX_NAMED = 5  # unknown cameras in an answer
NOWHERE = "layouts are saved in your own directory: start this side with conf=DIR"
HEADER = """\
# yaml-language-server: $schema=../.schemas/layout.schema.json
# By vehicle, where this operator has placed the pictures. Saving a layout on the page overwrites this file.
"""

Places = Mapping[str, Place | None]  # by camera; None: none
DrivePlaces = Mapping[str, Any]  # cameras in the Drive view: front, left, right and rear, and a list of them, row


class _Saved(NamedTuple):
    """The content of a file, by vehicle: places in the Configure view, and in the Drive view."""

    vehicles: Mapping[str, Mapping[str, Place]] = MappingProxyType({})
    drive: Mapping[str, DrivePlaces] = MappingProxyType({})


def layout_problems(path: Path) -> Iterator[Problem]:
    """The problems of a file of layouts.

    raises  ConfigError if it cannot be read
    """
    document = load_file(path)
    found = schema.findings(document, "layout")
    yield from (Problem(label(path), schema.dotted(f.path), f.found, f.rule) for f in found)
    wrong = {f.path[:2] for f in found}
    for vehicle, cameras in _sections(document, "vehicles"):
        if ("vehicles", vehicle) not in wrong:
            for name, rule, _ in overlapping(_places(cameras)):
                yield Problem(label(path), f"vehicles.{vehicle}.{name}", schema.shown(cameras[name]), rule)
    for vehicle, places in _sections(document, "drive"):
        if ("drive", vehicle) not in wrong and (twice := _twice(places)):
            yield Problem(label(path), f"drive.{vehicle}", None, twice)


def _sections(document: Any, key: str) -> Iterator[tuple[str, Any]]:
    """Those of a part of the document, by vehicle."""
    part = document.get(key) if isinstance(document, dict) else None
    yield from part.items() if isinstance(part, dict) else ()


class Layouts:
    """The saved layouts of one operator.

    user      directory of the user; None: nothing can be saved
    operator  name of the operator, and of the file
    raises    UserError for an invalid name

    A file that is wrong keeps nobody from driving: the vehicle's own places apply, and `notes` says so.
    """

    def __init__(self, user: Path | None = None, operator: str = WITHOUT_KEYS) -> None:
        from runner.mqtt.messages import OPERATOR, OPERATOR_RULE

        if not OPERATOR.fullmatch(operator):
            raise UserError("keys", "", repr(operator), OPERATOR_RULE.removeprefix("topic: "))
        self.path = user / LAYOUT / f"{operator}.yaml" if user else None
        self._saved, self._problems = _Saved(), list[str]()
        try:
            self._saved = self._read()
        except ConfigError as error:
            self._problems = [str(problem) for problem in error.problems]
        except UserError as error:
            self._problems = [str(error)]

    def places(self, vehicle: Vehicle) -> Places:
        """The places of a vehicle's cameras: those saved for it, otherwise its own."""
        saved = self._saved.vehicles.get(vehicle.name)
        return own_places(vehicle) if saved is None else {name: saved.get(name) for name in vehicle.cameras}

    def has_places(self, vehicle: Vehicle) -> bool:
        """Whether places were saved for a vehicle."""
        return vehicle.name in self._saved.vehicles

    def drive_places(self, vehicle: Vehicle) -> DrivePlaces | None:
        """The places of a vehicle's cameras in the Drive view; None: they follow from the poses."""
        return self._saved.drive.get(vehicle.name)

    def notes(self, vehicle: Vehicle) -> Iterator[str]:
        """Notes about a file that is wrong, and about saved places of a vehicle that have no effect."""
        yield from (f"{problem}; the vehicle's own layout is shown" for problem in self._problems)
        named = [(f"vehicles.{vehicle.name}.{name}", name) for name in self._saved.vehicles.get(vehicle.name, {})]
        named += [(f"drive.{vehicle.name}: {name}", name) for name in _cameras(self._saved.drive.get(vehicle.name, {}))]
        for where, name in named:
            if name not in vehicle.cameras:
                yield f"{self.path}: {where}: is ignored: no such camera{suggest(name, vehicle.cameras)}"

    def save(self, vehicle: Vehicle, document: Any) -> None:
        """Write the places of a vehicle's cameras in the Configure view to the file; everything else there stays.

        document  by camera, as in the file; None: remove them, so that its own places apply
        raises    UserError if there is no directory, or the document or the present file is wrong; RunError if it
                  cannot be written
        """
        self._save("vehicles", vehicle, document, places_problem, _places)

    def save_drive(self, vehicle: Vehicle, document: Any) -> None:
        """Likewise those in the Drive view; None: they follow from the poses."""
        self._save("drive", vehicle, document, drive_places_problem, dict)

    def _save(
        self,
        part: str,
        vehicle: Vehicle,
        document: Any,
        problem_of: Callable[[Vehicle, Any], str | None],
        read: Callable[[Any], Any],
    ) -> None:
        from runner.system.files import write_whole

        if self.path is None:
            raise UserError("", "", None, NOWHERE)
        saved = self._read()
        sections = {name: section for name, section in getattr(saved, part).items() if name != vehicle.name}
        if document is not None:
            if problem := problem_of(vehicle, document):
                raise UserError("", "", None, problem)
            sections[vehicle.name] = read(document)
        saved = saved._replace(**{part: sections})
        write_whole(self.path, _text(saved).encode())
        self._saved, self._problems = saved, []

    def _read(self) -> _Saved:
        with os_errors_as(partial(UserError, str(self.path), "", None)):
            if self.path is None or not self.path.exists():
                return _Saved()
        if problems := list(layout_problems(self.path)):
            raise ConfigError(problems)
        document = load_file(self.path)
        vehicles = {name: _places(cameras) for name, cameras in document["vehicles"].items()}
        return _Saved(vehicles, document.get("drive", {}))


def own_places(vehicle: Vehicle) -> Places:
    """The places that a vehicle's file states."""
    return {name: camera.place for name, camera in vehicle.cameras.items()}


def places_problem(vehicle: Vehicle, document: Any) -> str | None:
    """The problems of places for a vehicle's cameras, in one line; None if they are valid."""
    if problem := schema.places_problem(document) or _unknown(vehicle, document):
        return problem
    return "; ".join(f"{name}: {rule}" for name, rule, _ in overlapping(_places(document))) or None


def drive_places_problem(vehicle: Vehicle, document: Any) -> str | None:
    """Likewise of places in the Drive view."""
    problem = schema.drive_places_problem(document)
    return problem or _unknown(vehicle, _cameras(document)) or _twice(document)


def _unknown(vehicle: Vehicle, names: Iterable[str]) -> str | None:
    unknown = [name for name in names if name not in vehicle.cameras][:MAX_NAMED]
    return (
        "; ".join(f"{schema.shown(name)}: unknown camera{suggest(name, vehicle.cameras)}" for name in unknown) or None
    )


def _twice(places: DrivePlaces) -> str | None:
    """The cameras with more than one place in the Drive view; None: there are none."""
    twice = [name for name, count in Counter(_cameras(places)).items() if count > 1]
    return f"must have one place for each camera; has several for {', '.join(twice)}" if twice else None


def _cameras(places: DrivePlaces) -> list[str]:
    return [*(places[place] for place in ("front", "left", "right", "rear") if place in places), *places.get("row", ())]


def _places(cameras: Mapping[str, Mapping[str, int]]) -> dict[str, Place]:
    return {name: Place(**{key: int(value) for key, value in place.items()}) for name, place in cameras.items()}


def _text(saved: _Saved) -> str:
    import yaml

    from runner.configuration.listing import dumper

    stated = {name: {camera: _stated(place) for camera, place in its.items()} for name, its in saved.vehicles.items()}
    document = {"vehicles": stated, **({"drive": dict(saved.drive)} if saved.drive else {})}
    return HEADER + yaml.dump(document, Dumper=dumper(), default_flow_style=None, sort_keys=False)


def _stated(place: Place) -> dict[str, int]:
    """A place as written to the file, without default spans."""
    spans = {"row_span": place.row_span, "column_span": place.column_span}
    return {"row": place.row, "column": place.column, **{key: span for key, span in spans.items() if span != 1}}
