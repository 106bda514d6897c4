"""The commands in README and docs run as written, except for the length of drives and the size of pictures."""

from __future__ import annotations

import shlex
import shutil
import signal
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from drives import measured, write_drive
from helpers import Command

from rig import CHECKOUT, SMALL_ROBOT, answers, free_port, process, run, until
from runner.mqtt.broker import private_broker
from runner.settings import Endpoint
from runner.system.v4l2 import connected

DOCUMENTS = [CHECKOUT / "README.md", *sorted((CHECKOUT / "docs").glob("*.md"))]
PROGRAMS = ("tod-runner", "mosquitto_", "t=$(", "ffplay", "make", "pip")
# `make test` runs this; test_api.py installs the wheel; a player needs a screen, and test_lines.py plays without one
NOT_RUN = ("make", "pip", "ffplay", "tod-runner demo log=drive ")  # `place` runs the last
# `make soak` runs these; test_live.py drives over each graph.
LONG = (
    *("tod-runner demo experiment=", "tod-runner demo graph=", "tod-runner demo vehicle=", "tod-runner model vehicle="),
    *("tod-runner record vehicle=delivery_robot", "tod-runner tune "),
)
FEWER = [f"~cameras.top_{side}" for side in ("front", "left", "right", "rear")]
SMALL = [
    f"cameras.{name}.{key}"
    for name in ("front_left", "front_center", "front_right", "rear_center")
    for key in ("width_px=480", "height_px=260")
]
LOOP = "source.render.seconds=4"
SHORT = {  # by verb: words that make it shorter
    "demo": ["duration_s=2", "fps_max=5", "page.serve=false"],
    "vehicle": ["fps_max=5"],
    "operator": ["fps_max=5", "page.serve=false"],
    "record": ["duration_s=1.2", "fps_max=5"],
    "simulate": ["duration_s=5", "predictions=absent"],  # which many drives have with each kind of prediction
    "tune": ["duration_s=5", "seeds=2", "left_out=shared", "predictions=absent"],
    "model": ["scalings=[1.0]", "bitrates_kbps=[100,400]", "plan=full"],
}
STANDS_FOR = {
    "CLIP.mp4": "clip.mp4",
    "DRIVE...": "kept other",
    "DRIVE": "kept",
    "/tmp/rec": "robot",
    "newer/": "models/",
    "source=v4l2": "source=test",
    "camera=/dev/video0": "camera=clip.mp4",
}


def commands(document: Path) -> list[str]:
    """The command lines of a document, without their comments."""
    return [line.partition("  #")[0].strip() for line in block_lines(document) if line.startswith(PROGRAMS)]


def block_lines(document: Path) -> Iterator[str]:
    """The lines of a document's blocks without a language."""
    fence = None
    for line in document.read_text().splitlines():
        if line.startswith("```"):
            fence = line if fence is None else None
        elif fence == "```":
            yield line


# A command of two documents is run for the first.
COMMANDS = {line: document for document in reversed(DOCUMENTS) for line in commands(document)}


