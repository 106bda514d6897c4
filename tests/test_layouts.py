"""Layouts that operators save: their files, what is refused, and what `validate` says of them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from helpers import Command, UserConf, vehicle

from runner.configuration.layout import HEADER, NOWHERE, Layouts, drive_places_problem, own_places, places_problem
from runner.core.model import Vehicle
from runner.core.mounting import Place
from runner.errors import ConfigError, RunError, UserError

SAVED = {
    "front": {"row": 0, "column": 0, "row_span": 2, "column_span": 2},
    "rear": {"row": 0, "column": 2},
    "mast": {"row": 1, "column": 2, "row_span": 1, "column_span": 1},
}
TEXT = """\
vehicles:
  delivery_robot:
    front: {row: 0, column: 0, row_span: 2, column_span: 2}
    rear: {row: 0, column: 2}
    mast: {row: 1, column: 2}
"""


@pytest.fixture
def robot() -> Vehicle:
    return vehicle("vehicle=delivery_robot")


def test_a_saved_layout_is_readable_and_can_be_loaded(tmp_path: Path, robot: Vehicle) -> None:
    layouts = Layouts(tmp_path, "alice")
    assert layouts.places(robot) == own_places(robot)
    layouts.save(robot, SAVED)
    assert (tmp_path / "layout" / "alice.yaml").read_text() == HEADER + TEXT
    assert [path.name for path in (tmp_path / "layout").iterdir()] == ["alice.yaml"], "nothing unfinished is left"
    for known in (layouts, Layouts(tmp_path, "alice")):
        assert known.places(robot) == {"front": Place(0, 0, 2, 2), "rear": Place(0, 2), "mast": Place(1, 2)}
    assert Layouts(tmp_path, "bob").places(robot) == own_places(robot), "each operator has a layout of their own"


def test_other_vehicles_stay_as_they_are_and_a_vehicle_can_be_forgotten(tmp_path: Path, robot: Vehicle) -> None:
    layouts, car = Layouts(tmp_path), vehicle()
    layouts.save(car, {"rear_center": {"row": 0, "column": 0}})
    text = layouts.path.read_text() if layouts.path else ""
    layouts.save(robot, SAVED)
    assert layouts.places(car)["rear_center"] == Place(0, 0)
    assert layouts.places(car)["front_center"] is None, "what is not named has no place"
    layouts.save(robot, None)
    assert layouts.places(robot) == own_places(robot)
    assert layouts.path and layouts.path.read_text() == text
    layouts.save(car, None)
    assert layouts.path.read_text() == f"{HEADER}vehicles: {{}}\n"
    assert Layouts(tmp_path).places(car) == own_places(car)


def check_problem(problem: str | None, expected: str | None, directory: Path, save: Callable[[], None]) -> None:
    """The problem is the expected one, and places that have one are not saved."""
    assert problem == expected if expected is None else expected in str(problem)
    if expected:
        with pytest.raises(UserError):
            save()
        assert list(directory.iterdir()) == []


DRIVE = {"front": "mast", "left": "front", "row": ["rear"]}


def test_places_in_the_drive_view_are_saved_beside_those_in_the_configure_view(tmp_path: Path, robot: Vehicle) -> None:
    layouts = Layouts(tmp_path, "alice")
    assert layouts.drive_places(robot) is None
    layouts.save(robot, SAVED)
    layouts.save_drive(robot, DRIVE)
    assert layouts.path and layouts.path.read_text() == (
        f"{HEADER}{TEXT}drive:\n  delivery_robot:\n    front: mast\n    left: front\n    row: [rear]\n"
    )
    for known in (layouts, Layouts(tmp_path, "alice")):
        assert (known.drive_places(robot), known.places(robot)["rear"]) == (DRIVE, Place(0, 2))
    layouts.save(robot, None)
    assert layouts.drive_places(robot) == DRIVE
    layouts.save_drive(robot, None)
    assert layouts.drive_places(robot) is None
    assert layouts.path.read_text() == f"{HEADER}vehicles: {{}}\n"


@pytest.mark.parametrize(
    ("document", "expected"),
    [
        (DRIVE, None),
        ({"front": "rear"}, None),
        ({}, "front: missing: must be given"),
        ({"front": 1}, "front: 1: must be text"),
        ({"front": "mast", "middle": "rear"}, "middle: unknown key"),
        ({"front": "mast", "row": "rear"}, "row: 'rear': must be a list"),
        ({"front": "fornt", "row": ["x"]}, "'fornt': unknown camera, did you mean front?; 'x': unknown camera"),
        ({**DRIVE, "row": ["mast", "front"]}, "must have one place for each camera; has several for mast, front"),
    ],
)
def test_places_in_the_drive_view_are_checked(
    robot: Vehicle, tmp_path: Path, document: Any, expected: str | None
) -> None:
    save = Layouts(tmp_path, "alice").save_drive
    check_problem(drive_places_problem(robot, document), expected, tmp_path, lambda: save(robot, document))


def test_changes_made_by_the_user_meanwhile_are_kept_or_reported(tmp_path: Path, robot: Vehicle) -> None:
    layouts = Layouts(tmp_path, "alice")
    assert layouts.path
    layouts.save(robot, SAVED)
    layouts.path.write_text("vehicles:\n  van:\n    rear: {row: 3, column: 0}\n")
    layouts.save(robot, SAVED)
    assert layouts.path.read_text() == f"{HEADER}vehicles:\n  van:\n    rear: {{row: 3, column: 0}}\n" + TEXT[10:]
    broken = "vehicles:\n  van:\n    rear: {row: 3}\n"
    layouts.path.write_text(broken)
    with pytest.raises(ConfigError, match=r"vehicles\.van\.rear\.column: missing: must be given"):
        layouts.save(robot, None)
    assert layouts.path.read_text() == broken


@pytest.mark.parametrize("name", ["", ".", "..", "../alice", "/etc/passwd", "a/b", "a\\b", "a\n", "ä", "a" * 65, "a\0"])
def test_invalid_operator_names_are_rejected(tmp_path: Path, name: str) -> None:
    (tmp_path / "conf").mkdir()
    with pytest.raises(UserError, match="an operator's id must be 1 to 64 letters, digits, _ and -"):
        Layouts(tmp_path / "conf", name)
    assert [path.name for path in tmp_path.rglob("*")] == ["conf"]


def test_without_a_directory_nothing_is_saved(robot: Vehicle) -> None:
    layouts = Layouts()
    assert layouts.places(robot) == own_places(robot)
    with pytest.raises(UserError, match=f"^{NOWHERE}$"):
        layouts.save(robot, SAVED)


def test_write_errors_are_reported(tmp_path: Path, robot: Vehicle) -> None:
    (tmp_path / "layout").touch()
    layouts = Layouts(tmp_path, "alice")
    with pytest.raises(RunError, match=r"layout/alice\.yaml: cannot be written: "):
        layouts.save(robot, SAVED)
    assert layouts.places(robot) == own_places(robot)


PLACE = {"row": 0, "column": 0}


@pytest.mark.parametrize(
    ("document", "expected"),
    [
        (SAVED, None),
        ({}, None),
        ([], "[]: must be a mapping"),
        ("front", "'front': must be a mapping"),
        ({"front": 1}, "front: 1: must be a mapping"),
        ({"front": {"row": 0}}, "front.column: missing: must be given"),
        ({"front": {"row": -1, "column": 0}}, "front.row: -1: must be at least 0"),
        ({"front": {"row": 0.5, "column": 0}}, "front.row: 0.5: must be a whole number"),
        ({"front": {"row": True, "column": 0}}, "front.row: true: must be a whole number"),
        ({"front": {**PLACE, "column_span": 13}}, "front.column_span: 13: must be at most 12"),
        ({"front": {**PLACE, "colum_span": 2}}, "front.colum_span: unknown key, did you mean column_span?"),
        ({"fornt": PLACE, "x": PLACE}, "'fornt': unknown camera, did you mean front?; 'x': unknown camera"),
        ({"front": PLACE, "rear": PLACE, "mast": PLACE}, "rear: overlaps the place of camera front; mast: overlaps"),
        ({str(number): PLACE for number in range(101)}, "must have at most 100 entries"),
    ],
)
def test_places_from_a_page_are_checked(robot: Vehicle, tmp_path: Path, document: Any, expected: str | None) -> None:
    save = Layouts(tmp_path, "alice").save
    check_problem(places_problem(robot, document), expected, tmp_path, lambda: save(robot, document))


def test_a_saved_place_of_a_removed_camera_is_reported(tmp_path: Path, robot: Vehicle) -> None:
    (tmp_path / "layout").mkdir()
    text = "vehicles: {delivery_robot: {fornt: {row: 0, column: 0}}}\ndrive: {delivery_robot: {front: mats}}\n"
    (tmp_path / "layout" / "alice.yaml").write_text(text)
    assert [
        note.removeprefix(f"{tmp_path}/layout/alice.yaml: ") for note in Layouts(tmp_path, "alice").notes(robot)
    ] == [
        "vehicles.delivery_robot.fornt: is ignored: no such camera, did you mean front?",
        "drive.delivery_robot: mats: is ignored: no such camera, did you mean mast?",
    ]


@pytest.mark.parametrize(
    "content, problem",
    [
        (
            "vehicles: {delivery_robot: {mast: {row: 0}}}\n",
            "vehicles.delivery_robot.mast.column: missing: must be given",
        ),
        ("vehicles: [\n", "line 2: expected the node content, but found '<stream end>'"),
        (b"\xff\xfe", None),
        (None, None),  # a folder
    ],
)
def test_a_wrong_file_keeps_nobody_from_driving(
    tmp_path: Path, robot: Vehicle, content: str | bytes | None, problem: str | None
) -> None:
    path = tmp_path / "layout" / "alice.yaml"
    path.parent.mkdir()
    if content is None:
        path.mkdir()
    else:
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    layouts = Layouts(tmp_path, "alice")
    (note,) = layouts.notes(robot)
    assert layouts.places(robot) == own_places(robot)
    assert note.startswith(f"{path}: {problem or ''}")
    assert note.endswith("; the vehicle's own layout is shown")
    with pytest.raises(UserError):  # it stays as it is until it is mended
        layouts.save(robot, SAVED)
    if isinstance(content, str):
        assert path.read_text() == content
        path.unlink()
        layouts.save(robot, SAVED)
        assert layouts.places(robot)["rear"] == Place(0, 2)
        assert not list(layouts.notes(robot))


# --- validate ---------------------------------------------------------------------------------------------------------


def test_validate_knows_the_files(tod: Command, conf: UserConf) -> None:
    conf.write("layout/alice.yaml", TEXT).write("layout/7.yaml", "vehicles: {}\n")
    status, out, _ = tod("validate", conf.word)
    assert (status, out.splitlines()[0]) == (0, "valid: 2 files, 1 configuration")
    status, out, _ = tod("validate", str(conf.path / "layout" / "alice.yaml"))
    assert (status, out.splitlines()[0]) == (0, "valid: 1 file, 0 configurations")


def test_validate_names_every_mistake(tod: Command, conf: UserConf) -> None:
    mistakes = """\
