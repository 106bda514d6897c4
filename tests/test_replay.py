"""Events in, decisions out: the JSON lines, where a run ends, predictions put in place of others, drive logs."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest
from helpers import Command, UserConf, process, vehicle
from shared_data import shared

from runner.events import BitratePredicted, to_json
from runner.loop import Log
from runner.model import Vehicle
from runner.pqos import Pqos, build_pqos
from runner.verbs.replay import events, replay

VEHICLE = vehicle("modes=paper")
PAPER = ("modes=paper", "source=test")
CLOCK = {"t": 0, "event": "clock_advanced"}


def predicted(t: float, kbps: float) -> dict[str, Any]:
    return {"t": t, "event": "bitrate_predicted", "kbps": kbps}


def lines(documents: Iterable[dict[str, Any]]) -> str:
    return "".join(json.dumps(document) + "\n" for document in documents)


def answers(
    documents: Iterable[dict[str, Any]], replayed: Vehicle = VEHICLE, pqos: Pqos | None = None
) -> list[dict[str, Any]]:
    inputs = events(lines(documents).splitlines(keepends=True), "test")
    return [json.loads(line) for line in replay(replayed, inputs, pqos)]


@pytest.fixture
def events_file(tmp_path: Path) -> Iterator[Path]:
    path = tmp_path / "events.jsonl"
    path.write_text(lines([predicted(0, 3000), predicted(1, 8000)]))
    yield path


# --- the lines --------------------------------------------------------------------------------------------------------


def test_the_line_that_answers_an_event() -> None:
    first, same = answers([predicted(0.5, 3000), predicted(0.6, 3000)])
    assert list(first) == ["t", "event", "accepted", "mode", "total_kbps", "cameras", "commands"]
    assert {key: first[key] for key in ("t", "event", "accepted", "mode", "total_kbps")} == {
        "t": 0.5,
        "event": "bitrate_predicted",
        "accepted": True,
        "mode": "automatic",
        "total_kbps": 3000,
    }
    assert first["cameras"]["front_left"] == {
        "on": True,
        "sending": True,
        "demand_kbps": 6000,
        "kbps": 545,
        "scaling": 0.25,
        "roi": {"x": 0, "y": 0, "width": 1920, "height": 1040},
        "width": 480,
        "height": 260,
        "reason": "545 of 6000 kbit/s, range [300, 950) -> 0.25",
    }
    assert [command for command in first["commands"] if command["camera"] == "front_left"] == [
        {"camera": "front_left", "knob": "sending", "value": True},
        {"camera": "front_left", "knob": "roi", "value": {"x": 0, "y": 0, "width": 1920, "height": 1040}},
        {"camera": "front_left", "knob": "size", "value": {"width": 480, "height": 260}},
        {"camera": "front_left", "knob": "bitrate", "value": 545},
    ]
    assert same == first | {"t": 0.6, "commands": []}


def test_one_line_per_event_in_order_also_for_what_changed_nothing_or_was_refused() -> None:
    story = [
        CLOCK,
        {"t": 1, "event": "total_set", "kbps": 3},
        {"t": 1, "event": "position_reported", "lat": 48, "lon": 11},
        {"t": 2, "event": "camera_switched", "camera": "front_left", "on": False},
    ]
    told = answers(story)
    assert [(line["t"], line["event"]) for line in told] == [(event["t"], event["event"]) for event in story]
    assert [line["accepted"] for line in told] == [True, False, True, True]
    refused = told[1]
    assert list(refused)[:4] == ["t", "event", "accepted", "reason"]
    assert refused["reason"] == "total_set is accepted in mode collective only, the mode is automatic"
    assert refused["commands"] == []
    assert refused["cameras"] == told[0]["cameras"]
    assert told[3]["cameras"]["front_left"] == {
        "on": False,
        "sending": False,
        "demand_kbps": 0,
        "kbps": 0,
        "scaling": None,
        "roi": {"x": 0, "y": 0, "width": 1920, "height": 1040},
        "width": 0,
        "height": 0,
        "reason": "switched off",
    }


def test_the_total_and_the_bitrates_of_every_line_agree() -> None:
    for line in answers(predicted(t, 160.7 * t) for t in range(101)):
        assert sum(camera["kbps"] for camera in line["cameras"].values()) <= line["total_kbps"]


def test_a_file_of_events(tod: Command, events_file: Path) -> None:
    result = tod("replay", *PAPER, f"input={events_file}")
    assert (result.status, result.err) == (0, "")
    assert [json.loads(line)["total_kbps"] for line in result.out.splitlines()] == [3000, 8000]


def test_standard_input_and_output() -> None:
    story = lines([predicted(0, 3000), {"t": 1, "event": "camera_switched", "camera": "ü", "on": True}])
    result = process("replay", *PAPER, stdin=story)
    assert (result.status, result.err) == (0, "")
    assert json.loads(result.out.splitlines()[1])["reason"].startswith("unknown camera 'ü', there is front_left,")
    assert process("replay", *PAPER, stdin="") == (0, "", "")


# --- where a run ends -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "bad, told",
    [
        ("no", "not JSON: Expecting value (column 1)"),
        ("", "not JSON: Expecting value (column 1)"),
        ("[]", "[]: must be a mapping with t and event"),
        ('{"t": 0, "event": "clock_advanced"}', "t: 0: must not fall, the event before was at 0.5"),
        ('{"t": 1, "event": "clock"}', None),
        ('{"t": 1, "event": "bitrate_predicted", "kbps": NaN}', "not JSON: NaN is no number"),
        ('{"t": 1, "event": "bitrate_predicted", "kbps": -1}', "kbps: -1: must be at least 0"),
        ('{"t": 1, "event": "bitrate_predicted", "kbp": 1}', "kbp: unknown key, did you mean kbps?"),
        ('{"t": 1, "event": "clock_advanced", "log": "x"}', "log: unknown key, there is t, event"),
    ],
)
def test_a_line_that_is_no_event_ends_the_run(tod: Command, events_file: Path, bad: str, told: str | None) -> None:
    with events_file.open("a") as file:
        file.write(f'{{"log": "telemetry", "t": 0}}\n{bad}\n{lines([predicted(9, 1)])}')
    events_file.write_text(events_file.read_text().replace('"t": 1,', '"t": 0.5,', 1))
    output = events_file.with_name("out.jsonl")
    for words in ([], [f"output={output}"]):
        result = tod("replay", *PAPER, f"input={events_file}", *words)
        assert result.status == 2
        assert result.err.startswith(f"{events_file}: line 4: {told or ''}")
        assert result.err.count("\n") == 1
        kept = output.read_text() if words else result.out
        assert [json.loads(line)["total_kbps"] for line in kept.splitlines()] == [3000, 8000]


def test_bad_lines_on_standard_input() -> None:
    result = process("replay", *PAPER, stdin=lines([predicted(0, 3000)]).encode() + b"\xff\xfe\n")
    assert result.status == 2
    assert len(result.out.splitlines()) == 1
    assert result.err == "standard input: line 2: not JSON: Expecting value (column 1)\n"


@pytest.mark.parametrize(
    "word, told",
    [
        ("input=/nowhere.jsonl", "command line: input: '/nowhere.jsonl': no such file or directory"),
        ("input=/", "command line: input: '/': is a directory"),
        ("output=/nowhere/out.jsonl", "command line: output: '/nowhere/out.jsonl': no such file or directory"),
        ("output=/", "command line: output: '/': is a directory"),
    ],
)
def test_files_that_cannot_be_opened(tod: Command, events_file: Path, word: str, told: str) -> None:
    words = [word] if word.startswith("input") else [f"input={events_file}", word]
    assert tod("replay", *PAPER, *words) == (2, "", f"{told}\n")


def test_an_output_file_is_there_only_at_the_end(events_file: Path) -> None:
    output = events_file.with_name("my answers ü.jsonl")
    output.write_text("from before\n")
    command = [sys.executable, "-m", "runner", "replay", *PAPER, f"output={output}"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, text=True) as running:
        assert running.stdin
        running.stdin.write(lines([predicted(0, 3000)]))
        running.stdin.flush()
        assert output.read_text() == "from before\n"
        running.stdin.close()
    assert running.returncode == 0
    assert json.loads(output.read_text())["total_kbps"] == 3000
    assert sorted(path.name for path in output.parent.iterdir()) == ["events.jsonl", output.name]


def test_a_device_stays_a_device(tod: Command, events_file: Path) -> None:
    assert tod("replay", *PAPER, f"input={events_file}", "output=/dev/null") == (0, "", "")
    assert not Path("/dev/null").is_file()


def test_each_answer_comes_before_the_next_event_is_asked_for() -> None:
    command = [sys.executable, "-m", "runner", "replay", *PAPER]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as running:
        assert running.stdin and running.stdout
        for kbps in (3000, 8000, 1000):
            running.stdin.write(lines([predicted(0, kbps)]))
            running.stdin.flush()
            assert json.loads(running.stdout.readline())["total_kbps"] == kbps
        running.stdin.close()
    assert running.returncode == 0


# --- predictions put in place of others -------------------------------------------------------------------------------


class Doubled:
    """Predicts ten kbit/s per second at every event, its own kind of event included."""

    warnings: tuple[str, ...] = ()

    def observe(self, event: Any) -> BitratePredicted | None:
        return None if event.t == 2 else BitratePredicted(t=event.t, kbps=Fraction(10) * Fraction(event.t))


def test_a_source_predicts_in_place_of_the_events() -> None:
    story = [CLOCK | {"t": 1}, CLOCK | {"t": 2}, predicted(3, 9999), CLOCK | {"t": 4}]
    told = answers(story, pqos=Doubled())
    assert [(line["t"], line["event"], line.get("source"), line["total_kbps"]) for line in told] == [
        (1, "clock_advanced", None, 3000),
        (1, "bitrate_predicted", "pqos", 10),
        (2, "clock_advanced", None, 10),
        (3, "bitrate_predicted", "pqos", 30),  # the one of the input is dropped
        (4, "clock_advanced", None, 30),
        (4, "bitrate_predicted", "pqos", 40),
    ]
    assert list(told[1])[:4] == ["t", "event", "source", "accepted"]


def test_without_a_source_on_the_command_line_the_events_own_predictions_count(tod: Command, events_file: Path) -> None:
    own = tod("replay", *PAPER, f"input={events_file}").out
    assert "source" not in json.loads(own.splitlines()[0])
    for word in ("pqos=constant", "pqos.off_map_kbps=700"):
        told = [json.loads(line) for line in tod("replay", *PAPER, f"input={events_file}", word).out.splitlines()]
        assert {line.get("source") for line in told} <= {"pqos"}
    assert (
        tod("replay", *PAPER, f"input={events_file}", "pqos=map", "pqos.file=no.csv")
        .problems[0]
        .startswith("command line: pqos.file: no.csv: no such file")
    )


def test_a_map_predicts_from_the_positions_of_the_input(tod: Command, tmp_path: Path, conf: UserConf) -> None:
    conf.write("maps/mine.csv", "lon,lat,kbps\n11.0,48.0,4000\n11.001,48.0,2000\n")
    drive = tmp_path / "drive.jsonl"
    positions = [(0, 48.0, 11.0), (1, 48.0, 11.001), (2, 48.5, 11.0)]
    drive.write_text(lines({"t": t, "event": "position_reported", "lat": a, "lon": o} for t, a, o in positions))
    result = tod("replay", *PAPER, conf.word, f"input={drive}", "pqos=map", "pqos.file=maps/mine.csv")
    told = [json.loads(line) for line in result.out.splitlines()]
    assert [line["total_kbps"] for line in told if line.get("source")] == [4000, 2000, 1000]
    assert [line["event"] for line in told] == ["position_reported", "bitrate_predicted"] * 3


def test_a_recorded_trace_causes_fewer_changes_of_size_when_steady() -> None:
    settings = {"kind": "trace", "file": str(shared("traces/tidy/Verizon-LTE-short_uplink_1s.csv"))}
    settings |= {"loop": False, "off_trace_kbps": 1000, "period_s": 0.5, "position": {"kind": "live"}}  # type: ignore[dict-item]

    def changes(modes: str) -> int:
        clock = ({"t": t / 2, "event": "clock_advanced"} for t in range(240))
        told = answers(clock, vehicle(f"modes={modes}"), build_pqos(settings, [Path.cwd()]))
        return sum(command["knob"] == "size" for line in told[1:] for command in line["commands"])

    assert changes("steady") < changes("safe") == changes("paper")


# --- drive logs -------------------------------------------------------------------------------------------------------


def test_a_drive_log_replays_to_what_it_says_was_decided(tmp_path: Path) -> None:
    log, story = Log(tmp_path / "drive"), [predicted(0, 3000), CLOCK | {"t": 0.1}, predicted(0.2, 8000)]
    decided = answers(story)
    for event, line in zip(story, decided, strict=True):
        log.write(event)
        log.write({"t": line["t"], "log": "decision", "mode": "automatic", "commands": line["commands"]})
        log.write({"t": line["t"], "log": "telemetry", "cameras": {}})
    written = (tmp_path / "drive" / "drive.jsonl").read_text()
    again = [json.loads(line) for line in replay(VEHICLE, events(written.splitlines(), "drive"))]
    assert again == decided


def test_what_the_log_writes_is_what_replay_reads() -> None:
    event = BitratePredicted(t=0.25, kbps=Fraction("2999.5"), lower_kbps=Fraction(100), valid_s=2.0)
    ((_, read),) = events([json.dumps(to_json(event))], "log")
    assert read == event
