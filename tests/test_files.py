"""Files that are written whole."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import CONF, out_of_reach

from runner.system.files import directory_problem, file_problem, unfinished_directory, whole_file, write_whole

PRINT = """\
from pathlib import Path
from runner.system.files import directory_problem, file_problem, unfinished_directory, whole_file, write_whole
print("before", flush=True)
with whole_file(Path("/dev/stdout")) as file:
    file.write("written\\n")
print("after")
"""


def test_a_link_leads_to_the_file_that_is_replaced(tmp_path: Path) -> None:
    target, link = tmp_path / "maps" / "today.csv", tmp_path / "latest.csv"
    target.parent.mkdir()
    target.write_text("old")
    link.symlink_to("maps/today.csv")
    with whole_file(link) as file:
        file.write("new")
    assert (link.is_symlink(), target.read_text()) == (True, "new")
    assert [path.name for path in target.parent.iterdir()] == ["today.csv"]


def test_a_redirected_standard_output_is_written_to(tmp_path: Path) -> None:
    """As root, /dev/stdout itself would be replaced."""
    output = tmp_path / "output"
    with output.open("w") as file:
        subprocess.run([sys.executable, "-c", PRINT], stdout=file, cwd=Path(CONF).parent, check=True)
    assert output.read_text() == "before\nwritten\nafter\n"
    assert Path("/dev/stdout").is_symlink()


def test_a_finished_file_reaches_the_disk_before_it_gets_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, seen = tmp_path / "map.csv", []

    def fsync(descriptor: int) -> None:
        flushed = Path(os.readlink(f"/proc/self/fd/{descriptor}"))
        seen.append(("directory" if flushed == tmp_path else flushed.read_text(), path.exists()))

    monkeypatch.setattr(os, "fsync", fsync)
    write_whole(path, b"whole")
    assert seen == [("whole", False), ("directory", True)]


def test_files_of_a_directory_reach_the_disk_before_it_gets_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, seen = tmp_path / "rosbag2", []

    def fsync(descriptor: int) -> None:
        seen.append((Path(os.readlink(f"/proc/self/fd/{descriptor}")).name, path.exists()))

    monkeypatch.setattr(os, "fsync", fsync)
    with unfinished_directory(path) as part:
        part.mkdir()
        (part / "metadata.yaml").touch()
    assert seen == [("metadata.yaml", False), ("rosbag2", False), (tmp_path.name, True)]


def test_a_path_out_of_reach_says_so_with_any_python(tmp_path: Path) -> None:
    """From 3.14 on, Path.is_file, is_dir and exists say no there."""
    closed, file = tmp_path / "closed", tmp_path / "closed" / "file"
    closed.mkdir()
    file.touch()
    assert (file_problem(file), file_problem(closed)) == (None, "must be a file")
    assert (directory_problem(closed), directory_problem(file)) == (None, "must be a directory")
    assert file_problem(closed / "none") == file_problem(file / "none") == file_problem(Path("\0")) == "no such file"
    assert directory_problem(closed / "none") == "no such directory"
    with out_of_reach(closed):
        assert file_problem(file) == directory_problem(file) == "permission denied"
