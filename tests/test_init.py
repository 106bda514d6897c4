"""`init`: a directory to start from that is valid unchanged, and whose files an editor checks."""

from __future__ import annotations

import json
import os
import re
import resource
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from threading import Timer
from typing import Any

import pytest
import yaml
from helpers import CONF, Command, process

from runner.configuration.editors import FOLDER
from runner.resources import directory
from runner.verbs.init import TEMPLATES

CHECKOUT = directory("schemas").parent
SERVER = CHECKOUT / "node_modules" / ".bin" / "yaml-language-server"
SCHEMAS = sorted(path.name for path in directory("schemas").glob("*.json"))


@pytest.fixture
def fleet(tod: Command, tmp_path: Path) -> Path:
    assert tod("init", str(tmp_path / "fleet")).status == 0
    return tmp_path / "fleet"


def files(place: Path) -> dict[str, str]:
    return {str(path.relative_to(place)): path.read_text() for path in place.rglob("*") if path.is_file()}


def test_the_new_directory_is_valid(tod: Command, fleet: Path) -> None:
    assert set(files(fleet)) == {*TEMPLATES, f"{FOLDER}/VERSION", *(f"{FOLDER}/{name}" for name in SCHEMAS)}
    assert tod("validate", f"conf={fleet}").err == ""
    status, out, err = tod("print", f"conf={fleet}", "vehicle=my_vehicle", "modes=my_modes", "source=v4l2")
    assert (status, err) == (0, "")
    assert [line.partition(":")[0] for line in out.splitlines() if " kbit/s: " in line] == ["# front", "# rear"]


def test_the_rules_are_those_of_the_packaged_modes(fleet: Path) -> None:
    paths = fleet / "modes" / "my_modes.yaml", CONF / "modes" / "safe.yaml"
    own, packaged = (yaml.safe_load(path.read_text()) for path in paths)
    assert own == packaged
    assert [list(rules) for rules in own.values()] == [list(rules) for rules in packaged.values()]


def test_the_checks_run_validate(fleet: Path) -> None:
    steps = yaml.safe_load((fleet / ".github/workflows/validate.yaml").read_text())["jobs"]["validate"]["steps"]
    (hook,) = yaml.safe_load((fleet / ".pre-commit-config.yaml").read_text())["repos"][0]["hooks"]
    assert hook["entry"] == steps[-1]["run"] == "tod-runner validate conf=."
    result = process(*hook["entry"].split()[1:], cwd=fleet)
    assert (result.status, result.err) == (0, "")


def test_the_shared_hook_takes_the_files_of_a_new_directory(fleet: Path) -> None:
    """As selected by itself, and as docs/configuration.md shows for a directory below the repository's root."""
    (hook,) = yaml.safe_load((CHECKOUT / ".pre-commit-hooks.yaml").read_text())
    checked = {name for name in TEMPLATES if name.endswith(".yaml") and not name.startswith(".")}
    for pattern in (hook["files"], r"^fleet/.*\.ya?ml$"):
        included, excluded = re.compile(pattern), re.compile(hook["exclude"])
        names = [f"fleet/{name}" for name in files(fleet)]
        chosen = [name.removeprefix("fleet/") for name in names if included.search(name) and not excluded.search(name)]
        assert set(chosen) == checked
    result = process(*hook["entry"].split()[1:], *checked, cwd=fleet)
    assert (result.status, result.err) == (0, "")


@pytest.mark.parametrize("place", [".", "new/below"])
def test_a_directory_without_our_files(
    tod: Command, tmp_path: Path, place: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "cameras").mkdir()
    (tmp_path / "README.md").touch()
    monkeypatch.chdir(tmp_path)
    assert tod("init", place).status == 0
    assert (tmp_path / place / "cameras" / "my_camera.yaml").is_file()
    assert (tmp_path / "README.md").exists()


def test_nothing_is_overwritten_and_every_problem_is_named(tod: Command, tmp_path: Path) -> None:
    (tmp_path / "cameras").mkdir()
    (tmp_path / "cameras" / "my_camera.yaml").write_text("mine\n")
    (tmp_path / "modes").touch()
    (tmp_path / FOLDER).symlink_to(tmp_path / "nowhere")
    before = files(tmp_path)
    assert tod("init", str(tmp_path)) == (
        2,
        "",
        f"{tmp_path}/cameras/my_camera.yaml: already exists; init overwrites nothing\n"
        f"{tmp_path}/modes: must be a directory\n"
        f"{tmp_path}/{FOLDER}: must be a directory\n"
        "3 problems, nothing was written\n",
    )
    assert files(tmp_path) == before


