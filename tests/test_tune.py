"""Other numbers of a modes file, tried by simulation."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from math import inf, nan
from pathlib import Path

import pytest
from helpers import CONF, Command, UserConf

from rig import children_named, until
from runner.configuration.config import configuration
from runner.errors import ConfigError
from runner.simulation.comparison import Difference, differences, verdict
from runner.simulation.numbers import Modes, trials
from runner.simulation.runs import Job, Result

RULES: Modes = {
    "automatic": {
        "total_from_prediction": {"start_kbps": 3000},
        "follow_link": {"ceiling": "none", "reserve_kbps": 0, "start": 0.6, "after_s": 2, "halve_every_s": 1},
        "demand_from_roi": {},
        "calm": {"rule": "hold_while_capped", "for_s": 0.75},
    }
}
SIMULATED = ("vehicle=delivery_robot", "fps_max=5", "links=saw", "predictions=right", "duration_s=4")
SHORT = (*SIMULATED, "left_out=step")
NOTHING = Difference(0.0, 0.0)


def tried(vary: str | None) -> list[str]:
    return [trial.override.removeprefix("modes.automatic.") for trial in trials(vary, RULES, ["automatic"])[0]]


def test_each_number_of_the_modes_file_is_halved_and_doubled() -> None:
    assert tried(None) == [
        *("total_from_prediction.start_kbps=1500", "total_from_prediction.start_kbps=6000"),
        "follow_link.start=0.3",  # twice as much would be more than all
        *("follow_link.after_s=1", "follow_link.after_s=4"),
        *("follow_link.halve_every_s=0.5", "follow_link.halve_every_s=2"),
        *("calm.for_s=0.375", "calm.for_s=1.5"),
    ]
    zero = "automatic.follow_link.reserve_kbps is 0, which cannot be halved and doubled: vary= can give it values"
    assert trials(None, RULES, ["automatic"])[1] == [zero]


@pytest.mark.parametrize(
    "vary, expected",
    [
        ("automatic.follow_link.start=[0.25, 0.6, 1]", ["follow_link.start=0.25", "follow_link.start=1"]),
        ("modes.automatic.follow_link.start=0.25,1", ["follow_link.start=0.25", "follow_link.start=1"]),
        ("automatic.follow_link.after_s=range(1,4)", ["follow_link.after_s=1", "follow_link.after_s=3"]),
        ("automatic.follow_link.floor_kbps=100", ["follow_link.floor_kbps=100"]),  # the file does not state it
        (
            "automatic.follow_link.start automatic.calm.for_s=2",
            ["follow_link.start=0.3", "calm.for_s=2"],
        ),
        (
            "automatic.follow_link.start=1 automatic.calm",
            ["follow_link.start=1", "calm.for_s=0.375", "calm.for_s=1.5"],
        ),
    ],
)
def test_numbers_are_named_by_mode_and_rule(vary: str, expected: list[str]) -> None:
    assert tried(vary) == expected


def test_wrong_names_and_values_are_reported_together() -> None:
    wrong = {
        "automatic.folow_link.start": "mode automatic has no such rule, did you mean follow_link?",
        "automatic.follow_link.strat=1": "follow_link has no such number, did you mean start?",
        "follow_link.start": "must begin with the mode, MODE.RULE.NUMBER, did you mean automatic.follow_link.start?",
        "single.follow_link": "no drive is in mode single: choose it with mode=single",
        "automatic.follow_link.ceiling": "is a word, not a number",
        "automatic.demand_from_roi": "demand_from_roi has no numbers",
        "automatic.1.follow_link": "mode automatic has no such rule; expected one of "
        "total_from_prediction, follow_link, demand_from_roi, calm",
        "automatic.follow_link.start=[-1]": "-1: must be a number of 0 or more",
        "automatic.follow_link.halve_every_s=0": "0: must be above 0",
    }
    with pytest.raises(ConfigError) as raised:
        trials(" ".join(wrong), RULES, ["automatic"])
    lines = [f"command line: vary: {name.partition('=')[0]}: {rule}" for name, rule in wrong.items()]
    assert str(raised.value).splitlines() == [*lines, "9 problems, nothing was started"]


def test_a_difference_is_that_of_the_same_drives_and_its_spread_that_over_seeds() -> None:
    def results(*values: float) -> list[Result]:
        jobs = [Job("saw", 0.0, kind, seed) for seed in (1, 2, 3) for kind in ("right", "absent")]
        figures = [{"use": 0.9, "p95": value, "p99": 0.0, "frozen": 0.0} for value in values]
        return [Result(job, some, 0.0, None) for job, some in zip(jobs, figures, strict=True)]

    found = differences(results(10, 100, 20, 200, 30, 300), results(13, 99, 22, 202, 32, 304))
    assert found["p95"] == pytest.approx((2.0, 3 / 3**0.5))  # of the seeds: 1, 2, 3
    assert found["use"] == NOTHING
    unknown = differences(results(10, 100, 20, 200, 30, 300), results(nan, 99, nan, nan, nan, nan))["p95"]
    assert unknown == (-1.0, inf)  # one seed has a frame to measure


@pytest.mark.parametrize(
    "tuned, left_out, expected",
    [
        ({}, {}, "keeps: changes nothing"),
        ({"use": (0.02, 0.01)}, {"use": (0.006, 0.005)}, "better in use"),
        ({"p95": (-5, 1)}, {"p95": (-3, 1), "use": (-0.004, 0.0)}, "better in p95"),
        ({"use": (0.02, 0.01)}, {"use": (0.006, 0.007)}, "keeps: better in use only where it is tuned"),
        ({"use": (0.02, 0.03)}, {"use": (0.02, 0.03)}, "keeps: no clear difference"),
        ({"use": (0.02, 0.01), "p95": (3, 9)}, {"use": (0.02, 0.01)}, "keeps: worse in p95 (tuned)"),
        ({"use": (-0.02, 0.0)}, {"use": (-0.02, 0.0), "frozen": (0.4, 0)}, "keeps: worse in use, frozen (left out)"),
    ],
)
def test_a_value_is_better_on_both_sets_or_the_one_in_force_stays(
    tuned: dict[str, tuple[float, float]], left_out: dict[str, tuple[float, float]], expected: str
) -> None:
    every = dict.fromkeys(("use", "p95", "p99", "frozen"), NOTHING)
    sets = [every | {key: Difference(*change) for key, change in some.items()} for some in (tuned, left_out)]
    assert verdict(*sets) == expected


def test_the_table_has_a_row_for_each_value(tod: Command, tmp_path: Path) -> None:
    """The override that it names sets the value: a simulated drive under it has the same figures."""
    output, again = tmp_path / "tuned.json", tmp_path / "again.json"
    override = "modes.automatic.total_from_prediction.start_kbps=600"
    words = ("seeds=2", "since_s=0", "workers=1")
    result = tod("tune", *SHORT, *words, "vary=automatic.total_from_prediction.start_kbps=600", f"output={output}")
    assert result.status == 0 and "1 value and those in force, on 4 drives each" in result.err
    first, _, in_force, value, blank, criterion = result.out.splitlines()
    assert first.startswith("| override | use | p95 ms | p99 ms | frozen % | left out: use |")
    assert in_force.startswith("| in force |") and value.startswith(f"| {override} |") and blank == ""
    assert criterion.startswith("better: on both sets of links use rises by over 0.005,")
    drives = json.loads(output.read_text())["drives"]
    each = [("saw", 1), ("saw", 2), ("step", 100), ("step", 101)]
    assert [(one["link"], one["seed"]) for one in drives] == each * 2
    assert [one["words"] for one in drives] == [[]] * 4 + [[override]] * 4
    assert tod("simulate", *SIMULATED, *words, override, f"output={again}").status == 0
    assert [one["use"] for one in json.loads(again.read_text())] == [one["use"] for one in drives[4:6]]
    assert drives[4]["use"] < drives[0]["use"]


@pytest.mark.slow
def test_the_figure_is_drawn(tmp_path: Path) -> None:
    from runner.simulation.comparison import Compared
    from runner.simulation.tuning_picture import draw

    def means(use: float, p95: float) -> dict[str, float]:
        return {"use": use, "p95": p95, "p99": nan, "frozen": 0.0}

    every = dict.fromkeys(("use", "p95", "p99", "frozen"), NOTHING)
    tried, _ = trials("automatic.follow_link", RULES, ["automatic"])
    values = [Compared(trial, (means(0.9, 50), means(0.8, nan)), (every, every)) for trial in tried]
    draw([means(0.91, 49), means(0.81, 60)], values, tmp_path / "tuned.svg")
    text = (tmp_path / "tuned.svg").read_text()
    for shown in ("links for tuning", "links left out", "in force", "automatic.follow_link.halve_every_s"):
        assert f"<!-- {shown}" in text


@pytest.mark.parametrize(
    "words, expected",
    [
        (["links=saw,handover"], "links: handover: left out: a number that is chosen there cannot be checked there"),
        (["links=step"], "links: step: left out: a number that is chosen there cannot be checked there"),
        (["left_out=,"], "left_out: ',': must have one name at least"),
        (["seeds=1"], "seeds: 1: must be 2 or more: a difference has to exceed what they spread"),
        (
            ["vary=automatic.total_from_prediction.start_kbps=3000"],
            "vary: automatic.total_from_prediction.start_kbps=3000: gives no value but those in force",
        ),
        (["seeds=5-3"], "seeds: '5-3': must be their number, or the first and the last: 3 or 100-102"),
        (["seeds=1-99999999"], "seeds: '1-99999999': must be 1000 at most"),
        (["duration_s=3"], "duration_s: 3: must be at least 4: the first 3 s do not count"),
        (["figure=x.txt"], "figure: 'x.txt': must end in .png, .pdf, .svg"),
    ],
)
def test_wrong_arguments(tod: Command, words: list[str], expected: str) -> None:
    result = tod("tune", *SHORT, *words)
    assert (result.status, result.err) == (2, f"command line: {expected}\n")


def test_an_override_sets_the_number_that_it_names(conf: UserConf) -> None:
    """Also in a modes file of one's own in which a rule has two names."""
    rules = (
        "first: {rule: total_fixed, kbps: 900}, total_fixed: {kbps: 800}, demand_from_roi: {}, share_by_demand: {}, "
    )
    single, _, rest = (CONF / "modes/paper.yaml").read_text().partition("automatic:")
    own = (
        f"{single}automatic: {{{rules}scaling_from_rate_quality: {{}}}}\ncollective:{rest.partition('collective:')[2]}"
    )
    conf.write("modes/twice.yaml", own)
    modes = configuration(["modes=twice"], conf.path, runnable=False).document["modes"]
    vary = "automatic.first.kbps=700 automatic.total_fixed.kbps=700"
    both = [trial.override for trial in trials(vary, modes, ["automatic"])[0]]
    assert both == ["modes.automatic.first.kbps=700", "modes.automatic.total_fixed.kbps=700"]
    changed = configuration(["modes=twice", both[1]], conf.path, runnable=False).document["modes"]["automatic"]
    assert [changed[name]["kbps"] for name in ("first", "total_fixed")] == [900, 700]


@pytest.mark.soak
def test_ctrl_c_leaves_neither_processes_nor_files(tmp_path: Path) -> None:
    output = tmp_path / "tuned.json"
    words = (sys.executable, "-m", "runner", "tune", *SHORT, "seeds=90", "workers=2", f"output={output}")
    with subprocess.Popen(words, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as child:
        assert child.stderr and child.stdout
        until(lambda: len(children_named(child.pid, "python")) > 2)  # workers, and one that tracks their resources
        started = children_named(child.pid, "python")
        child.send_signal(signal.SIGINT)
        assert child.wait(timeout=20) == 130
        assert child.stdout.read() == ""
    until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in started))
    assert list(tmp_path.iterdir()) == []