def test_commands_are_found() -> None:
    assert len(COMMANDS) > 40


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.stem)
def test_a_command_begins_its_line(document: Path) -> None:
    wrapped = [line for line in block_lines(document) if "tod-runner " in line and not line.startswith(PROGRAMS)]
    assert wrapped == []


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory with what the documents mention: clips, maps, vehicles, drives."""
    directory = tmp_path_factory.mktemp("docs")
    frames = "videotestsrc num-buffers=30 ! video/x-raw,width=320,height=192,framerate=25/1"
    line = [*f"{frames} ! x264enc ! mp4mux ! filesink location={directory / 'clip.mp4'}".split()]
    subprocess.run(["gst-launch-1.0", "-q", *line], check=True, timeout=60)
    shutil.copy(directory / "clip.mp4", directory / "drive.mp4")
    _, *rows = (CHECKOUT / "conf" / "maps" / "driving_test.csv").read_text().split()
    matrix = (
        f"bandwidth_map: !!opencv-matrix\n   rows: {len(rows)}\n   cols: 3\n   dt: d\n   data: [ {', '.join(rows)} ]\n"
    )
    (directory / "tum_bandwidth_map.yaml").write_text(f"%YAML:1.0\n---\n{matrix}")
    cameras = directory / "my_vehicles" / "cameras"
    cameras.mkdir(parents=True)
    text = (CHECKOUT / "conf" / "cameras" / "rear_center.yaml").read_text()
    (cameras / "rear_center.yaml").write_text(text.replace("fps: 40", "fps: 0").replace("height_px", "heigth_px"))
    words = ("log=drive", "log.video=true", *SHORT["demo"], *FEWER, *SMALL, LOOP, *ports())
    assert run("demo", *words, cwd=directory).returncode == 0
    shutil.copytree(directory / "drive", directory / "kept")
    write_drive(
        directory / "other", seconds=20, congested=0.5, change=measured
    )  # such a drive shows what the link carries
    shutil.copytree(directory / "other", directory / "drives" / "monday")
    return directory


def ports() -> tuple[str, str]:
    return f"media.port={free_port()}", f"control.port={free_port()}"


def adapted(line: str, words: tuple[str, ...] = ()) -> list[str]:
    """A command line of tod-runner, shortened, with four cameras. words: further ones for the verbs that stream."""
    for text, meaning in STANDS_FOR.items():
        line = line.replace(text, meaning)
    _, verb, *rest = shlex.split(line)
    if verb not in SHORT or rest[:1] == ["compare"]:
        return [verb, *rest]
    rest = [word for word in rest if not word.startswith("duration_s=")]
    robot = "vehicle=delivery_robot" in rest
    own = [word for word in SHORT[verb] if not any(given.startswith(word.partition("=")[0]) for given in rest)]
    if any(word.startswith("camera=") for word in rest) and verb == "demo":
        return [verb, *rest, *own, *words]
    if robot:
        own += SMALL_ROBOT[1:]
    if "source=synthetic" in rest:
        own.append(LOOP)
    elif verb != "model" and not any(word.startswith("source=") for word in rest):
        own.append("source=test")  # a drive is rendered once, for `place`
    if not robot:
        own += FEWER
        small = SMALL if verb != "model" or "source=synthetic" in rest else []
        own += [word for word in small if "~cameras.rear_center" not in rest or "rear_center" not in word]
    return [verb, *rest, *own, *(words if verb in ("demo", "vehicle", "operator") else ())]


def check_sides(line: str, place: Path) -> None:
    """Vehicle, operator or both, beside a broker, until each has printed something; then Ctrl-C."""
    words = ports()
    with private_broker(Endpoint("127.0.0.1", int(words[1].partition("=")[2]))), ExitStack() as stack:
        running = []
        for number, part in enumerate(line.split(";")):
            verb, *rest = adapted(part, words)
            output = stack.enter_context((place / f"output.{number}").open("w+"))
            running.append(stack.enter_context(process(verb, *rest, stdout=output.fileno(), cwd=place)))
        until(lambda: all((place / f"output.{number}").stat().st_size for number in range(len(running))))
        logs = [place / word.removeprefix("log=") for child in running for word in child.args if "log=" in word[:4]]
        until(lambda: all(_is_driving(log) for log in logs))
        for child in running:
            child.send_signal(signal.SIGINT)
            assert child.wait(timeout=30) in (0, 130), line


def _is_driving(log: Path) -> bool:
    """Whether a drive's files hold more than their beginning."""
    files = list(log.glob("*.jsonl"))
    return bool(files) and all(len(file.read_text().splitlines()) > 5 for file in files)


def check_shell(lines: list[str], place: Path) -> None:
    """Shell lines, beside a demo whose broker they use."""
    words = ports()
    port = words[1].partition("=")[2]
    short = [*SHORT["demo"], "duration_s=60", "source=test", *FEWER, *SMALL]
    with process("demo", *short, *words, cwd=place, stdout=subprocess.DEVNULL):
        until(lambda: answers(int(port)), seconds=60)
        script = "\n".join(["set -e", *lines]).replace("-p 1884", f"-p {port}")
        subprocess.run(["bash", "-c", script], cwd=place, check=True, timeout=60)


@pytest.mark.parametrize("document", dict.fromkeys(reversed(COMMANDS.values())), ids=lambda path: path.stem)
@pytest.mark.parametrize("long", [False, pytest.param(True, marks=pytest.mark.soak)], ids=["short", "long"])
def test_commands_run(
    document: Path, long: bool, place: Path, tod: Command, monkeypatch: pytest.MonkeyPatch, unprinted: None
) -> None:
    monkeypatch.chdir(place)
    lines = [line for line in commands(document) if COMMANDS[line] == document and not line.startswith(NOT_RUN)]
    if long:
        monkeypatch.setitem(SHORT, "record", ["duration_s=6", "fps_max=5"])  # a model needs 25 pictures
    else:
        lines = [line for line in lines if not line.startswith(LONG)]
    if shell := [line for line in lines if not line.startswith("tod-runner")]:
        check_shell(shell, place)
    for number, line in enumerate(lines):
        if line.startswith(("tod-runner vehicle", "tod-runner operator")):
            check_sides(line, place)
        elif line.startswith(("tod-runner demo", "tod-runner record")):
            done = run(*adapted(line.replace("OUT", f"{document.stem}.{number}"), ports()), cwd=place)
            assert done.returncode == 0, f"{line}\n{done.stdout}{done.stderr}"
        elif line.startswith("tod-runner"):
            words = adapted(line.replace("OUT", f"{document.stem}.{number}"))
            status, out, err = tod(*words)
            if words == ["validate", "conf=my_vehicles"]:  # with two mistakes, see `place`
                assert (status, err in document.read_text()) == (2, True)
            else:
                expected = 1 if words == ["doctor", "cameras"] and not list(connected()) else 0
                assert status == expected, f"{line}\n{out}{err}"
