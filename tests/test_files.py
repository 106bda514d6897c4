"""Files that are written whole."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from helpers import CONF

from runner.system.files import whole_file

PRINT = """\
from pathlib import Path
from runner.system.files import whole_file
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
