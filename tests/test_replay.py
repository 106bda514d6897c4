"""Events in, decisions out: the JSON lines, the end of a run, replaced predictions, drive logs."""

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

from runner.core.events import BitratePredicted, to_json
from runner.core.model import Vehicle
from runner.pqos import Pqos, Predictions, build_pqos
from runner.verbs.replay import events, replay

pytestmark = pytest.mark.usefixtures("composed_once")

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
    return [json.loads(line) for line in replay(replayed, inputs, Predictions({"": pqos}) if pqos else None)]


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
    decisions = answers(story)
    assert [(line["t"], line["event"]) for line in decisions] == [(event["t"], event["event"]) for event in story]
    assert [line["accepted"] for line in decisions] == [True, False, True, True]
    refused = decisions[1]
    assert list(refused)[:4] == ["t", "event", "accepted", "reason"]
    assert refused["reason"] == "total_set is accepted in mode collective only, the mode is automatic"
    assert refused["commands"] == []
    assert refused["cameras"] == decisions[0]["cameras"]
    assert decisions[3]["cameras"]["front_left"] == {
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


@pytest.mark.parametrize("text", ["", '{"t": 1.0, "log": "dropped", "lines": 3}\n'])
def test_an_input_without_events_is_named(tod: Command, tmp_path: Path, text: str) -> None:
    empty = tmp_path / "drive.jsonl"
    empty.write_text(text)
    status, out, err = tod("replay", *PAPER, f"input={tmp_path}")
    assert (status, out) == (0, "")
    assert err.startswith(f"{empty}: has no events, so there is nothing to replay\n")


def test_standard_input_and_output() -> None:
    story = lines([predicted(0, 3000), {"t": 1, "event": "camera_switched", "camera": "ü", "on": True}])
    result = process("replay", *PAPER, stdin=story)
    assert (result.status, result.err) == (0, "")
    assert json.loads(result.out.splitlines()[1])["reason"].startswith(
        "unknown camera 'ü'; expected one of front_left,"
    )
    nothing = "standard input: has no events, so there is nothing to replay\n"
    assert process("replay", *PAPER, stdin="") == (0, "", nothing)


# --- where a run ends -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "bad, expected",
    [
        ("no", "not JSON: Expecting value (column 1)"),
        ("", "not JSON: Expecting value (column 1)"),
        ("[]", "[]: must be a mapping with t and event"),
        ('{"t": 0, "event": "clock_advanced"}', "t: 0: must not decrease; the event before was at 0.5"),
        ('{"t": 1, "event": "clock"}', None),
        ('{"t": 1, "event": "bitrate_predicted", "kbps": NaN}', "not JSON: NaN is not a number"),
        ('{"t": 1, "event": "bitrate_predicted", "kbps": -1}', "kbps: -1: must be at least 0"),
        ('{"t": 1, "event": "bitrate_predicted", "kbp": 1}', "kbp: unknown key, did you mean kbps?"),
        ('{"t": 1, "event": "clock_advanced", "log": "x"}', "log: unknown key; expected one of t, event"),
    ],
)
def test_a_line_that_is_not_an_event_ends_the_run(
    tod: Command, events_file: Path, bad: str, expected: str | None
) -> None:
    with events_file.open("a") as file:
        file.write(f'{{"log": "note", "t": 0, "text": ""}}\n{bad}\n{lines([predicted(9, 1)])}')
    events_file.write_text(events_file.read_text().replace('"t": 1,', '"t": 0.5,', 1))
    output = events_file.with_name("out.jsonl")
    for words in ([], [f"output={output}"]):
        result = tod("replay", *PAPER, f"input={events_file}", *words)
        assert result.status == 2
        assert result.err.startswith(f"{events_file}: line 4: {expected or ''}")
        assert result.err.count("\n") == 1
        kept = output.read_text() if words else result.out
        assert [json.loads(line)["total_kbps"] for line in kept.splitlines()] == [3000, 8000]


def test_bad_lines_on_standard_input() -> None:
    result = process("replay", *PAPER, stdin=lines([predicted(0, 3000)]).encode() + b"\xff\xfe\n")
    assert result.status == 2
    assert len(result.out.splitlines()) == 1
    assert result.err == "standard input: line 2: not JSON: Expecting value (column 1)\n"


