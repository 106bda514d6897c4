"""Layouts that operators save on the page: one file per operator in the user's directory, with places by vehicle."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from runner import schema
from runner.configuration.files import LAYOUT
from runner.configuration.yaml_file import label, load_file
from runner.core.model import Place, Vehicle, overlapping, suggest
from runner.errors import ConfigError, Problem, UserError, os_errors_as

WITHOUT_KEYS = "operator"  # name of an operator without keys
MAX_NAMED = 5  # unknown cameras in an answer
NOWHERE = "layouts are saved in your own directory: start this side with conf=DIR"
HEADER = """\
# yaml-language-server: $schema=../.schemas/layout.schema.json
# By vehicle and camera, where this operator has placed the pictures. Saving a layout on the page overwrites this file.
"""

Places = Mapping[str, Place | None]  # by camera; None: none


def layout_problems(path: Path) -> Iterator[Problem]:
    """The problems of a file of layouts.

    raises  ConfigError if it cannot be read
    """
    document = load_file(path)
    found = schema.findings(document, "layout")
    yield from (Problem(label(path), schema.dotted(f.path), f.found, f.rule) for f in found)
    wrong = {f.path[:2] for f in found}
    vehicles = document.get("vehicles") if isinstance(document, dict) else None
    for vehicle, cameras in vehicles.items() if isinstance(vehicles, dict) else ():
        if ("vehicles", vehicle) not in wrong:
            for name, rule in overlapping(_places(cameras)):
                yield Problem(label(path), f"vehicles.{vehicle}.{name}", schema.shown(cameras[name]), rule)


class Layouts:
    """The saved layouts of one operator.

    user      directory of the user; None: nothing can be saved
    operator  name of the operator, and of the file
    raises    UserError for an invalid name; ConfigError with all problems of the file
    """

    def __init__(self, user: Path | None = None, operator: str = WITHOUT_KEYS) -> None:
        from runner.mqtt.messages import OPERATOR, OPERATOR_RULE

        if not OPERATOR.fullmatch(operator):
            raise UserError("keys", "", repr(operator), OPERATOR_RULE.removeprefix("topic: "))
        self.path = user / LAYOUT / f"{operator}.yaml" if user else None
        self._vehicles = self._read()

    def places(self, vehicle: Vehicle) -> Places:
        """The places of a vehicle's cameras: those saved for it, otherwise its own."""
        saved = self._vehicles.get(vehicle.name)
        return own_places(vehicle) if saved is None else {name: saved.get(name) for name in vehicle.cameras}

    def notes(self, vehicle: Vehicle) -> Iterator[str]:
        """Notes about saved places of a vehicle that have no effect."""
        for name in self._vehicles.get(vehicle.name, {}):
            if name not in vehicle.cameras:
                hint = suggest(name, vehicle.cameras)
                yield f"{self.path}: vehicles.{vehicle.name}.{name}: is ignored: no such camera{hint}"

    def save(self, vehicle: Vehicle, document: Any) -> None:
        """Write the places of a vehicle's cameras to the file; those of other vehicles stay.

        document  by camera, as in the file; None: remove the vehicle, so that its own places apply
        raises    UserError if there is no directory, or the document or the present file is wrong; RunError if it
                  cannot be written
        """
        from runner.system.files import write_whole

        if self.path is None:
            raise UserError("", "", None, NOWHERE)
        vehicles = {name: places for name, places in self._read().items() if name != vehicle.name}
        if document is not None:
            if problem := places_problem(vehicle, document):
                raise UserError("", "", None, problem)
            vehicles[vehicle.name] = _places(document)
        write_whole(self.path, _text(vehicles).encode())
        self._vehicles = vehicles

    def _read(self) -> Mapping[str, Mapping[str, Place]]:
        with os_errors_as(partial(UserError, str(self.path), "", None)):
            if self.path is None or not self.path.exists():
                return {}
        if problems := list(layout_problems(self.path)):
            raise ConfigError(problems)
        return {name: _places(cameras) for name, cameras in load_file(self.path)["vehicles"].items()}


def own_places(vehicle: Vehicle) -> Places:
    """The places that a vehicle's file states."""
    return {name: camera.place for name, camera in vehicle.cameras.items()}


def places_problem(vehicle: Vehicle, document: Any) -> str | None:
    """The problems of places for a vehicle's cameras, in one line; None if they are valid."""
    if problem := schema.places_problem(document):
        return problem
    if unknown := [name for name in document if name not in vehicle.cameras][:MAX_NAMED]:
        return "; ".join(f"{schema.shown(name)}: unknown camera{suggest(name, vehicle.cameras)}" for name in unknown)
    return "; ".join(f"{name}: {rule}" for name, rule in overlapping(_places(document))) or None


def _places(cameras: Mapping[str, Mapping[str, int]]) -> dict[str, Place]:
    return {name: Place(**{key: int(value) for key, value in place.items()}) for name, place in cameras.items()}


def _text(vehicles: Mapping[str, Mapping[str, Place]]) -> str:
    import yaml

    from runner.configuration.listing import dumper

    stated = {vehicle: {name: _stated(its) for name, its in places.items()} for vehicle, places in vehicles.items()}
    return HEADER + yaml.dump({"vehicles": stated}, Dumper=dumper(), default_flow_style=None, sort_keys=False)


def _stated(place: Place) -> dict[str, int]:
    """A place as written to the file, without default spans."""
    spans = {"row_span": place.row_span, "column_span": place.column_span}
    return {"row": place.row, "column": place.column, **{key: span for key, span in spans.items() if span != 1}}
