"""What a side keeps from one process to the next: a vehicle its holder, an operator without keys its id."""

from __future__ import annotations

from pathlib import Path

from runner.system.kept import IDENTITY, KeptIdentity, state_directory
from runner.vehicle.holder import SOMEBODY, Held, KeptHolder


def kept_after(path: Path, *holders: Held) -> list[str]:
    """What a vehicle reports that starts, has these holders in turn, and ends."""
    reports: list[str] = []
    kept = KeptHolder(path, reports.append)
    for holder in holders:
        kept.keep(holder)
    kept.close()
    return reports


def former(path: Path) -> Held:
    reports: list[str] = []
    kept = KeptHolder(path, reports.append)
    kept.close()
    return kept.former


def test_the_next_process_of_a_vehicle_knows_who_was_in_control_and_who_asked_to_stop(tmp_path: Path) -> None:
    path = tmp_path / "new" / "robot.json"
    assert former(path) == Held()
    assert kept_after(path, Held("alice")) == []
    assert former(path) == Held("alice")
    assert kept_after(path, Held(), Held("bob"), Held("carol", "eve")) == []
    assert former(path) == Held("carol", "eve")
    assert kept_after(path, Held("", "eve")) == []
    assert former(path) == Held("", "eve")
    assert kept_after(path, Held()) == []
    assert former(path) == Held()
    assert [each.name for each in path.parent.iterdir()] == ["robot.json"]


def test_a_file_that_cannot_be_read_means_that_somebody_was_in_control(tmp_path: Path) -> None:
    path = tmp_path / "robot.json"
    for content in ("", "{", "[]", "{}", '{"holder": 5}', '{"holder": "a b"}', '{"holder": "", "stop": 5}'):
        path.write_text(content)
        (report,) = kept_after(path)
        assert report.startswith(f"{path}: who was in control cannot be read (")
        rule = "somebody counts as lost in control, and as asking to stop; remove the file if the vehicle stands"
        assert report.endswith(rule)
        assert former(path) == Held(SOMEBODY, SOMEBODY)
    path.write_text('{"holder": "alice"}')  # by an earlier version
    assert former(path) == Held("alice")


def test_a_directory_that_cannot_be_written_is_reported(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    (report,) = kept_after(tmp_path / "file" / "robot.json", Held("alice"))
    assert report.endswith("file exists: after a restart of the vehicle anybody may get control")


def test_nothing_is_kept_without_a_directory() -> None:
    kept = KeptHolder(None, print)
    kept.keep(Held("alice"))
    kept.close()
    assert kept.former == Held()


def test_an_operator_without_keys_has_its_id_again_and_no_other_has_it_meanwhile() -> None:
    first, second = KeptIdentity("robot"), KeptIdentity("robot")
    assert first.value != second.value
    first.close()
    again, third = KeptIdentity("robot"), KeptIdentity("robot")
    assert again.value == first.value
    assert len({each.value for each in (second, again, third)}) == 3
    assert all(IDENTITY.fullmatch(each.value) for each in (second, again, third))
    for each in (second, again, third):
        each.close()
    assert KeptIdentity("robot").value == first.value
    assert KeptIdentity("other").value not in {each.value for each in (second, again, third)}


def test_an_operator_has_an_id_where_nothing_can_be_kept() -> None:
    state_directory().parent.mkdir(parents=True)
    state_directory().touch()
    first, second = KeptIdentity("robot"), KeptIdentity("robot")
    assert first.value != second.value
