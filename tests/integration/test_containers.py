"""The Containerfiles of both sides: built, started and stopped as an engine would, in directories."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

import pytest
from containerfile import (
    Bind,
    ContainerfileError,
    Image,
    bootstrap,
    build,
    entering,
    processes_in,
    read,
    starting,
)

from rig import CHECKOUT, ROBOT, needs_root, run, until

FILES = CHECKOUT / "deploy" / "containers"
CAMERAS = ("front", "rear", "mast")
SIDES = ("vehicle", "operator")
OWNERS = {"vehicle": "delivery_robot", "operator": "alice", "broker": "broker"}
LIMIT_S = 60.0
needs_debootstrap = pytest.mark.skipif(not shutil.which("debootstrap"), reason="debootstrap is not installed")


# --- the reader -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("side", SIDES)
def test_the_files_are_understood(side):
    instructions = read(FILES / f"{side}.Containerfile")
    assert [i.keyword for i in instructions if i.keyword in ("FROM", "USER", "HEALTHCHECK", "ENTRYPOINT")] == [
        *("FROM", "FROM", "USER", "HEALTHCHECK", "ENTRYPOINT")
    ]
    assert instructions[-1].words()[:4] == ["tini", "--", "tod-runner", side]


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("FROM a\nADD b /c", "x:2: ADD b /c: unknown instruction; expected one of FROM, COPY, RUN, ENV, USER"),
        ("FROM a\nRUN --mount=type=cache true", "x:2: RUN true: unknown flag --mount"),
        ("FROM a\nRUN one && \\", "x:2: RUN one && : continues on a line that is missing"),
    ],
)
def test_what_is_not_understood_is_refused(text, problem, tmp_path):
    (tmp_path / "x").write_text(text)
    with pytest.raises(ContainerfileError) as error:
        read(tmp_path / "x")
    assert str(error.value).startswith(problem)


def test_a_shell_form_is_no_entry_point(tmp_path):
    (tmp_path / "x").write_text("FROM a\nENTRYPOINT tod-runner vehicle")
    with pytest.raises(ContainerfileError, match="must be a JSON list of words"):
        read(tmp_path / "x")[1].words()


# --- the images -------------------------------------------------------------------------------------------------------


class Container(NamedTuple):
    """A started image.

    pid     its first process, as this machine numbers it
    inside  the beginning of a command that runs beside it, as its user
    """

    image: Image
    process: subprocess.Popen[str]
    pid: int
    output: Path
    logs: Path

    def run(self, *words: str) -> subprocess.CompletedProcess[str]:
        """A command in its namespaces, as `podman exec` runs it."""
        enter = ["nsenter", f"--target={self.pid}", "--mount", "--pid", "--net", "--root", "--wd"]
        command = [*enter, *starting(self.image, words)]
        return subprocess.run(command, capture_output=True, text=True, check=False, timeout=LIMIT_S)


@pytest.fixture(scope="module")
def images() -> Iterator[dict[str, Image]]:
    """Both images. TOD_BOOKWORM may name a directory that debootstrap made."""
    with tempfile.TemporaryDirectory(prefix="tod-images-", dir="/var/tmp") as name:
        directory = Path(name)
        made = os.environ.get("TOD_BOOKWORM")
        base = Path(made) if made else bootstrap("bookworm", directory)
        built = {}
        for side in SIDES:
            (directory / side).mkdir()
            built[side] = build(FILES / f"{side}.Containerfile", CHECKOUT, {"bookworm": base}, directory / side)
        yield built
        assert [pid for image in built.values() for pid in processes_in(image.root)] == []


@pytest.fixture(scope="module")
def network() -> Iterator[str]:
    """A network namespace with nothing but loopback: `--network host` of a machine without anybody else."""
    name = f"tod-images-{os.getpid()}"
    subprocess.run(["ip", "netns", "add", name], check=True)
    try:
        subprocess.run(["ip", "-n", name, "link", "set", "lo", "up"], check=True)
        yield name
        left = subprocess.run(["ip", "netns", "pids", name], check=True, capture_output=True, text=True)
        assert left.stdout == ""
    finally:
        subprocess.run(["ip", "netns", "del", name], check=True)


@pytest.fixture(scope="module")
def keys(images: dict[str, Image], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Keys of everybody; each side's belong to the user of its image."""
    directory = tmp_path_factory.mktemp("keys") / "keys"
    words = ("vehicle=delivery_robot", "host=127.0.0.1", "controller=alice", "broker=127.0.0.1")
    assert run("keys", f"output={directory}", *words).returncode == 0
    for side in SIDES:
        for path in (directory / OWNERS[side], *(directory / OWNERS[side]).iterdir()):
            os.chown(path, *images[side].ids())
    return directory