@pytest.mark.parametrize(
    "word, expected",
    [
        ("input=/nowhere.jsonl", "command line: input: '/nowhere.jsonl': no such file or directory"),
        ("input=/", "command line: input: '/drive.jsonl': no such file or directory"),
        ("output=/nowhere/out.jsonl", "command line: output: '/nowhere/out.jsonl': no such file or directory"),
        ("output=/", "command line: output: '/': is a directory"),
    ],
)
def test_files_that_cannot_be_opened(tod: Command, events_file: Path, word: str, expected: str) -> None:
    words = [word] if word.startswith("input") else [f"input={events_file}", word]
    assert tod("replay", *PAPER, *words) == (2, "", f"{expected}\n")


def test_an_output_file_appears_only_at_the_end(events_file: Path) -> None:
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


def test_each_answer_is_written_before_the_next_event_is_read() -> None:
    command = [sys.executable, "-m", "runner", "replay", *PAPER]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as running:
        assert running.stdin and running.stdout
        for kbps in (3000, 8000, 1000):
            running.stdin.write(lines([predicted(0, kbps)]))
            running.stdin.flush()
            assert json.loads(running.stdout.readline())["total_kbps"] == kbps
        running.stdin.close()
    assert running.returncode == 0


# --- replaced predictions ---------------------------------------------------------------------------------------------


class Doubled:
    """Predicts ten kbit/s per second at every event, including predictions."""

    warnings: tuple[str, ...] = ()

    def observe(self, event: Any) -> BitratePredicted | None:
        return None if event.t == 2 else BitratePredicted(t=event.t, kbps=Fraction(10) * Fraction(event.t))


def test_a_source_predicts_in_place_of_the_events() -> None:
    story = [CLOCK | {"t": 1}, CLOCK | {"t": 2}, predicted(3, 9999), CLOCK | {"t": 4}]
    decisions = answers(story, pqos=Doubled())
    assert [(line["t"], line["event"], line.get("source"), line["total_kbps"]) for line in decisions] == [
        (1, "clock_advanced", None, 3000),
        (1, "bitrate_predicted", "pqos", 10),
        (2, "clock_advanced", None, 10),
        (3, "bitrate_predicted", "pqos", 30),  # the input's own is dropped
        (4, "clock_advanced", None, 30),
        (4, "bitrate_predicted", "pqos", 40),
    ]
    assert list(decisions[1])[:4] == ["t", "event", "source", "accepted"]


def test_without_a_source_on_the_command_line_the_events_own_predictions_count(tod: Command, events_file: Path) -> None:
    own = tod("replay", *PAPER, f"input={events_file}").out
    assert "source" not in json.loads(own.splitlines()[0])
    for word in ("pqos=constant", "pqos.off_map_kbps=700"):
        result = tod("replay", *PAPER, f"input={events_file}", word)
        decisions = [json.loads(line) for line in result.out.splitlines()]
        assert {line.get("source") for line in decisions} <= {"pqos"}
        assert ("predicted nothing" in result.err) is (word != "pqos=constant")
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
    decisions = [json.loads(line) for line in result.out.splitlines()]
    assert [line["total_kbps"] for line in decisions if line.get("source")] == [4000, 2000, 1000]
    assert [line["event"] for line in decisions] == ["position_reported", "bitrate_predicted"] * 3


def test_a_recorded_trace_causes_fewer_changes_of_size_when_steady() -> None:
    settings = {"kind": "trace", "file": str(shared("traces/tidy/Verizon-LTE-short_uplink_1s.csv"))}
    settings |= {"loop": False, "off_trace_kbps": 1000, "period_s": 0.5, "position": {"kind": "live"}}  # type: ignore[dict-item]

    def changes(modes: str) -> int:
        clock = ({"t": t / 2, "event": "clock_advanced"} for t in range(240))
        decisions = answers(clock, vehicle(f"modes={modes}"), build_pqos(settings, [Path.cwd()]))
        return sum(command["knob"] == "size" for line in decisions[1:] for command in line["commands"])

    assert changes("steady") < changes("safe") == changes("paper")


# --- drive logs -------------------------------------------------------------------------------------------------------


@pytest.fixture
def drive(tmp_path: Path, tod: Command, story: Path) -> Path:
    """A drive with a prediction, a switched camera, a weight and a refused request, as `replay` writes it."""
    directory = tmp_path / "drive"
    result = tod("replay", *PAPER, "cameras.front_left.weight=3", f"input={story}", f"log={directory}")
    assert result.status == 0, result.err
    return directory


