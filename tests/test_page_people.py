"""The file of those who may log in at a page."""

from __future__ import annotations

import stat
from pathlib import Path

import pytest

from runner.core.roles import Role
from runner.errors import UserError
from runner.security.page_people import change_people, read_people

TOKEN, OTHER = "a" * 43, "b" * 43


def written(tmp_path: Path, text: str, mode: int = 0o600) -> Path:
    file = tmp_path / "people"
    file.write_text(text)
    file.chmod(mode)
    return file


def test_people_are_added_and_keep_their_tokens(tmp_path: Path) -> None:
    file = tmp_path / "made" / "people"
    first = change_people(file, {"bob": Role.WATCHER})
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert len(first["bob"].token) == 43
    both = change_people(file, {"carol": Role.CONTROLLER, "bob": Role.WATCHER})
    assert both["bob"] == first["bob"]
    assert both["carol"].token != first["bob"].token
    assert read_people(file) == both
    promoted = change_people(file, {"bob": Role.CONTROLLER})
    assert promoted["bob"] == first["bob"]._replace(role=Role.CONTROLLER)


def test_what_a_person_wrote_stays(tmp_path: Path) -> None:
    text = f"# ours\n\nbob   watcher {TOKEN}  # until May\ncarol watcher {OTHER}\n"
    file = written(tmp_path, text)
    before = file.stat().st_ino
    change_people(file, {"bob": Role.WATCHER})
    assert (file.read_text(), file.stat().st_ino) == (text, before)
    change_people(file, {}, revoke="carol")
    assert file.read_text() == f"# ours\n\nbob   watcher {TOKEN}  # until May\n"
    change_people(file, {}, rotate="bob")
    assert file.read_text().startswith("# ours\n\nbob watcher ")
    assert TOKEN not in file.read_text()


@pytest.mark.parametrize(
    ("line", "problem"),
    [
        ("bob watcher", "line 2: has 2 words, must have three: name, role and token"),
        (f"b/b watcher {TOKEN}", "line 2: the name must be 1 to 64 letters, digits, _ and -"),
        (f"bob driver {TOKEN}", "line 2: the role of bob must be controller or watcher"),
        ("bob watcher short", "line 2: the token of bob must have at least 32 characters"),
        (f"anna watcher {OTHER}", "line 2: anna has a line already"),
        (f"bob watcher {TOKEN}", "line 2: the token of bob is another one's, too"),
    ],
)
def test_what_is_wrong_with_a_line(tmp_path: Path, line: str, problem: str) -> None:
    file = written(tmp_path, f"anna controller {TOKEN}\n{line}\n")
    with pytest.raises(UserError) as raised:
        read_people(file)
    assert str(raised.value) == f"page.people: {file}: {problem}"


def test_all_problems_are_named_and_no_token(tmp_path: Path) -> None:
    file = written(tmp_path, f"bob {TOKEN}\ncarol {TOKEN} watcher\n", 0o644)
    with pytest.raises(UserError) as raised:
        read_people(file)
    for part in ("others may read it (mode 644); chmod 600", "line 1: ", "line 2: "):
        assert part in str(raised.value)
    assert TOKEN not in str(raised.value)


def test_a_missing_file_and_an_unknown_name_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no such file"):
        read_people(tmp_path / "people")
    file = written(tmp_path, f"bob watcher {TOKEN}\n")
    for action in ("rotate", "revoke"):
        with pytest.raises(UserError, match=f"{action}: carol: must be one of bob"):
            change_people(file, {}, **{action: "carol"})  # type: ignore[arg-type]
    assert file.read_text() == f"bob watcher {TOKEN}\n"
