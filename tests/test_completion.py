"""Completion in bash and zsh: what is offered, in real shells, and that it loads nothing slow."""

from __future__ import annotations

import os
import pty
import re
import resource
import select
import shlex
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
from helpers import Command, UserConf

from runner.configuration.files import GROUPS
from runner.verbs import VERBS
from runner.verbs.completion import SCRIPTS, candidates
from runner.verbs.export import OUTPUTS

PROGRAM = Path(sys.executable).with_name("tod-runner")


@pytest.fixture
def van(conf: UserConf) -> UserConf:
    """A vehicle that builds on a packaged one."""
    text = "# @package _global_\ndefaults: [delivery_robot, {/cameras@cameras.roof: compact_480p}, _self_]\nname: van\n"
    return conf.write("vehicle/van.yaml", text + "cameras: {roof: {weight: 3}, door: {fps: 10}}\n")


@pytest.mark.parametrize(
    "line, expected",
    [
        ("pri", ["print"]),
        ("--v", ["--version"]),
        ("print v", ["vehicle=", "voice=", "voice."]),
        ("print vehicle=", ["vehicle=delivery_robot", "vehicle=one_camera", "vehicle=tum_q7"]),
        ("print +graph@cameras.front_left.graph=open", ["+graph@cameras.front_left.graph=openh264_rtsp"]),
        ("print -", ["-m"]),
        ("print -m -", []),
        ("validate -", []),
        ("print fo", ["format="]),
        ("print format=", ["format=text", "format=json", "format=yaml"]),
        ("validate all=t", ["all=true"]),
        ("report output=", []),
        ("print mod", ["modes=", "mode=", "modes."]),
        ("print mode=", ["mode=single", "mode=automatic", "mode=collective"]),
        ("print insecure=", ["insecure=true", "insecure=false"]),
        ("print media.m", ["media.max_viewers="]),
        ("print pqos.rad", ["pqos.radius_m="]),
        ("print cameras.top", [f"cameras.top_{side}." for side in ("front", "left", "right", "rear")]),
        ("print vehicle=delivery_robot cameras.", ["cameras.front.", "cameras.rear.", "cameras.mast."]),
        ("print ++cameras.front_left.pose.x", ["++cameras.front_left.pose.x_m="]),
        ("print ~cameras.top_l", ["~cameras.top_left"]),
        ("print cameras.front_left.lens=", ["cameras.front_left.lens=pinhole", "cameras.front_left.lens=fisheye"]),
        ("print cameras.nobody.width", ["cameras.nobody.width_px="]),
        ("model metr", ["metric=", "metric_every=", "metrics."]),
        ("report ", ["output=", "models=", "positions=", "topic="]),
        ("keys ro", ["rotate="]),
        ("doctor demo", ["demo"]),
        ("completion ", list(SCRIPTS)),
        ("print nothing.at.all", []),
        ("fly ", []),
    ],
)
def test_offered_completions(line: str, expected: list[str]) -> None:
    *before, last = line.split(" ")
    assert candidates(before, last) == expected


def test_every_format_of_an_export_is_offered() -> None:
    assert VERBS["export"].choices["format"] == tuple(OUTPUTS)


@pytest.mark.parametrize("verb", VERBS)
def test_every_argument_and_group_is_offered(verb: str) -> None:
    offered = candidates([verb], "")
    assert {f"{name}=" for name in VERBS[verb].arguments} <= set(offered)
    assert ({f"{group}=" for group in GROUPS if group != "cameras"} <= set(offered)) == VERBS[verb].composes
    assert len(offered) == len(set(offered))


def test_files_of_the_users_directory(van: UserConf, monkeypatch: pytest.MonkeyPatch) -> None:
    assert candidates(["print", van.word], "vehicle=v") == ["vehicle=van"]
    cameras = ["cameras.front.", "cameras.rear.", "cameras.mast.", "cameras.roof.", "cameras.door."]
    assert candidates(["print", "vehicle=van", van.word], "cameras.") == cameras
    monkeypatch.setenv("TOD_CONF", str(van.path))
    assert candidates(["print", "vehicle=van"], "cameras.d") == ["cameras.door."]


def test_the_shell_gets_what_follows_its_last_break(tod: Command) -> None:
    line = "tod-runner print vehicle=del"
    assert tod("completion", "words", " =:", line) == (0, "vehicle=delivery_robot\n".partition("=")[2], "")
    assert tod("completion", "words", "", line) == (0, "vehicle=delivery_robot\n", "")