@pytest.fixture
def story(tmp_path: Path) -> Path:
    path = tmp_path / "story.jsonl"
    switched = {"t": 0.3, "event": "camera_switched", "camera": "rear_center", "on": False}
    weights = {"t": 0.4, "event": "weights_set", "weights": {"front_right": 2}}
    refused = {"t": 0.5, "event": "total_set", "kbps": 4000}
    where = {"t": 0.6, "event": "position_reported", "lat": 51.999233, "lon": 11.0, "speed_mps": 8.0, "heading_deg": 90}
    story = [predicted(0, 3000.5), CLOCK | {"t": 0.1}, predicted(0.2, 8000), switched, weights, refused, where]
    path.write_text(lines(story))
    return path


def test_a_drive_replays_to_its_own_decisions(tod: Command, drive: Path, story: Path) -> None:
    """With the configuration of the drive, which need not be named again, from any kind of input."""
    again = tod("replay", f"input={drive}")
    assert again.out == tod("replay", *PAPER, "cameras.front_left.weight=3", f"input={story}").out
    assert again.out == tod("replay", f"input={drive / 'drive.jsonl'}").out
    assert again.out == process("replay", stdin=(drive / "drive.jsonl").read_bytes()).out
    held = [json.loads(line) for line in (drive / "drive.jsonl").read_text().splitlines()]
    assert held[0]["log"] == "began" and held[-1]["log"] == "ended"
    decisions = [line for line in held if line.get("log") == "decision"]
    answered = [line for line in map(json.loads, again.out.splitlines()) if line["commands"]]
    keys = ("t", "mode", "total_kbps", "cameras", "commands")
    assert [[line[key] for key in keys] for line in decisions] == [[line[key] for key in keys] for line in answered]
    assert decisions[-1]["cause"] == "weights_set weights {'front_right': 2}"


def test_dropped_lines_are_reported(tod: Command, drive: Path, tmp_path: Path) -> None:
    """Events may be among them."""
    first, second, *rest = (drive / "drive.jsonl").read_text().splitlines()
    incomplete = tmp_path / "drive.jsonl"
    incomplete.write_text("\n".join([first, second, '{"log": "dropped", "t": 0.5, "lines": 3}', *rest, ""]))
    result = tod("replay", f"input={incomplete}")
    assert (result.status, result.out) == (0, tod("replay", f"input={drive}").out)
    assert result.err == f"{incomplete}: dropped lines: 3; decisions may differ from the drive's\n"


@pytest.mark.parametrize("by_s", ["", ', "by_s": "60"', ', "by_s": null'])
def test_a_wrong_setting_of_the_clock_does_not_move_the_start(
    tod: Command, drive: Path, tmp_path: Path, by_s: str
) -> None:
    first, *rest = (drive / "drive.jsonl").read_text().splitlines()
    settings = (f'{{"t": 0.5, "log": "clock_set"{each}}}' for each in (', "by_s": 3600', by_s))
    (tmp_path / "drive.jsonl").write_text("\n".join([first, *settings, *rest, ""]))
    result = tod("replay", f"input={tmp_path}", f"log={tmp_path / 'again'}")
    assert (result.status, result.err) == (0, "")
    again = (tmp_path / "again" / "drive.jsonl").read_text().splitlines()
    assert json.loads(again[0])["time"] == json.loads(first)["time"] + 3600


@pytest.mark.parametrize(
    "line, expected",
    [
        ('"clock_set"', "'clock_set': must be a mapping with t and event"),
        ('{"t": 0.5, "log": ["clock_set"]}', 'log: ["clock_set"]: unknown kind of line, did you mean clock_set?'),
    ],
)
def test_a_line_that_only_looks_like_a_setting_of_the_clock_ends_the_run(
    tod: Command, drive: Path, line: str, expected: str
) -> None:
    file = drive / "drive.jsonl"
    file.write_text(file.read_text().replace("\n", f"\n{line}\n", 1))
    result = tod("replay", f"input={drive}")
    assert (result.status, result.err) == (2, f"{file}: line 2: {expected}\n")