@pytest.mark.parametrize("there", [False, True], ids=["new", "in use"])
def test_a_full_disk_leaves_nothing_behind(tmp_path: Path, there: bool) -> None:
    place = tmp_path / "fleet"
    if there:
        place.mkdir()
        (place / "mine").write_text("mine\n")

    def small_files() -> None:
        """A file size limit that only the schemas exceed."""
        resource.setrlimit(resource.RLIMIT_FSIZE, (4000, 4000))

    result = process("init", str(place), preexec_fn=small_files, env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"})
    assert (result.status, result.err) == (1, f"{place}: cannot be written: file too large\n")
    assert files(tmp_path) == ({"fleet/mine": "mine\n"} if there else {})
    assert len(list(tmp_path.rglob("*"))) == (2 if there else 0)


@pytest.mark.parametrize(
    ("words", "rule"),
    [
        ([], "must be one directory: init DIR"),
        (["a", "b"], "a b: must be one directory: init DIR"),
        (["a", "vehicle=tum_q7"], "vehicle=tum_q7: unknown argument; expected one of files, cameras, source, conf"),
    ],
)
def test_one_directory_is_named(
    tod: Command, words: list[str], rule: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    status, out, err = tod("init", *words)
    assert (status, out, err) == (2, "", f"command line: {rule}\n")
    assert list(tmp_path.iterdir()) == []


def test_validate_warns_of_schemas_of_another_version(tod: Command, fleet: Path) -> None:
    (fleet / FOLDER / "VERSION").write_text("0.0.1\n")
    status, out, err = tod("validate", f"conf={fleet}")
    assert status == 0 and out.startswith("valid: 3 files")
    again = f"rm -r {fleet}/{FOLDER} && tod-runner init {fleet} files=schemas"
    own = version("tod-runner")
    assert (
        err == f"{fleet}/{FOLDER}: version 0.0.1, this is tod-runner {own}; your editor may know other keys: {again}\n"
    )
    subprocess.run(["rm", "-r", fleet / FOLDER], check=True)
    assert tod("validate", f"conf={fleet}").err == ""  # no copies, nothing to report
    assert tod("init", str(fleet), "files=schemas").status == 0
    assert tod("validate", f"conf={fleet}").err == ""


# --- an editor --------------------------------------------------------------------------------------------------------


class Editor:
    """Speaks the Language Server Protocol with yaml-language-server, as an editor does."""

    def __init__(self, server: subprocess.Popen[bytes]) -> None:
        self._server = server

    def send(self, method: str, params: Any, number: int | None = None) -> None:
        message = {"jsonrpc": "2.0", "method": method, "params": params} | ({} if number is None else {"id": number})
        body = json.dumps(message).encode()
        assert self._server.stdin
        self._server.stdin.write(b"Content-Length: %d\r\n\r\n%s" % (len(body), body))
        self._server.stdin.flush()

    def ask(self, number: int, method: str, params: Any) -> Any:
        self.send(method, params, number)
        return next(message["result"] for message in self.messages() if message.get("id") == number)

    def opened(self, path: Path, text: str) -> list[str]:
        """The diagnostics of a file."""
        document = {"uri": path.as_uri(), "languageId": "yaml", "version": 1, "text": text}
        self.send("textDocument/didOpen", {"textDocument": document})
        found = (message["params"] for message in self.messages() if message.get("method", "").endswith("Diagnostics"))
        return [each["message"] for each in next(each for each in found if each["uri"] == path.as_uri())["diagnostics"]]

    def messages(self) -> Iterator[dict[str, Any]]:
        """Messages of the server; its own requests are answered with null."""
        assert self._server.stdout
        while header := self._server.stdout.readline():
            length = int(header.split(b":")[1])
            while self._server.stdout.readline().strip():
                pass
            message = json.loads(self._server.stdout.read(length))
            if "method" in message and "id" in message:
                count = len(message["params"].get("items", ())) if message["params"] else 0
                body = json.dumps({"jsonrpc": "2.0", "id": message["id"], "result": [None] * count or None}).encode()
                assert self._server.stdin
                self._server.stdin.write(b"Content-Length: %d\r\n\r\n%s" % (len(body), body))
                self._server.stdin.flush()
                continue
            yield message


@contextmanager
def editor(place: Path) -> Iterator[Editor]:
    with subprocess.Popen([SERVER, "--stdio"], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as server:
        limit = Timer(60, server.kill)  # its end is the end of its messages
        limit.start()
        try:
            one = Editor(server)
            one.ask(1, "initialize", {"processId": None, "rootUri": place.as_uri(), "capabilities": {}})
            one.send("initialized", {})
            yield one
        finally:
            limit.cancel()
            server.kill()


@pytest.mark.soak
@pytest.mark.parametrize(
    "name, right, wrong, description",
    [
        ("cameras/my_camera.yaml", "height_px", "heigth_px", "Height of the full image"),
        ("vehicle/my_vehicle.yaml", "pose", "psoe", "Where the camera sits"),
        ("modes/my_modes.yaml", "automatic", "autmatic", "Mode A: the total"),
    ],
)
def test_an_editor_checks_and_explains_keys(fleet: Path, name: str, right: str, wrong: str, description: str) -> None:
    path = fleet / name
    text = path.read_text()
    with editor(fleet) as one:
        assert one.opened(path, text) == []
        line = next(number for number, line in enumerate(text.splitlines()) if line.lstrip().startswith(f"{right}:"))
        place = {"line": line, "character": text.splitlines()[line].index(right) + 1}
        hover = one.ask(2, "textDocument/hover", {"textDocument": {"uri": path.as_uri()}, "position": place})
        assert description in str(hover["contents"]), hover
        other = path.with_name(f"misspelt_{path.name}")
        found = one.opened(other, text.replace(f"{right}:", f"{wrong}:", 1))
        assert any(wrong in message for message in found), found


def test_an_empty_directory_is_filled_and_stays_the_same(tod: Command, tmp_path: Path, monkeypatch: Any) -> None:
    """The user's shell may be in it, and it may be a mount point."""
    tmp_path.chmod(0o750)
    monkeypatch.chdir(tmp_path)
    before = tmp_path.stat()
    assert tod("init", ".").status == 0
    assert tod("validate", "conf=.").status == 0
    assert (tmp_path.stat().st_ino, tmp_path.stat().st_mode) == (before.st_ino, before.st_mode)


# --- a vehicle --------------------------------------------------------------------------------------------------------


@pytest.fixture
def courier(tod: Command, tmp_path: Path) -> Path:
    result = tod("init", str(tmp_path / "courier-1"), "cameras=front,left,rear_top", "source=v4l2")
    assert (result.status, result.err) == (0, "")
    return tmp_path / "courier-1"


def test_a_new_vehicle_is_valid_and_prints_at_once(tod: Command, courier: Path) -> None:
    assert tod("validate", f"conf={courier}").err == ""
    status, out, err = tod("print", f"conf={courier}", "vehicle=courier-1")
    assert (status, err) == (0, "")
    assert [line.partition(":")[0] for line in out.splitlines() if " kbit/s: " in line] == [
        "# front",
        "# left",
        "# rear_top",
    ]
    assert "v4l2src name=source device=/dev/video4" in out
    composed = tod("print", f"conf={courier}", "vehicle=courier-1", "pqos=courier-1", "format=yaml").out
    for origin in ("vehicle", "cameras", "graph", "modes", "pqos"):
        assert f"# {courier / origin}/courier-1" in composed, origin
    assert "yaw_deg: 180" in composed


@pytest.mark.parametrize("source", ["v4l2", "rtsp", "ros", "appsrc", "synthetic", "test"])
def test_each_source_of_a_new_vehicle_prints(source: str, tod: Command, tmp_path: Path) -> None:
    assert tod("init", str(tmp_path / "van"), "cameras=front", f"source={source}").status == 0
    assert tod("print", f"conf={tmp_path / 'van'}", "vehicle=van").status == 0


def test_its_rule_runs_once_it_is_installed(courier: Path) -> None:
    """As its README says; a directory of metadata stands for `pip install ./rules`."""
    rules = courier / "rules"
    text = (rules / "pyproject.toml").read_text()
    metadata = rules / "courier_1_rules-0.1.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: courier_1_rules\nVersion: 0.1\n")
    entry = text.strip().splitlines()[-1].replace('"', "")
    (metadata / "entry_points.txt").write_text(f"[tod_runner.rules]\n{entry}\n")
    modes = courier / "modes" / "courier-1.yaml"
    text, first, cap = modes.read_text(), "total_from_prediction: {start_kbps: 3000}", "total_cap: {cap_kbps: 700}"
    assert first in text
    environment = {**os.environ, "PYTHONPATH": f"{CHECKOUT}:{rules}"}
    words = ("print", f"conf={courier}", "vehicle=courier-1", "total_kbps=3000")
    modes.write_text(text.replace(first, f"{cap}\n  {first}"))
    assert "total_cap" in process(*words, env=environment).err  # it needs the total, which nothing has given yet
    modes.write_text(text.replace(f"{first} ", f"{first}\n  {cap} "))
    result = process(*words, env=environment)
    assert result.out.startswith("# courier-1, mode automatic, total 700 kbit/s"), result.err


@pytest.mark.parametrize(
    "words, problem",
    [
        (["van", "cameras=front,front"], "cameras: front: is named twice"),
        (["van", "cameras=front,"], "cameras: must be names of letters, digits, _ and -, as in front,rear"),
        (["1van", "cameras=front"], "NAME: 1van: must begin with a letter, and have letters, digits, _ and - only"),
        (["van", "source=v4l2"], "cameras: must be given with source=: cameras=front,left,rear"),
        (
            ["van", "cameras=front", "source=v4l"],
            "source: v4l: must be one of v4l2, rtsp, ros, appsrc, synthetic, test, did you mean v4l2?",
        ),
        (["van", "cameras=front", "files=schemas"], "files: schemas: must not be given with cameras="),
    ],
)
def test_a_vehicle_that_cannot_be_made(
    words: list[str], problem: str, tod: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = tod("init", *words)
    assert result.status == 2
    assert problem in result.err
    assert list(tmp_path.iterdir()) == []


def test_a_vehicle_overwrites_nothing(tod: Command, courier: Path) -> None:
    before = files(courier)
    result = tod("init", str(courier), "cameras=front")
    assert (result.status, files(courier)) == (2, before)
    assert f"{courier / 'README.md'}: already exists; init overwrites nothing" in result.err
