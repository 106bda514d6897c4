"""The command line: verbs, help, exit statuses, no GStreamer where none is needed, silence where nobody listens."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest
from helpers import Command, process

from runner.verbs import VERBS

PAPER = ("modes=paper", "source=test")
EVENT = '{"t": 0, "event": "bitrate_predicted", "kbps": 3000}\n'


def test_the_version(tod: Command) -> None:
    assert tod("--version") == (0, f"tod-runner {version('tod-runner')}\n", "")


@pytest.mark.parametrize("words", [["--help"], ["-h"], ["help"], []])
def test_the_usage_names_every_verb(tod: Command, words: list[str]) -> None:
    status, out, err = tod(*words)
    assert (status, err) == (0 if words else 2, "")
    for name, verb in VERBS.items():
        assert f"  {name:10}{verb.summary}" in out.splitlines()


@pytest.mark.parametrize("verb", VERBS)
def test_help_of_a_verb_shows_examples(tod: Command, verb: str) -> None:
    status, out, err = tod(verb, "--help")
    assert (status, err) == (0, "")
    assert out.startswith(f"usage: tod-runner {verb}")
    assert f"  tod-runner {verb}" in out


@pytest.mark.parametrize(
    "words, told",
    [
        (["prnt"], "command line: prnt: unknown verb, did you mean print?"),
        (["fly"], f"command line: fly: unknown verb, there is {', '.join(VERBS)}"),
        (["print", "--total", "3"], "command line: --total: there are no flags; write NAME=VALUE, or --help"),
        (["print", "total_kbps"], "command line: total_kbps: must be NAME=VALUE"),
        (["replay", "conf=/nowhere"], "command line: conf: /nowhere: no such directory"),
    ],
)
def test_words_that_are_no_command(tod: Command, words: list[str], told: str) -> None:
    assert tod(*words) == (2, "", f"{told}\n")


def test_an_argument_of_another_verb_is_an_unknown_key(tod: Command) -> None:
    (problem,) = tod("print", "source=test", "input=a.jsonl").problems
    assert problem.startswith("command line: input: unknown key, ")


def test_the_conf_of_the_environment_must_be_there_too(tod: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TOD_CONF", "/nowhere")
    assert tod("print") == (2, "", "command line: conf: /nowhere: no such directory\n")


# --- no GStreamer -----------------------------------------------------------------------------------------------------


@pytest.fixture
def without_gstreamer(tmp_path: Path) -> dict[str, str]:
    """An environment in which PyGObject cannot be imported."""
    (tmp_path / "gi").mkdir()
    (tmp_path / "gi" / "__init__.py").write_text("raise ImportError('there is no gi here')\n")
    path = os.pathsep.join(filter(None, (str(tmp_path), os.environ.get("PYTHONPATH"))))
    return {**os.environ, "PYTHONPATH": path}


def test_print_replay_and_validate_need_no_gstreamer(without_gstreamer: dict[str, str]) -> None:
    result = process("print", "source=test", "format=json", env=without_gstreamer)
    assert (result.status, result.err) == (0, "")
    assert len(json.loads(result.out)["cameras"]) == 8
    result = process("replay", *PAPER, stdin=EVENT, env=without_gstreamer)
    assert (result.status, result.err) == (0, "")
    one = ("vehicle=delivery_robot", "modes=paper", "graph=h264_rtsp", "source=test")
    result = process("validate", *one, env=without_gstreamer)
    assert (result.status, result.err) == (0, "")
    assert result.out.splitlines()[1:] == [
        "nothing was checked against the GStreamer registry: its Python bindings are not installed"
    ]


@pytest.mark.parametrize("verb", ["print", "replay"])
def test_they_do_not_import_it_where_it_is(verb: str) -> None:
    program = (
        "import sys; from runner.__main__ import main; "
        f"main([{verb!r}, 'modes=paper', 'source=test']); sys.exit('gi' in sys.modules)"
    )
    result = subprocess.run([sys.executable, "-c", program], input=b"", capture_output=True, check=False)
    assert result.returncode == 0, result.stderr


# --- nobody listens ---------------------------------------------------------------------------------------------------


def test_a_closed_standard_output_ends_silently() -> None:
    replay = subprocess.Popen(
        [sys.executable, "-m", "runner", "replay", *PAPER],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    assert replay.stdout and replay.stdin
    replay.stdin.write(EVENT.encode())
    replay.stdin.flush()
    replay.stdout.readline()
    replay.stdout.close()
    replay.stdout = None
    _, err = replay.communicate(EVENT.encode() * 3, timeout=20)
    assert (replay.returncode, err) == (0, b"")


@pytest.mark.parametrize("words", [["print", "source=test"], ["--help"], ["print", "--help"], ["--version"]])
def test_a_standard_output_closed_from_the_start(words: list[str]) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run([sys.executable, "-m", "runner", *words], stdout=writer, stderr=subprocess.PIPE, check=False)
    os.close(writer)
    assert (done.returncode, done.stderr) == (0, b"")


def test_ctrl_c_ends_with_130() -> None:
    replay = subprocess.Popen(
        [sys.executable, "-m", "runner", "replay", *PAPER],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    assert replay.stdout and replay.stdin
    replay.stdin.write(EVENT.encode())
    replay.stdin.flush()
    replay.stdout.readline()
    replay.send_signal(signal.SIGINT)
    _, err = replay.communicate(timeout=20)
    assert (replay.returncode, err) == (130, b"")