def test_a_drive_replayed_into_a_drive_is_identical(tod: Command, drive: Path, tmp_path: Path) -> None:
    assert tod("replay", f"input={drive}", f"log={tmp_path / 'again'}").status == 0
    assert (tmp_path / "again" / "drive.jsonl").read_text() == (drive / "drive.jsonl").read_text()


@pytest.mark.parametrize(
    "override, changed",
    [
        ("modes=steady", {"modes"}),
        ("cameras.front_left.weight=1", {"cameras"}),
        ("vehicle=delivery_robot", {"name", "cameras"}),
        ("cameras@cameras.rear_center=mast_1200p", {"cameras"}),
        ("pqos=constant", {"pqos"}),
        ("mode=collective", {"mode"}),
        ("~cameras.rear_center", {"cameras"}),
    ],
)
def test_overrides_change_the_configuration_of_a_drive(
    tod: Command, drive: Path, tmp_path: Path, override: str, changed: set[str]
) -> None:
    result = tod("replay", override, f"input={drive}", f"log={tmp_path / 'if'}")
    assert result.status == 0, result.err
    before, after = (json.loads((d / "drive.jsonl").open().readline())["config"] for d in (drive, tmp_path / "if"))
    assert {key for key in before if before[key] != after.get(key)} == changed


@pytest.mark.parametrize(
    "override, expected",
    [
        ("modes=stedy", "command line: modes: stedy: no such file in conf/modes/, did you mean steady?"),
        ("cameras.front_left.wieght=1", "command line: cameras.front_left.wieght: unknown key, did you mean weight?"),
        ("fps_max=fast", "command line: fps_max: 'fast': must be a number or null"),
    ],
)
def test_wrong_overrides_of_a_drive_are_reported(tod: Command, drive: Path, override: str, expected: str) -> None:
    result = tod("replay", override, f"input={drive}")
    assert (result.status, result.out) == (2, "")
    assert result.err.splitlines()[0] == expected


def test_a_configuration_that_is_no_longer_valid_is_reported_for_the_drive(tod: Command, drive: Path) -> None:
    path = drive / "drive.jsonl"
    path.write_text(path.read_text().replace('"fps_max": null', '"fps_mox": null', 1))
    result = tod("replay", f"input={drive}")
    assert result.status == 2
    assert result.err.splitlines()[0] == f"{path}: line 1: config: fps_mox: unknown key, did you mean fps_max?"


def test_a_truncated_drive_is_replayed_to_its_last_complete_line(tod: Command, drive: Path) -> None:
    path, whole = drive / "drive.jsonl", tod("replay", f"input={drive}").out
    text = path.read_text().splitlines(keepends=True)
    at = next(number for number, line in enumerate(text) if "weights_set" in line and "event" in line)
    path.write_text("".join(text[:at]) + text[at][:20])
    result = tod("replay", f"input={drive}")
    assert result.status == 0
    assert whole.startswith(result.out) and result.out.count("\n") == 4
    assert result.err == f"{path}: line {at + 1} is truncated and was skipped\n"


def test_files_that_are_not_a_drive_are_reported(tod: Command, drive: Path, tmp_path: Path) -> None:
    path = drive / "drive.jsonl"
    first, *_ = path.read_text().splitlines(keepends=True)

    def error(text: str) -> str:
        path.write_text(text)
        result = tod("replay", f"input={drive}")
        assert (result.status, result.out) == (2, "")
        return result.err.removeprefix(str(path))

    assert error(first.replace('"format": 2', '"format": 1')) == ": line 1: format: 1: this version reads format 2\n"
    operator = first.replace('"side": "vehicle"', '"side": "operator"')
    assert error(operator) == ": line 1: side: 'operator': has no events, they are in drive.jsonl\n"
    assert error(first.replace('"versions"', '"version"')).startswith(": line 1: version: unknown key, did you mean")
    assert error(first + '{"t": 1, "log": "decisoin"}\n').endswith("unknown kind of line, did you mean decision?\n")
    result = tod("replay", f"input={tmp_path}")
    assert result.err == f"command line: input: '{tmp_path}/drive.jsonl': no such file or directory\n"


