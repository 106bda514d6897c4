"""Sweeps (-m) in Hydra's grammar, and the flags of Hydra that have no counterpart."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import Command
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins
from hydra.plugins.sweeper import Sweeper

from runner.configuration.overrides import MAX_RUNS, sweep
from runner.drive.log import FILES
from runner.verbs import HYDRA_FLAGS, VERBS

SMALL = ("source=test", "vehicle=delivery_robot")
SWEEPING = [name for name, verb in VERBS.items() if verb.sweeps]


@pytest.mark.parametrize(
    "words",
    [
        ["a=1,2", "b=x", "c=range(1,4)"],
        ["a=choice(x,y)", "modes=paper,safe", "+b=range(0,1,0.25)"],
        ["a=[1,2],[3]", "b={x:1},{y:2}", 'c="a,b",c', "d=sort(3,1,2)", "e=null,true"],
        ["vehicle=tum_q7"],
        [],
    ],
)
def test_the_runs_are_those_of_hydras_own_sweeper(words: list[str]) -> None:
    overrides = [OverridesParser.create().parse_override(word) for word in words]
    (basic,) = (each for each in Plugins.instance().discover(Sweeper) if each.__name__ == "BasicSweeper")
    (batch,) = basic.split_arguments(overrides, None)
    assert [list(run) for run in sweep(words)] == batch


@pytest.mark.parametrize(
    "words, problems",
    [
        (["fps_max=interval(1,2)"], ["fps_max=interval(1,2): cannot be enumerated; a sweep is "]),
        (["vehicle=glob(*)", "mode=1,"], ["vehicle=glob(*): cannot be enumerated", "mode=1,: "]),
        (["hydra.run.dir=a,b"], ["hydra.run.dir=a,b: no such key"]),
        (["total_kbps=range(0,1e9)"], [f"-m: {MAX_RUNS + 1} runs or more: must be at most {MAX_RUNS}"]),
        (["fps_max=range(1,41)", "total_kbps=range(0,30)"], ["-m: 1200 runs or more: must be at most 1000"]),
        (["fps_max=range(1,9,0)"], ["fps_max=range(1,9,0): a range needs numbers, and a step other than 0"]),
        (["fps_max=range(1,9,nan)"], ["fps_max=range(1,9,nan): a range needs numbers, and a step other than 0"]),
        (["fps_max=0,-1,10"], ["fps_max: 0: must be above 0", "fps_max: -1: must be above 0"]),  # of all runs
    ],
)
def test_problems_are_reported_before_anything_runs(tod: Command, words: list[str], problems: list[str]) -> None:
    found = tod("print", "-m", *SMALL, *words).problems
    assert len(found) == len(problems)
    for one, expected in zip(found, problems, strict=True):
        assert one.startswith(f"command line: {expected}")


def test_print(tod: Command) -> None:
    status, out, err = tod("print", *SMALL, "modes=paper,safe", "-m", "total_kbps=range(1000,3000,1000)")
    runs = [json.loads(line) for line in out.splitlines()]
    assert (status, err) == (0, "")
    assert [run.pop("overrides") for run in runs] == [
        [*SMALL, f"modes={modes}", f"total_kbps={total}"] for modes in ("paper", "safe") for total in (1000, 2000)
    ]
    assert [run["total_kbps"] for run in runs] == [1000, 2000, 1000, 2000]
    assert runs[1] == json.loads(tod("print", *SMALL, "modes=paper", "total_kbps=2000", "format=json").out)


@pytest.fixture
def events(tmp_path: Path) -> Path:
    path = tmp_path / "events.jsonl"
    path.write_text("".join(f'{{"t": {t}, "event": "bitrate_predicted", "kbps": {3000 + t}}}\n' for t in range(3)))
    return path


def test_replay(tod: Command, events: Path, tmp_path: Path) -> None:
    words = (*SMALL, "cameras.front.weight=1,3", f"input={events}")
    status, out, err = tod("replay", "-m", *words)
    assert (status, err) == (0, "")
    lines = [json.loads(line) for line in out.splitlines()]
    assert [(line.pop("overrides")[-1], line["t"]) for line in lines] == [
        (f"cameras.front.weight={weight}", t) for weight in (1, 3) for t in (0, 1, 2)
    ]
    alone = tod("replay", *SMALL, "cameras.front.weight=3", f"input={events}").out
    assert lines[3:] == [json.loads(line) for line in alone.splitlines()]
    assert tod("replay", "-m", *words, f"log={tmp_path / 'log'}") == (0, "", "")
    firsts = [(tmp_path / "log" / name / FILES["vehicle"]).read_text().splitlines()[0] for name in ("0", "1")]
    assert [json.loads(line)["config"]["cameras"]["front"]["weight"] for line in firsts] == [1, 3]


def test_replay_reads_a_file(tod: Command) -> None:
    message = "command line: -m: reads the events once for each run: give input=FILE\n"
    assert tod("replay", "-m", "modes=paper,safe") == (2, "", message)


@pytest.mark.parametrize("verb", VERBS)
def test_without_the_flag_a_comma_is_an_error(tod: Command, verb: str) -> None:
    """-m is also a flag, of verbs that do not sweep."""
    if verb in SWEEPING:
        words = (verb, "modes=paper,safe", *(["input=/dev/null"] if verb == "replay" else []))
        assert "which print, replay and demo run with -m; write [a,b,c]" in tod(*words).err
    else:
        assert tod(verb, "-m") == (2, "", "command line: -m: must follow one of print, replay, demo\n")


# --- flags ------------------------------------------------------------------------------------------------------------


@pytest.mark.skipif(sys.version_info >= (3, 14), reason="Hydra 1.3 cannot show its help there")
def test_all_flags_of_hydra_are_known(tmp_path: Path) -> None:
    """--help and --version are supported, and -m by three verbs."""
    app = tmp_path / "app.py"
    app.write_text("import hydra\n\n\n@hydra.main(version_base=None, config_path=None)\ndef app(_): ...\n\n\napp()\n")
    command = [sys.executable, app, "--hydra-help"]
    listed = subprocess.run(command, capture_output=True, text=True, check=True).stdout.partition("== Flags ==")[2]
    known = {flag for flags in re.findall(r"(?m)^(-\S+)", listed) for flag in flags.strip(":").split(",")}
    answered = {flag for flags in HYDRA_FLAGS for flag in flags}
    assert known - {"--help", "-h", "--version", "-m"} == answered


def test_every_flag_of_hydra_has_an_answer(tod: Command) -> None:
    """One line and status 2, with and without a verb."""
    for flags, instead in HYDRA_FLAGS.items():
        for flag in flags:
            expected = (2, "", f"command line: {flag}: flags are not supported; {instead}\n")
            assert tod("demo", flag, "job") == tod(flag) == expected
            assert tod("print", f"{flag}=x") == (2, "", expected[2].replace(f"{flag}:", f"{flag}=x:"))


def test_the_flags_are_documented() -> None:
    page = (Path(__file__).parents[1] / "docs" / "commands.md").read_text()
    for flags, instead in HYDRA_FLAGS.items():
        assert f"| {', '.join(f'`{flag}`' for flag in flags)} | {instead} |" in page
