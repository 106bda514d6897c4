"""Hostile files and words: refused with one message, quickly, without much memory."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from helpers import CONF, Command, UserConf

from runner.configuration import yaml_file
from runner.configuration.interpolation import expands_within

LONGEST_S = 2.0


def _aliases(path: Path) -> None:
    rows = [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]" for n in range(1, 9)]
    path.write_text("a0: &a0 [x]\n" + "\n".join(rows) + "\n")


def _merges(path: Path) -> None:
    rows = [f"a{n}: &a{n} {{<<: [{', '.join([f'*a{n - 1}'] * 9)}]}}" for n in range(1, 9)]
    path.write_text("a0: &a0 {x: 1}\n" + "\n".join(rows) + "\n")


def _interpolations(path: Path) -> None:
    rows = [f"x{n}: '${{modes.x{n - 1}}}${{modes.x{n - 1}}}'" for n in range(1, 40)]
    path.write_text("x0: lol\n" + "\n".join(rows) + "\n")


@pytest.mark.parametrize(
    "make, expected",
    [
        (_aliases, "line 5: must contain at most 10000 values, with aliases expanded"),
        (_merges, "line 5: must contain at most 10000 values, with aliases expanded"),
        (_interpolations, "interpolations, ${...}, are nested too deeply or expand to more than 50000 values"),
        (
            lambda path: path.write_text("a: " + "[" * 3000 + "]" * 3000),
            "line 1: must be nested at most 32 levels deep",
        ),
        (lambda path: path.write_text("- " * 3000), "line 1: must be nested at most 32 levels deep"),
        (lambda path: path.write_text("a: [" + "1," * 10_001 + "]"), "line 1: must contain at most 10000 values, "),
        (lambda path: path.write_text("a: " + "x" * 100_000), "must be at most 100 kB long"),
        (lambda path: path.write_text("a: 0x" + "F" * 30_000), "line 1: must have at most 300 digits"),
        (lambda path: path.write_text("a: " + "1" * 6000), "Exceeds the limit (4300 digits)"),
        (lambda path: path.write_text("a: !!int x"), "invalid literal for int()"),
        (lambda path: path.write_bytes(b"a: \0"), "unacceptable character"),
        (lambda path: path.write_text('defaults: ["a\\0b"]'), "defaults[0]: 'a\\x00b': must be a file's name or GROUP"),
        (lambda path: path.write_text("defaults: [{a b=c: x}]"), 'defaults[0]: {"a b=c": "x"}: must be a file\'s name'),
        (lambda path: path.symlink_to("/dev/zero"), "must be a file"),
        (os.mkfifo, "must be a file"),
        (Path.mkdir, "must be a file"),
    ],
)
def test_a_harmful_file_is_rejected(conf: UserConf, tod: Command, make: Callable[[Path], None], expected: str) -> None:
    path = conf.write("modes/paper.yaml", "").path / "modes" / "mine.yaml"
    path.with_name("paper.yaml").unlink()
    make(path)
    for verb in ("print", "validate"):
        began = time.process_time()
        problems = tod(verb, "source=test", "modes=mine", conf.word).problems
        assert time.process_time() - began < LONGEST_S
        if verb == "print" or make is not _interpolations:  # whose keys the schema does not know
            assert problems[0].startswith(f"{path}: {expected}")


def test_files_that_include_each_other_in_a_cycle(conf: UserConf, tod: Command) -> None:
    conf.write("modes/a.yaml", "defaults: [b, _self_]\n").write("modes/b.yaml", "defaults: [a, _self_]\n")
    (problem,) = tod("print", "source=test", "modes=a", conf.word).problems
    assert problem == "command line: source=test modes=a: files include each other in a cycle"


def test_a_misspelt_kind_next_to_a_broken_file(conf: UserConf, tod: Command) -> None:
    conf.write("modes/broken.yaml", "a: [\n")
    conf.change("vehicle/delivery_robot.yaml", {"wide_720p": "wide_72p"})
    (problem,) = tod("print", "source=test", "vehicle=delivery_robot", conf.word).problems
    assert problem.endswith("delivery_robot.yaml: defaults: 'cameras/wide_72p': no such file, did you mean wide_720p?")


def test_a_file_is_read_again_when_it_has_changed(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_text("a: 1\n")
    assert yaml_file.load_file(path) == {"a": 1}
    path.write_text("a: 234\n")
    assert yaml_file.load_file(path) == {"a": 234}


@pytest.mark.parametrize("first", ["", "# yaml-language-server: $schema=x\n\n# my van\n"])
def test_the_package_may_stand_in_any_comment_at_the_top(conf: UserConf, tod: Command, first: str) -> None:
    text = (CONF / "vehicle/delivery_robot.yaml").read_text()
    conf.write("vehicle/van.yaml", first + text)
    assert tod("print", "source=test", "vehicle=van", conf.word).status == 0


@pytest.mark.parametrize(
    "word, expected",
    [
        ("a=" + "[" * 40, "is too long or nested too deeply, write it into a file"),
        ("a=" + "x" * 5000, "is too long or nested too deeply, write it into a file"),
        ("fps_max=" + "9" * 400, "must have at most 300 digits"),
    ],
)
def test_overrides_are_limited(tod: Command, word: str, expected: str) -> None:
    (problem,) = tod("print", "source=test", word).problems
    assert problem.startswith("command line: ") and problem.endswith(expected) and len(problem) < 200


@pytest.mark.parametrize(
    "document, most, fits",
    [
        ({"a": 1, "b": "${a}"}, 4, True),
        ({"a": 1, "b": "${a}"}, 3, False),
        ({"a": [1, 2], "b": ["${a}", "${.[0]}", "${..a}"]}, 18, True),
        ({"a": "${a}"}, 3, True),  # a circle, which OmegaConf reports
        ({"a": "${nope.x}"}, 3, True),
        ({"a": "x" * 1000}, 5, False),
    ],
)
def test_the_size_of_interpolations_is_limited(document: object, most: int, fits: bool) -> None:
    assert expands_within(document, most) is fits


# --- blame ------------------------------------------------------------------------------------------------------------

RULES = "  demand_from_roi: {}\n  share_by_demand: {}\n  scaling_from_rate_quality: {}\n"


def test_a_parameter_missing_in_a_list_of_ones_own(conf: UserConf, tod: Command) -> None:
    others = "".join(
        f"{mode}: {{demand_from_roi: {{}}, keep_operator_settings: {{}}}}\n" for mode in ("single", "collective")
    )
    own = "automatic:\n  total_from_prediction: {start_kbps: 1}\n  pause_without_operator: {}\n  cap_by_link: {}\n"
    conf.write("modes/mine.yaml", f"{others}{own}{RULES}")
    problems = tod("print", "source=test", "modes=mine", conf.word).problems
    assert {problem.partition(": ")[0] for problem in problems} == {str(conf.path / "modes/mine.yaml")}
    assert "automatic.pause_without_operator.after_s: missing: required by this rule" in problems[0]
    assert "automatic.cap_by_link: unknown rule" in problems[1]


@pytest.mark.parametrize(
    "word, expected",
    [
        (
            "modes.automatic.hold_upscaling={}",
            "modes.automatic.hold_upscaling.for_s: missing: required by this rule",
        ),
        ("~modes", "modes: missing: must be given"),
        ("~cameras.front_left.fps", "cameras.front_left.fps: missing: must be given"),
    ],
)
def test_a_mistake_on_the_command_line_is_attributed_to_it(tod: Command, word: str, expected: str) -> None:
    assert tod("print", "source=test", word).problems == [f"command line: {expected}"]


@pytest.mark.parametrize(
    "words, expected",
    [
        (
            ["cameras.front_left.rate_quality.scaling=[0.5]"],
            "conf/cameras/front_side.yaml: rate_quality.b_min_kbps: [0, 300, 950]: must have 1 entries, one per "
            "scaling factor; see command line: cameras.front_left.rate_quality.scaling=[0.5]",
        ),
        (
            ["media.port=8090"],
            "conf/config.yaml: page.port: 8090: is already the port of media.port; see command line: media.port=8090",
        ),
        (
            ["control.port=8554"],
            "command line: control.port: 8554: is already the port of media.port; "
            "see conf/config.yaml: media.port: 8554",
        ),
    ],
)
def test_a_rule_about_two_values_names_both_and_their_files(tod: Command, words: list[str], expected: str) -> None:
    assert tod("print", "source=test", *words).problems == [expected]


def test_a_file_that_breaks_its_base_is_named(conf: UserConf, tod: Command) -> None:
    conf.write("graph/mine.yaml", "defaults: [h264_rtsp, _self_]\nvehicle: [{name: pay0, element: rtph264pay}]\n")
    conf.write(
        "vehicle/mine.yaml",
        "# @package _global_\ndefaults:\n  - /cameras@cameras.a: top_view\n  - _self_\nname: mine\n"
        "cameras: {a: {rate_quality: {scaling: [0.5]}}}\n",
    )
    (problem,) = tod("print", "source=test", "graph=mine", conf.word).problems
    assert problem.startswith("conf/graph/h264_rtsp.yaml: knobs.sending[0].element: 'gate': no such element")
    assert problem.endswith(f"; see {conf.path}/graph/mine.yaml: vehicle[0].name: 'pay0'")
    (problem,) = tod("print", "source=test", "vehicle=mine", conf.word).problems
    assert problem.startswith("conf/cameras/top_view.yaml: rate_quality.b_min_kbps: [0, 150, 400]: must have 1 entries")
    assert problem.endswith(f"; see {conf.path}/vehicle/mine.yaml: cameras.a.rate_quality.scaling: [0.5]")


@pytest.mark.slow
def test_a_file_with_a_mistake_of_its_own_stays_blamed(conf: UserConf, tod: Command) -> None:
    conf.change("cameras/top_view.yaml", {"3000": "400"})
    found = tod("print", "source=test", "cameras.top_left.weight=3", "fps_max=-1", conf.word).problems
    assert (
        f"{conf.path}/cameras/top_view.yaml: rate_quality.b_full_kbps: 400: must be above the last b_min, 400" in found
    )
    assert len(found) == 2


def test_a_plus_before_a_group_changes_nothing(tod: Command) -> None:
    plain, plus = (tod("print", "source=test", f"{sign}experiment=driving_test") for sign in ("", "+"))
    assert plain.status == 0 and plain == plus


# --- secrets ----------------------------------------------------------------------------------------------------------

ADDRESS = "rtsp://bob:s3cr%23t@10.0.0.1/x?user=bob&password=s3cret2"


@pytest.mark.parametrize("form", ["text", "json"])
def test_the_password_of_a_camera_is_not_printed(tod: Command, form: str) -> None:
    """In an element's properties: as `address` it is refused."""
    own = ("source.address=rtsp://10.0.0.1/x", f'source.elements.0.properties.location="{ADDRESS}"')
    result = tod("print", f"format={form}", "source=rtsp", *own)
    assert result.status == 0
    assert "s3cr" not in result.out and "rtsp://10.0.0.1/x" in result.out
    assert "passwords of addresses are left out" in result.err