def test_the_input_is_not_overwritten(tod: Command, drive: Path) -> None:
    path = drive / "drive.jsonl"
    before = path.read_bytes()
    for word in (drive, path):
        result = tod("replay", f"input={word}", f"output={path}")
        assert (result.status, path.read_bytes()) == (2, before)
        assert result.err == f"command line: output: '{path}': is the input, choose another file\n"


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["link=agian"], "link: 'agian': must be one of"),
        (["log={}"], "already contains a drive"),
        (["log={}/drive.jsonl"], "is not a directory that you may write to"),
        (["positions={}/no.bag", "topic=/fix"], "no such file"),
        (["-m", "log={}/sweep", "cameras.front_left.weight=1,2"], "already contains a drive"),
    ],
)
def test_a_wrong_command_line_leaves_the_output_of_an_earlier_run(
    tod: Command, drive: Path, tmp_path: Path, words: list[str], problem: str
) -> None:
    output = tmp_path / "decisions.jsonl"
    output.write_text("kept\n")
    (drive / "sweep/1").mkdir(parents=True)
    (drive / "sweep/1/drive.jsonl").write_text("a drive\n")
    result = tod("replay", *(word.format(drive) for word in words), f"input={drive}", f"output={output}")
    assert (result.status, output.read_text()) == (2, "kept\n")
    assert problem in result.err
    assert not (drive / "sweep/0").exists()


def test_a_replay_that_fails_leaves_no_drive(tod: Command, events_file: Path, tmp_path: Path) -> None:
    with events_file.open("a") as file:
        file.write("no\n")
    result = tod("replay", *PAPER, f"input={events_file}", f"log={tmp_path / 'answer'}")
    assert result.status == 2
    assert not (tmp_path / "answer").exists()


def test_an_answer_written_as_a_drive_does_not_flood_standard_output(
    tod: Command, events_file: Path, tmp_path: Path
) -> None:
    result = tod("replay", *PAPER, f"input={events_file}", f"log={tmp_path / 'answer'}")
    assert result == (0, "", "")
    decisions = tmp_path / "decisions.jsonl"
    words = (f"input={events_file}", f"log={tmp_path / 'again'}", f"output={decisions}")
    assert tod("replay", *PAPER, *words) == (0, "", "")
    assert len(decisions.read_text().splitlines()) == len(events_file.read_text().splitlines())


@pytest.mark.parametrize("depth", [40, 985, 100_000])
def test_json_that_is_nested_too_deeply(tod: Command, tmp_path: Path, depth: int) -> None:
    path = tmp_path / "deep.jsonl"
    path.write_text('{"t": 0, "event": ' + "[" * depth + "]" * depth + "}\n")
    result = tod("replay", *PAPER, f"input={path}")
    assert (result.status, result.out) == (2, "")
    assert result.err == f"{path}: line 1: not JSON: nested too deeply\n"


def test_a_file_without_line_ends_is_not_loaded(tod: Command) -> None:
    result = tod("replay", *PAPER, "input=/dev/zero")
    assert result == (2, "", "/dev/zero: line 1: must be at most 16777216 characters long\n")


def test_another_kind_of_camera_stays_in_its_place(tod: Command, drive: Path, tmp_path: Path) -> None:
    words = ("cameras@cameras.rear_center=wide_720p", "cameras.rear_center.weight=2")
    assert tod("replay", *words, f"input={drive}", f"log={tmp_path / 'if'}").status == 0
    before, after = (json.loads((d / "drive.jsonl").open().readline())["config"] for d in (drive, tmp_path / "if"))
    was, now = before["cameras"]["rear_center"], after["cameras"]["rear_center"]
    assert {key: now[key] for key in ("place", "pose", "device")} == {
        key: was[key] for key in ("place", "pose", "device")
    }
    assert (now["height_px"], now["weight"]) == (720, 2)


def test_a_drive_is_never_overwritten(tod: Command, drive: Path, story: Path) -> None:
    before = (drive / "drive.jsonl").read_bytes()
    result = tod("replay", f"input={story}", f"log={drive}")
    assert result.status == 2
    rule = "already contains a drive (drive.jsonl), choose another directory"
    assert result.err == f"command line: log: '{drive}': {rule}\n"
    assert (drive / "drive.jsonl").read_bytes() == before


def test_what_the_log_writes_is_what_replay_reads() -> None:
    event = BitratePredicted(t=0.25, kbps=Fraction("2999.5"), lower_kbps=Fraction(100), valid_s=2.0)
    ((_, read),) = events([json.dumps(to_json(event))], "log")
    assert read == event