@contextmanager
def started(image: Image, network: str, place: Path, keys: Path, words: Sequence[str]) -> Iterator[Container]:
    """An image as docs/deployment.md starts it: read-only, keys and configuration read-only, volumes writable."""
    conf = place / "conf"
    conf.mkdir(parents=True)
    binds = [Bind(keys, "/etc/tod-runner/keys"), Bind(conf, "/etc/tod-runner/conf")]
    for volume in image.volumes:
        directory = place / Path(volume).parent.name
        directory.mkdir()
        os.chown(directory, *image.ids())
        binds.append(Bind(directory, volume, writable=True))
    command = entering(image.root, starting(image, [*image.entrypoint, *words]), binds)
    with (place / "output").open("w") as output:
        process = subprocess.Popen(
            ["nsenter", f"--net=/run/netns/{network}", *command], stdout=output, stderr=output, text=True
        )
    try:
        (pid,) = until(lambda: children(process.pid), LIMIT_S)
        yield Container(image, process, pid, place / "output", place / "log")
    finally:
        for left in processes_in(image.root):  # the kernel ends none with its parent after a change of user
            with suppress(ProcessLookupError):
                os.kill(left, signal.SIGKILL)
        process.kill()
        process.wait()
        until(lambda: not list(processes_in(image.root)), LIMIT_S)


def children(pid: int) -> list[int]:
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def is_zombie(pid: int) -> bool:
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"


def frames(container: Container) -> dict[str, int]:
    """What the operator's side has received so far."""
    log = container.logs / "drive" / "operator.jsonl"
    lines = log.read_text().split("\n")[:-1] if log.exists() else []
    newest = next((line for line in reversed(lines) if '"log": "sample"' in line), '{"cameras": {}}')
    return {name: camera["frames"] for name, camera in json.loads(newest)["cameras"].items()}


@pytest.mark.soak
@needs_root
@needs_debootstrap
def test_each_image_has_what_its_side_needs_and_no_more(images, network):
    for side in SIDES:
        image = images[side]
        assert image.ids()[0] != 0
        command = entering(image.root, starting(image, ["tod-runner", "doctor", side, "source=test", "keys=/none"]))
        done = subprocess.run(
            ["nsenter", f"--net=/run/netns/{network}", *command],
            capture_output=True,
            text=True,
            check=False,
            timeout=60,
        )
        assert done.returncode == 0, f"{side}\n{done.stdout}{done.stderr}"
        there = {path.name for path in (image.root / "opt/tod-runner/bin").iterdir()}
        assert there >= {"tod-runner"}
        assert "pip" not in there
        assert not any((image.root / "usr/bin" / tool).exists() for tool in ("gcc", "pip3", "curl", "mosquitto_pub"))
    assert not (images["operator"].root / "usr/lib/x86_64-linux-gnu/gstreamer-1.0/libgstx264.so").exists()
    (library,) = (images["vehicle"].root / "opt/tod-runner/lib").glob("python3*/site-packages")
    assert not (library / "plotly").exists()


@pytest.mark.soak
@needs_root
@needs_debootstrap
def test_both_images_drive_and_end(images, network, keys, tmp_path):
    robot = [word for word in ROBOT if word != "page.serve=false"]
    common = [*robot, "keys=/etc/tod-runner/keys", "control.port=8883", "log=drive"]
    broker = tmp_path / "mosquitto.conf"
    settings = (keys / "broker" / "mosquitto.conf").read_text().replace("/etc/mosquitto/tod", str(keys / "broker"))
    broker.write_text(f"{settings}\nuser root\n")
    with ExitStack() as stack:
        enter = ["nsenter", f"--net=/run/netns/{network}"]
        mosquitto = subprocess.Popen([*enter, shutil.which("mosquitto", path="/usr/sbin:/usr/bin"), "-c", broker])
        stack.callback(mosquitto.wait)
        stack.callback(mosquitto.kill)
        sides = {
            side: stack.enter_context(started(images[side], network, tmp_path / side, keys / OWNERS[side], common))
            for side in SIDES
        }
        try:
            for side in sides.values():
                until(lambda side=side: side.run(*side.image.health).returncode == 0, LIMIT_S, every_s=0.5)
                assert side.run(*side.image.health).stdout == "ok\n"
            until(lambda: all(frames(sides["operator"]).get(name, 0) > 20 for name in CAMERAS), LIMIT_S, every_s=0.5)
            for side in sides.values():
                check_init(side)
        except AssertionError:
            for name, side in sides.items():
                print(f"{name}\n{side.output.read_text()}")
            raise
        for side in reversed(sides.values()):
            os.kill(side.pid, signal.SIGTERM)
            assert side.process.wait(LIMIT_S) == 0, side.output.read_text()
            assert "Traceback" not in side.output.read_text()
        assert (sides["vehicle"].logs / "drive" / "drive.jsonl").stat().st_size > 1000


def check_init(side: Container) -> None:
    """The first process of a container reaps children that others leave behind."""
    before = children(side.pid)
    assert side.run("sh", "-c", "sleep 0.5 >/dev/null 2>&1 &").returncode == 0
    (orphan,) = until(lambda: set(children(side.pid)) - set(before), LIMIT_S)
    assert not is_zombie(orphan)
    until(lambda: children(side.pid) == before, LIMIT_S)
    assert not any(map(is_zombie, before))