vehicles:
  delivery_robot:
    mast: {row: 0}
  my van: {}
  van:
    front: {row: 0, column: 0, row_span: 2}
    rear: {row: 1, column: 0}
drive:
  van: {front: a, rear: a}
  bus: {left: a}
"""
    conf.write("layout/alice.yaml", mistakes).write("layout/empty.yaml", "").write("layout/a,b.yaml", TEXT)
    conf.write("layout/x/y.yaml", TEXT).write("layout/bob.yml", TEXT).write("layout/eve.yaml", "vehicles: [\n")
    conf.write("layout/mallory.yaml", f"{TEXT}vehicels: {{}}\n")
    found = [line.replace(str(conf.path), "~") for line in tod("validate", conf.word).problems]
    assert sorted(found) == [
        "~/layout/a,b.yaml: would be ignored: no operator can have this name",
        "~/layout/alice.yaml: drive.bus.front: missing: must be given",
        "~/layout/alice.yaml: drive.van: must have one place for each camera; has several for a",
        "~/layout/alice.yaml: vehicles.delivery_robot.mast.column: missing: must be given",
        '~/layout/alice.yaml: vehicles.van.rear: {"row": 1, "column": 0}: overlaps the place of camera front',
        "~/layout/alice.yaml: vehicles: 'my van': must be letters, digits, _ and - only",
        "~/layout/bob.yml: would be ignored: the page reads bob.yaml",
        "~/layout/empty.yaml: null: must be a mapping",
        "~/layout/eve.yaml: line 2: expected the node content, but found '<stream end>'",
        "~/layout/mallory.yaml: vehicels: unknown key, did you mean vehicles?",
        "~/layout/x/y.yaml: would be ignored: files must be directly in layout/, not in subfolders",
    ]