def test_nor_shown_in_a_message(tod: Command) -> None:
    result = tod("print", "source=test", f'media.port="{ADDRESS}"', f'+source.clip.x="{ADDRESS}"')
    assert result.status == 2
    assert "s3cr" not in result.err and "10.0.0.1" in result.err


def test_nor_kept_in_a_log(tod: Command, tmp_path: Path) -> None:
    events = tmp_path / "events.jsonl"
    events.write_text('{"t": 0, "event": "clock_advanced"}\n')
    words = ("source=rtsp", f'source.address="{ADDRESS}"', f"input={events}", f"log={tmp_path / 'log'}")
    assert tod("replay", *words).status == 0
    text = (tmp_path / "log/drive.jsonl").read_text()
    assert "s3cr" not in text and "rtsp://10.0.0.1/x" in text


@pytest.mark.parametrize("words", [["pqos.file=FILE"], ["pqos=trace", "pqos.file=FILE"]])
def test_the_content_of_another_file_is_not_shown(tod: Command, tmp_path: Path, words: list[str]) -> None:
    path = tmp_path / "shadow"
    path.write_text("boss:$6$secret:1:0\nbin:*:1\n")
    result = tod("validate", *(word.replace("FILE", str(path)) for word in words))
    assert result.status == 2 and f"{path}:1: no column " in result.err
    assert "boss" not in result.err


def test_a_pipe_is_rejected_as_a_map(tod: Command, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (problem,) = tod("validate", f"pqos.file={tmp_path / 'pipe'}").problems
    assert problem == f"command line: pqos.file: {tmp_path / 'pipe'}: must be a file"


# --- text that ends in a line feed ------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["robot\\n", "\\n", "a\\nb"])
def test_a_name_with_a_line_feed_is_rejected(conf: UserConf, tod: Command, name: str) -> None:
    conf.change("vehicle/delivery_robot.yaml", {"name: delivery_robot": f'name: "{name}"'})
    (problem,) = tod("print", "source=test", "vehicle=delivery_robot", conf.word).problems
    assert problem.endswith(": must be letters, digits, _ and - only")