@pytest.mark.parametrize("words", [[], ["fish"], ["bash", "zsh"]])
def test_a_shell_must_be_known(tod: Command, words: list[str]) -> None:
    status, out, err = tod("completion", *words)
    assert (status, out) == (2, "")
    assert err.endswith("must be one of bash, zsh\n")


# --- real shells ------------------------------------------------------------------------------------------------------

STARTS = {
    "bash": (["bash", "--norc", "--noprofile", "-i"], ""),
    "zsh": (["zsh", "-f", "-i"], "autoload -Uz compinit; compinit -u -D; bindkey -e"),
}


def completed(shell: str, lines: list[str], place: Path) -> list[str]:
    """Each line as the shell completes it after TAB: it is echoed instead of run."""
    command, setup = STARTS[shell]
    environment = {"PATH": f"{PROGRAM.parent}:{os.environ['PATH']}", "TERM": "dumb", "HOME": str(place), "PS1": ""}
    child, terminal = pty.fork()
    if child == 0:
        os.chdir(place)
        os.execvpe(command[0], command, environment)
    try:
        # the marker is typed in two parts, so that only its output has it whole
        _answer(terminal, f'{setup}\neval "$(tod-runner completion {shell})"; echo "EN""D"\n', "END")
        outputs = [_answer(terminal, f'{line}\t\x01echo "BE""GIN" \x05 "EN""D"\n', "END") for line in lines]
    finally:
        os.close(terminal)
        os.kill(child, 9)
        os.waitpid(child, 0)
    return [re.findall(r"BEGIN (.*?) *END", output)[-1] for output in outputs]


def _answer(terminal: int, typed: str, last: str) -> str:
    """The terminal's output up to a given word."""
    os.write(terminal, typed.encode())
    output, until = "", time.monotonic() + 60
    while last not in output:
        assert select.select([terminal], [], [], max(0.0, until - time.monotonic()))[0], output
        output += os.read(terminal, 65536).decode(errors="replace")
    return output


@pytest.mark.slow
@pytest.mark.parametrize("shell", STARTS)
def test_in_a_real_shell(shell: str, van: UserConf) -> None:
    if not shutil.which(shell):
        pytest.skip(f"{shell} is not installed")
    (van.path / "drives.jsonl").touch()
    lines = {
        "tod-runner pri": "tod-runner print",
        "tod-runner print veh": "tod-runner print vehicle=",
        "tod-runner print vehicle=del": "tod-runner print vehicle=delivery_robot",
        "tod-runner print conf=. vehicle=va": "tod-runner print conf=. vehicle=van",
        "tod-runner print conf=. vehicle=van cameras.do": "tod-runner print conf=. vehicle=van cameras.door.",
        "tod-runner print cameras.front_left.pose.ya": "tod-runner print cameras.front_left.pose.yaw_deg=",
        "tod-runner replay input=dri": "tod-runner replay input=drives.jsonl",  # no word of ours: a file
    }
    assert completed(shell, list(lines), van.path) == list(lines.values())


def test_an_error_is_silent(van: UserConf) -> None:
    """In the shell: a file that cannot be read, and a line with unbalanced quotes."""
    van.write("vehicle/van.yaml", "cameras: [")
    lines = [f"tod-runner print {shlex.quote(van.word)} vehicle=van cameras.", "tod-runner print 'a b"]
    script = "\n".join(
        [
            SCRIPTS["bash"],
            *(
                f"COMP_LINE={shlex.quote(line)} COMP_POINT={len(line)}; _tod_runner {PROGRAM}; echo ${{#COMPREPLY[@]}}"
                for line in lines
            ),
        ]
    )
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, check=True, timeout=60)
    assert (done.stdout, done.stderr) == ("0\n0\n", "")
    done = subprocess.run([PROGRAM, "completion", "words", "", lines[0]], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (1, "", "")


# --- time -------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_tab_is_cheap(van: UserConf) -> None:
    """Processor time, 0.1 s where it was measured; and nothing is composed, even for names of cameras."""
    line = f"tod-runner print {shlex.quote(van.word)} vehicle=van cameras."
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run([PROGRAM, "completion", "words", "", line], capture_output=True, text=True, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert len(done.stdout.splitlines()) == 5
    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < 1
    code = "import sys; from runner.__main__ import main; main(sys.argv[1:]); print(*sys.modules)"
    words = ("completion", "words", "", line)
    done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, check=True)
    loaded = {name.partition(".")[0] for name in done.stdout.splitlines()[-1].split()}
    assert loaded.isdisjoint({"antlr4", "asyncio", "hydra", "jsonschema", "numpy", "omegaconf"})
