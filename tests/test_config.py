"""Configuration: Table I, user files, and the exact message for each mistake."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
from helpers import CONF, Command, UserConf, process, vehicle

from runner.configuration.compose import RESTATED
from runner.configuration.config import configuration
from runner.configuration.overrides import MERGED
from runner.configuration.rule_lists import OWN_RULES
from runner.core.model import Mode
from runner.errors import ConfigError, Problem, UserError
from runner.schema import schema_document

TOP_KEYS = "mode, fps_max, media, control, page, uplinks, latency, log, name, cameras, modes, graph, source, ..."
CAMERA_KEYS = (
    "width_px, height_px, fps, native, rate_quality, lens, fov_deg, weight, floor_kbps, redundant, shed, place, pose,"
    " ..."
)
OWN = "files of your own need conf=DIR"
SWEEP = "a,b,c is a sweep, which print, replay and demo run with -m; write [a,b,c] for a list"
QUOTE = """; quote a value with special characters: 'key="value"'"""
KNOB_VALUES = (
    "kbps, bps, vbv_ms, left, right, top, bottom, on, off (quote these two), or a template over {width} and"
    " {height}, or over {kbps}, {bps}, {vbv_ms}, {key_interval_frames} and {controls}"
)
MINE = """# @package _global_
defaults:
  - /cameras@cameras.a: top_view
  - _self_
name: mine
"""

# --- Table I ----------------------------------------------------------------------------------------------------------

FRONT, TOP = ("0.125 0.25 0.5", (1920, 1040), 40), ("0.25 0.375 0.5", (1280, 800), 30)
TABLE_1 = {  # S, size in px, Hz, b_min,r and b_full in kbit/s
    "front_left": (*FRONT, "0 300 950", 6000),
    "front_center": (*FRONT, "0 200 450", 5000),
    "front_right": (*FRONT, "0 300 950", 6000),
    "rear_center": ("0.125 0.25 0.5", (1920, 1200), 40, "0 400 1800", 4000),
    "top_front": (*TOP, "0 150 400", 3000),
    "top_left": (*TOP, "0 150 400", 3000),
    "top_right": (*TOP, "0 150 400", 3000),
    "top_rear": (*TOP, "0 200 400", 3000),
}

NAMED = schema_document("modes")["$defs"]["rules"]["$comment"]  # names the form in place of a list
RISING = "must start at 0 and be strictly increasing"


def test_the_papers_vehicle_is_table_1_digit_by_digit() -> None:
    def numbers(values: tuple[object, ...]) -> str:
        return " ".join(f"{float(value):g}" for value in values)  # type: ignore[arg-type]

    cameras = vehicle("vehicle=tum_q7").cameras
    assert {
        name: (
            numbers(c.rate_quality.scaling),
            (c.width, c.height),
            c.fps,
            numbers(c.rate_quality.b_min),
            c.rate_quality.b_full,
        )
        for name, c in cameras.items()
    } == TABLE_1
    assert list(cameras) == list(TABLE_1)
    assert {c.weight for c in cameras.values()} == {1}


def test_the_second_vehicle_has_another_structure() -> None:
    cameras = vehicle("vehicle=delivery_robot").cameras
    assert len(cameras) == 3
    assert len({(c.width, c.height, c.rate_quality.scaling) for c in cameras.values()}) == 3


def test_modes_safe_is_the_default_and_automatic_the_mode() -> None:
    assert vehicle().mode is Mode.AUTOMATIC
    names = [call.rule.name for call in vehicle().modes[Mode.AUTOMATIC]]
    assert {"follow_link", "pause_without_operator"} <= set(names)
    paper = {call.rule.name for calls in vehicle("modes=paper").modes.values() for call in calls}
    assert not paper & {"follow_link", "pause_without_operator", "hold_upscaling"}


@pytest.mark.parametrize(
    ("fps", "rate"),
    [
        ("29.97", "2997/100"),
        ("29.97002997002997", "30000/1001"),
        ("33.333333333", "100/3"),
        ("0.2", "1/5"),
    ],
)
def test_rates_fit_into_caps(fps: str, rate: str) -> None:
    """GStreamer's fractions have 32 bits."""
    assert str(vehicle(f"fps_max={fps}").cameras["front_left"].fps) == rate


def test_numbers_are_exact_and_fps_max_limits_every_camera() -> None:
    cameras = vehicle("fps_max=33.3", "cameras.front_left.weight=0.1").cameras
    assert str(cameras["front_left"].weight) == "1/10"
    assert (str(cameras["front_left"].fps), cameras["top_left"].fps) == ("333/10", 30)


# --- a user's own directory -------------------------------------------------------------------------------------------


def test_a_users_file_shadows_only_the_packaged_file_of_its_name(conf: UserConf) -> None:
    conf.change("cameras/front_center.yaml", {"b_full_kbps: 5000": "b_full_kbps: 7000"})
    cameras = configuration(["source=test"], conf.path).vehicle().cameras
    assert cameras["front_center"].rate_quality.b_full == 7000
    assert cameras["front_left"].rate_quality.b_full == 6000
    assert vehicle().cameras["front_center"].rate_quality.b_full == 5000


def test_a_file_that_is_added_changed_or_removed_counts_at_once(conf: UserConf) -> None:
    def kbps() -> float:
        document = configuration(["source=test", "pqos=mine", "fps_max=7"], conf.path).document
        return float(document["pqos"]["kbps"])

    conf.write("pqos/mine.yaml", "defaults: [constant, _self_]\n")
    assert [kbps(), kbps()] == [5000, 5000]
    conf.change("pqos/constant.yaml", {"kbps: 5000": "kbps: 70"})  # shadows what it builds on
    assert [kbps(), kbps()] == [70, 70]
    conf.change("pqos/constant.yaml", {"kbps: 70": "kbps: 800"})
    assert kbps() == 800
    (conf.path / "pqos" / "constant.yaml").unlink()
    assert kbps() == 5000
    conf.write("pqos/mine.yaml", "defaults: [map, _self_]\nkbps: 9\n")
    assert kbps() == 9
    (conf.path / "pqos" / "mine.yaml").unlink()
    with pytest.raises(ConfigError, match="no such file"):
        kbps()


def test_a_user_can_add_files_of_every_group(conf: UserConf) -> None:
    conf.change("cameras/front_center.yaml", {"1920": "640", "1040": "480"})
    (conf.path / "cameras/front_center.yaml").rename(conf.path / "cameras/tiny.yaml")
    conf.change("graph/h264_rtsp.yaml", {"first_port: 5600": "first_port: 7000"})
    (conf.path / "graph/h264_rtsp.yaml").rename(conf.path / "graph/own.yaml")
    conf.write("modes/own.yaml", "defaults: [paper, _self_]\n")
    conf.write("source/own.yaml", "elements: [{name: source, element: videotestsrc, properties: {pattern: ball}}]\n")
    conf.write("vehicle/mine.yaml", MINE.replace("top_view", "tiny"))
    mine = configuration(["vehicle=mine", "graph=own", "modes=own", "source=own"], conf.path).vehicle()
    assert (mine.name, list(mine.cameras)) == ("mine", ["a"])
    camera = mine.cameras["a"]
    assert (camera.width, camera.graph.settings.first_port) == (640, 7000)
    assert camera.source.elements[0].properties == {"pattern": "ball"}


def test_rules_are_changed_added_and_removed_by_name() -> None:
    words = (
        *("modes.automatic.total_from_prediction.start_kbps=700", "~modes.automatic.hold_while_capped"),
        "modes.collective.later={rule: hold_while_capped, for_s: 9}",
    )
    modes, safe = vehicle(*words).modes, vehicle().modes
    names = [call.name for call in safe[Mode.AUTOMATIC] if call.name != "hold_while_capped"]
    assert [call.name for call in modes[Mode.AUTOMATIC]] == names
    assert modes[Mode.AUTOMATIC][0].parameters == {"start_kbps": 700}
    *others, last = modes[Mode.COLLECTIVE]
    assert tuple(others) == safe[Mode.COLLECTIVE]
    assert (last.name, last.rule.name, last.parameters) == ("later", "hold_while_capped", {"for_s": 9})


@pytest.mark.parametrize(
    "text, expected",
    [
        (
            "defaults: [safe, _self_]\nautomatic: {total_fixed: {kbps: 1}}\ncollective: {total_fixed: {kbps: 1}}\n",
            [f"{mode}: {RESTATED.format(first='conf/modes/safe.yaml')}" for mode in ("automatic", "collective")],
        ),
        (
            "defaults: [safe, _self_]\nautomatic: [total_fixed: {kbps: 1}]\n",
            [f'automatic: [{{"total_fixed": {{"kbps": 1}}}}]: {NAMED}'],
        ),
        (
            "single: [demand_from_roi: {}]\nautomatic: []\ncollective: {a: {}}\n",
            [
                f'single: [{{"demand_from_roi": {{}}}}]: {NAMED}',
                f"automatic: []: {NAMED}",
                "collective.a: unknown rule; expected one of",
            ],
        ),
    ],
)
def test_a_mode_is_stated_once_and_its_rules_are_named(
    conf: UserConf, tod: Command, text: str, expected: list[str]
) -> None:
    conf.write("modes/mine.yaml", text)
    found = problems(tod, conf, "modes=mine")
    assert len(found) == len(expected)
    for start in expected:
        assert any(problem.startswith(f"~/modes/mine.yaml: {start}") for problem in found), found


def test_an_experiment_changes_numbers_of_rules_but_adds_none(conf: UserConf, tod: Command) -> None:
    text = "# @package _global_\nexperiment: {about: x, duration_s: 9}\nmodes: {automatic: {%s}}\n"
    conf.write("experiment/mine.yaml", text % "follow_link: {reserve_kbps: 7}")
    rules = configuration(["source=test", "experiment=mine"], conf.path).vehicle().modes[Mode.AUTOMATIC]
    assert rules[1].parameters["reserve_kbps"] == 7
    conf.write("experiment/mine.yaml", text % "hold_upscaling: {for_s: 7}")
    refused = RESTATED.format(first="conf/modes/safe.yaml")
    assert problems(tod, conf, "experiment=mine") == [f"~/experiment/mine.yaml: modes.automatic: {refused}"]


def test_overrides_name_rules(tod: Command) -> None:
    words = ("modes.automatic.1.follow_link.start=1", "modes.single.0=null", "modes.automatic={a: {}}")
    numbered = "rules are named, not numbered: "
    assert tod("print", *words).problems == [
        f"command line: modes.automatic.1.follow_link.start: {numbered}modes.automatic.follow_link.start",
        f"command line: modes.single.0: {numbered}modes.single.RULE.NUMBER",
        f'command line: modes.automatic: {{"a": {{}}}}: {MERGED}',
    ]


def test_a_vehicle_builds_on_another(conf: UserConf) -> None:
    conf.write(
        "vehicle/mine.yaml",
        "# @package _global_\ndefaults:\n  - tum_q7\n  - override /cameras@cameras.rear_center: top_view\n  - _self_\n"
        "name: mine\ncameras: {front_left: {weight: 3}}\nlatency: {fixed_ms: 60}\n",
    )
    mine = configuration(["source=test", "vehicle=mine"], conf.path).setup()
    cameras = mine.vehicle.cameras
    assert (len(cameras), cameras["front_left"].weight, cameras["rear_center"].width) == (8, 3, 1280)
    assert (mine.latency.fixed_ms, mine.latency.limit_ms) == (60, 200)


def test_a_mounted_camera_may_have_its_own_graph_and_source(conf: UserConf) -> None:
    own = "  - /graph@cameras.a.graph: h264_srt\n  - /source@cameras.a.source: appsrc\n"
    conf.write(
        "vehicle/mine.yaml", MINE.replace("  - _self_\n", f"  - /cameras@cameras.b: top_view\n{own}  - _self_\n")
    )
    cameras = configuration(["source=test", "vehicle=mine"], conf.path).vehicle().cameras
    assert [c.graph.transport for c in cameras.values()] == ["pipeline", "rtsp"]
    assert [c.source.elements[0].factory for c in cameras.values()] == ["appsrc", "videotestsrc"]


def test_overrides_mount_unmount_and_replace_cameras() -> None:
    cameras = vehicle(
        "+cameras@cameras.extra=top_view", "~cameras.top_rear", "cameras@cameras.top_left=rear_center"
    ).cameras
    assert list(cameras) == [*(name for name in TABLE_1 if name != "top_rear"), "extra"]
    assert (cameras["extra"].width, cameras["top_left"].height) == (1280, 1200)


def test_the_environment_may_name_the_directory_and_an_argument_wins(
    conf: UserConf, tmp_path: Path, tod: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    conf.write("vehicle/mine.yaml", MINE)
    words = ("print", "vehicle=mine", "source=test", "format=json")
    monkeypatch.setenv("TOD_CONF", str(conf.path))
    assert list(json.loads(tod(*words).out)["cameras"]) == ["a"]
    other = UserConf(tmp_path / "other").write("vehicle/mine.yaml", MINE.replace("cameras.a", "cameras.b"))
    assert list(json.loads(tod(*words, other.word).out)["cameras"]) == ["b"]


def test_a_relative_directory(conf: UserConf, tod: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    conf.write("vehicle/mine.yaml", MINE)
    monkeypatch.chdir(conf.path.parent)
    assert tod("print", "vehicle=mine", "source=test", f"conf={conf.path.name}").out.startswith(
        "# mine, mode automatic"
    )


# --- mistakes ---------------------------------------------------------------------------------------------------------


def problems(tod: Command, conf: UserConf, *words: str) -> list[str]:
    """The problems that `print` reports; the user's directory is shown as ~."""
    found = tod("print", "source=test", *words, *([conf.word] if conf.path.exists() else []))
    return [problem.replace(str(conf.path), "~") for problem in found.problems]


def test_uplinks_support_rtsp_only(tod: Command) -> None:
    rule = "support RTSP only; the graph of front has its own transport; choose graph=h264_rtsp, or name none"
    found = tod("print", "vehicle=delivery_robot", "source=test", "graph=h264_srt", "uplinks={a: {interface: wwan0}}")
    assert found.status == 2
    assert found.problems == [f"command line: uplinks: {rule}; see conf/graph/h264_srt.yaml: transport: 'pipeline'"]


@pytest.mark.parametrize("word", ["graph.vehicle.crop.element=x", "graph.vehicle.x=1", "~graph.vehicle.0"])
def test_an_entry_of_a_list_is_named_by_its_number(tod: Command, word: str) -> None:
    found = tod("print", word)
    assert found.status == 2
    assert found.err.startswith(f"command line: {word}: ")
    assert "list entries are addressed by index, from 0" in found.err


def test_whole_numbers_have_no_decimal_point(tod: Command) -> None:
    """JSON Schema considers 1920.0 whole; caps and sockets do not."""
    places = {
        "cameras.front_left.width_px=1920.0": "cameras.front_left.width_px: 1920.0",
        "media.rtp_ports=[5000,5100.0]": "media.rtp_ports[1]: 5100.0",
        "source.capture.controls={exposure: 100.0}": "source.capture.controls.exposure: 100.0",
        "source.capture.width=1280.0": "source.capture.width: 1280.0",
    }
    problems = tod("print", "source=v4l2", "cameras.front_left.fps=40.0", *places).problems
    rule = "must be written without a decimal point"
    assert sorted(problems) == sorted(f"command line: {place}: {rule}" for place in places.values())


def test_a_graph_without_efforts_has_the_usual_one(tod: Command) -> None:
    (problem,) = tod("print", "graph.efforts=null").problems
    assert "unknown placeholder {preset}" in problem


def test_the_three_messages_of_the_style_guide(
    conf: UserConf, tod: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = UserConf(tmp_path / "conf")
    own.change("cameras/rear_center.yaml", {"[0, 400, 1800]": "[0, 400, 400]", "height_px": "heigth_px"})
    own.change("modes/paper.yaml", {"share_by_demand": "share_by_demnd"})
    monkeypatch.chdir(tmp_path)
    found = tod("print", "source=test", "modes=paper", "conf=conf")
    assert (found.status, found.out) == (2, "")
    *messages, summary = found.err.splitlines()
    assert sorted(messages) == [
        "conf/cameras/rear_center.yaml: heigth_px: unknown key, did you mean height_px?",
        f"conf/cameras/rear_center.yaml: rate_quality.b_min_kbps: [0, 400, 400]: {RISING}",
        "conf/modes/paper.yaml: automatic.share_by_demnd: unknown rule, did you mean share_by_demand?" + OWN_RULES,
    ]
    assert summary == "3 problems, nothing was started"


REAR, GRAPH, PAPER, ROBOT = (
    "cameras/rear_center.yaml",
    "graph/h264_rtsp.yaml",
    "modes/paper.yaml",
    "vehicle/delivery_robot.yaml",
)


@pytest.mark.parametrize(
    "file, changes, expected",
    [
        # cameras
        (REAR, {"height_px": "heigth_px"}, "heigth_px: unknown key, did you mean height_px?"),
        (REAR, {"1920": "wide"}, "width_px: 'wide': must be a whole number"),
        (REAR, {"1920": "'1920'"}, "width_px: '1920': must be a whole number"),
        (REAR, {"1920": "8"}, "width_px: 8: must be at least 16"),
        (REAR, {"fps: 40": "fps:"}, "fps: null: must be a number"),
        (REAR, {"fps: 40": ""}, "fps: missing: must be given"),
        (REAR, {"fps: 40": "fps: -4"}, "fps: -4: must be above 0"),
        (REAR, {"fps: 40": "fps: .nan"}, "fps: nan: must be a finite number"),
        (REAR, {"4000": "1e400"}, "rate_quality.b_full_kbps: inf: must be a finite number"),
        (
            REAR,
            {"[0, 400, 1800]": "[0, 400]"},
            "rate_quality.b_min_kbps: [0, 400]: must have 3 entries, one per scaling factor",
        ),
        (
            REAR,
            {"[0, 400, 1800]": "[0, 400, 400]"},
            "rate_quality.b_min_kbps: [0, 400, 400]: must start at 0 and be strictly increasing",
        ),
        (
            REAR,
            {"[0, 400, 1800]": "[5, 400, 1800]"},
            "rate_quality.b_min_kbps: [5, 400, 1800]: must start at 0 and be strictly increasing",
        ),
        (REAR, {"[0, 400, 1800]": "[0, a, 1800]"}, "rate_quality.b_min_kbps[1]: 'a': must be a number"),
        (REAR, {"[0.125, 0.25, 0.5]": "[0, 0.25, 0.5]"}, "rate_quality.scaling[0]: 0: must be above 0"),
        (REAR, {"[0.125, 0.25, 0.5]": "[0.125, 0.25, 1.5]"}, "rate_quality.scaling[2]: 1.5: must be at most 1"),
        (
            REAR,
            {"[0.125, 0.25, 0.5]": "[0.25, 0.125, 0.5]"},
            "rate_quality.scaling: [0.25, 0.125, 0.5]: must be strictly increasing",
        ),
        (REAR, {"[0.125, 0.25, 0.5]": "0.5"}, "rate_quality.scaling: 0.5: must be a list"),
        (REAR, {"4000": "1800"}, "rate_quality.b_full_kbps: 1800: must be above the last b_min, 1800"),
        (REAR, {"rate_quality:": "rate_qualty:"}, "rate_qualty: unknown key, did you mean rate_quality?"),
        (REAR, {"fps: 40": "_target_: os.system\nfps: 40"}, f"_target_: unknown key; expected one of {CAMERA_KEYS}"),
        (REAR, {"fps: 40": "fps: ${oc.env:HOME}"}, "fps: Unsupported interpolation type oc.env"),
        (REAR, {"fps: 40": "fps: ${nope}"}, "fps: Interpolation key 'nope' not found"),
        # graphs
        (
            GRAPH,
            {"gate, property": "gaet, property"},
            "knobs.sending[0].element: 'gaet': no such element, did you mean gate?",
        ),
        (GRAPH, {"value: kbps": "value: kbit"}, f"knobs.bitrate[0].value: 'kbit': {KNOB_VALUES}"),
        (
            GRAPH,
            {"value: kbps": "value: left"},
            "knobs.bitrate: 'left': bitrate offers kbps, bps, controls, key_interval_frames, vbv_ms",
        ),
        (GRAPH, {'value: "off"': "value: off"}, 'knobs.sending[0].value: false: must be text, quote it: "on" or "off"'),
        (
            GRAPH,
            {"{mtu_bytes}": "{mtu_byte}"},
            "sender[1].properties.mtu: '{mtu_byte}': unknown placeholder {mtu_byte}, did you mean mtu_bytes?",
        ),
        (GRAPH, {"name: scaler": "name: crop"}, "vehicle[2].name: 'crop': is already the name of another element"),
        (
            GRAPH,
            {"name: pay0": "name: pay"},
            "vehicle: 'pay': the last element must be named pay0, as the RTSP server requires",
        ),
        (
            GRAPH,
            {"transport: rtsp": "transport: rtps"},
            "transport: 'rtps': must be one of rtsp, pipeline, did you mean rtsp?",
        ),
        (GRAPH, {"mtu_bytes: 1200": "mtu_bytes: many"}, "mtu_bytes: 'many': must be a whole number"),
        (GRAPH, {"mtu_bytes: 1200": "mtu_bites: 1200"}, "mtu_bites: unknown key, did you mean mtu_bytes?"),
        # modes
        (
            PAPER,
            {"share_by_demand": "share_by_demnd"},
            "automatic.share_by_demnd: unknown rule, did you mean share_by_demand?" + OWN_RULES,
        ),
        (PAPER, {"start_kbps: 3000": "start_kbp: 1"}, "start_kbp: 1: unknown parameter, did you mean start_kbps?"),
        (PAPER, {"start_kbps: 3000": ""}, "start_kbps: missing: required by this rule"),
        (PAPER, {"start_kbps: 3000": "start_kbps: -1"}, "start_kbps: -1: must be a number of 0 or more"),
        (PAPER, {"collective:": "colective:"}, "colective: unknown key, did you mean collective?"),
        (
            PAPER,
            {"  keep_operator_settings: {}": "  keep_operator_settings: 1"},
            "single.keep_operator_settings: 1: must be a mapping",
        ),
    ],
)
def test_a_mistake_in_a_file(conf: UserConf, tod: Command, file: str, changes: dict[str, str], expected: str) -> None:
    conf.change(file, changes)
    (problem,) = problems(tod, conf, "modes=paper")
    assert problem.startswith(f"~/{file}: ")
    assert problem.endswith(expected)


@pytest.mark.parametrize(
    "old, new, expected",
    [
        ("compact_480p", "compact_48p", "defaults: 'cameras/compact_48p': no such file, did you mean compact_480p?"),
        (
            "/cameras@cameras.rear",
            "/camera@cameras.rear",
            "defaults: 'camera/compact_480p': no such file; "
            "expected one of the groups /vehicle, /cameras, /modes, /graph, /source, /pqos, "
            "/recording, /study, /sound, /voice, /link, /experiment",
        ),
        (
            "@cameras.rear",
            "@cameras.front",
            "defaults: '/cameras@cameras.front': is chosen twice; "
            "to replace a choice write override /cameras@cameras.front: FILE",
        ),
        ("  rear:\n", "  front:\n", "line 18: found duplicate key front"),
        ("  rear:\n", "  raer:\n", "cameras.raer: no camera of that name is mounted, did you mean rear?"),
        (
            "  rear:\n",
            "  back:\n",
            "cameras.back: no camera of that name is mounted; "
            "its kind is named in the defaults list: /cameras@cameras.back: KIND",
        ),
        ("  rear:\n", "  on:\n", "cameras.True: a key must be text, quote it"),
        ("weight: 2", "weigth: 2", "cameras.front.weigth: unknown key, did you mean weight?"),
        ("weight: 2", "weight: -2", "cameras.front.weight: -2: must be at least 0"),
        ("weight: 2", "graph: h264_srt", "cameras.front.graph: 'h264_srt': must be a mapping"),
        ("name: delivery_robot", "name: on", 'name: true: must be text, quote it: "on" or "off"'),
        ("name: delivery_robot", "name: delivery_robot\nno: 7", "False: a key must be text, quote it"),
        ("name: delivery_robot", "name: my robot", "name: 'my robot': must be letters, digits, _ and - only"),
        ("# @package _global_\n", "", "must begin with the line # @package _global_"),
        ("{row: 0, column: 0}", "{row: 0}", "cameras.front.place.column: missing: must be given"),
        (
            "{row: 0, column: 0}",
            "{row: 0, column: 0, row_span: 0}",
            "cameras.front.place.row_span: 0: must be at least 1",
        ),
        (
            "{row: 0, column: 0}",
            "{row: 0, column: 0, row_span: 2}",
            'cameras.rear.place: {"row": 1, "column": 0}: overlaps the place of camera front',
        ),
        ("cameras:\n", "cameras: [\n", "line 14: expected ',' or ']', but got ':'"),
        ("cameras:\n", "\tcameras:\n", "line 12: found character '\\t' that cannot start any token"),
        ("defaults:\n", "defaults: robot\nx:\n", "defaults: 'robot': must be a list"),
        ("  - _self_\n", "  - 3\n", "defaults[3]: 3: must be a file's name or GROUP: NAME"),
        ("  - _self_\n", "  - delivery_robot\n", "defaults[3]: 'delivery_robot': is this file itself"),
        ("weight: 2", "weight: '${'", "cameras.front.weight: no viable alternative at input '${'"),
        ("cameras:\n", "latency: {fixd_ms: 60}\ncameras:\n", "latency.fixd_ms: unknown key, did you mean fixed_ms?"),
        ("cameras:\n", "cameras: [1]\nx:\n", "a key is a list here and a mapping in a file that this builds on"),
        ("weight: 2", "weight: &a [*a]", "line 15: an alias, *a, is part of the value it refers to"),
        (
            ": compact_480p",
            ": ${oc.env:HOME}",
            "defaults: ${oc.env:HOME}: a defaults list may refer only to a choice above it, such as ${vehicle}",
        ),
    ],
)
def test_a_mistake_in_a_vehicle(conf: UserConf, tod: Command, old: str, new: str, expected: str) -> None:
    conf.change(ROBOT, {old: new})
    assert problems(tod, conf, "vehicle=delivery_robot") == [f"~/{ROBOT}: {expected}"]


def test_a_native_picture_must_hold_the_crop(conf: UserConf, tod: Command) -> None:
    conf.change("cameras/wide_720p.yaml", {"top_px: 120": "top_px: 300"})
    assert problems(tod, conf, "vehicle=delivery_robot") == [
        "~/cameras/wide_720p.yaml: native: 1280x720 at 0,300: must lie inside the native 1280x960"
    ]


@pytest.mark.parametrize(
    "content, expected",
    [
        (b"", "is empty, must be a mapping"),
        (b"name: x\n", "must begin with the line # @package _global_"),
        (b"name: \xff", "'utf-8' codec can't decode byte 0xff in position 6: invalid start byte"),
        (b"# @package _global_\n- a\n- b\n", '["a", "b"]: must be a mapping'),
        (
            b"# @package _global_\nname: !!python/object/apply:os.getcwd []\n",
            "line 2: could not determine a constructor",
        ),
    ],
)
def test_a_file_that_is_no_configuration(conf: UserConf, tod: Command, content: bytes, expected: str) -> None:
    conf.write("vehicle/mine.yaml", content)
    (problem,) = problems(tod, conf, "vehicle=mine")
    assert problem.startswith(f"~/vehicle/mine.yaml: {expected}")


def test_a_rule_list_in_the_wrong_order(conf: UserConf, tod: Command) -> None:
    conf.write(
        "modes/mine.yaml",
        (CONF / PAPER).read_text().partition("collective:")[0]
        + "collective: {share_by_demand: {}, total_from_operator: {start_kbps: 1}}\n",
    )
    assert problems(tod, conf, "modes=mine") == [
        "~/modes/mine.yaml: collective.share_by_demand: needs demand, which no earlier rule gives",
        "~/modes/mine.yaml: collective.share_by_demand: needs total, which no earlier rule gives",
        '~/modes/mine.yaml: collective: ["share_by_demand", "total_from_operator"]: no rule gives demand, scaling',
    ]


def test_a_base_that_does_not_exist(conf: UserConf, tod: Command) -> None:
    conf.write("modes/mine.yaml", "defaults: [papr, _self_]\n")
    assert problems(tod, conf, "modes=mine") == [
        "~/modes/mine.yaml: defaults: 'modes/papr': no such file, did you mean paper?"
    ]


@pytest.mark.parametrize(
    "words, expected",
    [
        (["vehicle=tum_q8"], "vehicle: tum_q8: no such file in conf/vehicle/, did you mean tum_q7?"),
        (["modes=saef"], "modes: saef: no such file in conf/modes/, did you mean safe?"),
        (["pqos=none"], f"pqos: none: no such file in conf/pqos/; expected one of constant, live, map, trace; {OWN}"),
        (
            ["vehicle=null"],
            f"vehicle: null: no such file in conf/vehicle/; expected one of delivery_robot, one_camera, tum_q7; {OWN}",
        ),
        (["+graph@cameras.front_left.graph=h264_srtt"], "no such file in conf/graph/, did you mean h264_srt?"),
        (["vehicle=a,b"], f"vehicle=a,b: {SWEEP}"),
        (["mode=single,automatic"], f"mode=single,automatic: {SWEEP}"),
        (["mode=autmatic"], "mode: 'autmatic': must be one of single, automatic, collective, did you mean automatic?"),
        (["nothing=3"], f"nothing: unknown key; expected one of {TOP_KEYS}"),
        (["+_target_=os.system"], f"_target_: unknown key; expected one of {TOP_KEYS}"),
        (["hydra.run.dir=/tmp"], "hydra.run.dir=/tmp: no such key"),
        (["=3"], "=3: no such key"),
        (["cameras.front_left.heigth_px=3"], "cameras.front_left.heigth_px: unknown key, did you mean height_px?"),
        (
            ["cameras.front_lfet.weight=3"],
            "cameras.front_lfet: no camera of that name is mounted, did you mean front_left?",
        ),
        (["cameras.front_left.weight=two"], "cameras.front_left.weight: 'two': must be a number"),
        (["cameras.front_left.weight=inf"], "cameras.front_left.weight: inf: must be a finite number"),
        (["cameras.front_left=null"], "cameras.front_left: null: must be a mapping"),
        (["fps_max=0"], "fps_max: 0: must be above 0"),
        (["fps_max=on"], "fps_max: 'on': must be a number or null"),
        (["media.port=0"], "media.port: 0: must be at least 1"),
        (["media.port=on"], "media.port: 'on': must be a whole number"),
        (["media.rtp_ports=[21000,20000]"], "media.rtp_ports: [21000, 20000]: must be [first, last], first below last"),
        (
            ["media.rtp_ports=[20001,20016]"],
            "media.rtp_ports: [20001, 20016]: must hold two ports, of which the first is even, for each of 8 cameras",
        ),
        (
            ["graph=h264_srt", "graph.mtu_bytes=1317"],
            "graph.mtu_bytes: 1317: must be at most 1316 with srtsink, which cuts longer packets",
        ),
        (["media.max_viewers=0"], "media.max_viewers: 0: must be at least 1"),
        (
            ["media.watcher_copies=true"],
            "media.watcher_copies: true: must be false while max_viewers is 1: "
            "the operator in control would take the watcher's place",
        ),
        (["media.session_timeout_s=1.5"], "media.session_timeout_s: 1.5: must be a whole number"),
        (["media.host=on", "media.port=true"], "media.port: true: must be a whole number"),
        (["name=${oc.env:HOME}"], "name: Unsupported interpolation type oc.env"),
        (["name=${nope}"], "name: Interpolation key 'nope' not found"),
        (
            ["cameras.front_left.clip=/it's.mp4"],
            f"cameras.front_left.clip=/it's.mp4: token recognition error at: ''s.mp4'{QUOTE}",
        ),
        (["a=b=c"], f"a=b=c: mismatched input '=' expecting <EOF>{QUOTE}"),
        (
            ["graph.first_port=8550"],
            "graph.first_port: 8550: camera top_front would get port 8554, already the port of media.port",
        ),
        (["control.port=8554"], "control.port: 8554: is already the port of media.port"),
        (["dimensions.front_m=2.5"], "dimensions.front_m: 2.5: must reach the front axle, 2.9 m ahead"),
        (["dimensions.track_m=2"], "dimensions.track_m: 2: must be at most width_m, 1.92"),
        (["dimensions.width=2"], "dimensions.width: unknown key, did you mean width_m?"),
        (
            ["cameras.front_left.place.column_span=2"],
            'cameras.front_center.place: {"row": 0, "column": 1}: overlaps the place of camera front_left',
        ),
        (["inputs.keys.view=d"], "inputs.keys.drawer: 'd': is already assigned to view"),
        (["inputs.buttons.theme=0"], "inputs.buttons.theme: 0: is already assigned to enlarge"),
        (["insecure=10.9.0.1"], "insecure: '10.9.0.1': must be true, false, or a network such as 10.9.0.0/24"),
        (["insecure=10.9.0.0/40"], "insecure: 10.9.0.0/40: must be true, false, or a network such as 10.9.0.0/24"),
        (["inputs.buttons.view=3.5"], "inputs.buttons.view: 3.5: must be a whole number or text or null"),
        (
            ["inputs.buttons.view=axis6"],
            "inputs.buttons.view: 'axis6': must be a number, or like axis6- or hat9-left",
        ),
        (
            ["inputs.buttons.view=hat9-up", "inputs.buttons.map=hat9-up"],
            "inputs.buttons.map: 'hat9-up': is already assigned to view",
        ),
        (["~graph=1"], "~graph=1: what follows = must be the name of a file; to remove the choice itself: ~graph"),
        (["~pqos=[1]"], "~pqos=[1]: what follows = must be the name of a file; to remove the choice itself: ~pqos"),
        (["cameras.rear_center.fps=0.1"], "fps: 0.1: with vbv_frames 1.5 of its graph it must be at least 0.15"),
        (["graph.jitter_buffer_ms=1000000"], "graph.jitter_buffer_ms: 1000000: must be at most 10000"),
        (
            ["cameras.rear_center.rate_quality.b_full_kbps=1e9"],
            "cameras.rear_center.rate_quality.b_full_kbps: 1000000000.0: must be at most 2000000",
        ),
        (["log.lossless=[front_center]"], "log.lossless: [front_center]: must be a mapping"),
        (["cameras.rear_center.rate_quality.scaling={a:1}"], "rate_quality.scaling: {a:1}: must be a list"),
        (
            ["cameras.rear_center.rate_quality={scaling: {a: 1}}"],
            "rate_quality: {scaling: {a: 1}}: has a list in place of a mapping, or the reverse",
        ),
        (["~cameras.nothing"], "Could not delete from config. 'cameras.nothing' does not exist."),
    ],
)
def test_a_mistake_on_the_command_line(conf: UserConf, tod: Command, words: list[str], expected: str) -> None:
    (problem,) = problems(tod, conf, *words)
    assert "command line: " in problem  # alone, or as the other value of a rule about two
    assert problem.partition("; see ")[0].endswith(expected)


def test_every_overlapping_tile_is_reported(conf: UserConf, tod: Command) -> None:
    words = [f"cameras.{name}.place.row=0" for name in ("rear_center", "top_left", "top_right")]
    found = [line.removeprefix("command line: cameras.") for line in problems(tod, conf, *words)]
    other = "see conf/vehicle/tum_q7.yaml: cameras"
    assert found == [
        'rear_center.place: {"row": 0, "column": 1}: overlaps the place of camera front_center; '
        f'{other}.front_center.place: {{"row": 0, "column": 1}}',
        'top_left.place: {"row": 0, "column": 1}: overlaps the place of camera front_center; '
        f'{other}.front_center.place: {{"row": 0, "column": 1}}',
        'top_right.place: {"row": 0, "column": 2}: overlaps the place of camera front_right; '
        f'{other}.front_right.place: {{"row": 0, "column": 2}}',
    ]


def test_ports_of_two_cameras_with_graphs_of_their_own(conf: UserConf, tod: Command) -> None:
    conf.write(
        "vehicle/mine.yaml",
        MINE.replace(
            "  - _self_\n", "  - /cameras@cameras.b: top_view\n  - /graph@cameras.b.graph: h264_rtsp\n  - _self_\n"
        )
        + "cameras: {b: {graph: {first_port: 5599}}}\n",
    )
    assert problems(tod, conf, "vehicle=mine") == [
        "~/vehicle/mine.yaml: cameras.b.graph.first_port: 5599: "
        "camera b would get port 5600, already the port of camera a; see conf/graph/h264_rtsp.yaml: first_port: 5600"
    ]


@pytest.mark.parametrize(
    "words, expected",
    [
        (
            ["source=file"],
            ["conf/source/file.yaml: clip: null: must be given: source.clip=, or clip of each mounted camera"],
        ),
        (["source=file", "source.clip=/no.mp4"], ["command line: source.clip: '/no.mp4': no such file"]),
        (["source=file", "source.clip=/dev/zero"], ["command line: source.clip: '/dev/zero': must be a file"]),
        (
            ["source=file", f"source.clip={CONF}/config.yaml", "cameras.top_left.clip=/no.mp4"],
            ["command line: cameras.top_left.clip: '/no.mp4': no such file"],
        ),
        (
            ["source=rtsp"],
            ["conf/source/rtsp.yaml: address: null: must be given: source.address=, or address of each mounted camera"],
        ),
    ],
)
def test_what_a_source_needs_must_exist(tod: Command, words: list[str], expected: list[str]) -> None:
    assert tod("print", *words).problems == expected


def test_all_problems_are_reported_at_once_in_one_run(conf: UserConf, tod: Command) -> None:
    conf.change(REAR, {"[0, 400, 1800]": "[0, 400]", "fps: 40": "fps: fast"})
    conf.change("cameras/top_view.yaml", {"3000": "400"})
    conf.change(GRAPH, {"gate, property": "gaet, property"})
    conf.change(PAPER, {"single:": "singel:", "share_by_demand": "shareby_demand"})
    found = problems(tod, conf, "modes=paper", "fps_max=-1", "cameras.top_rear.weigth=2", "media.port=99999")
    assert sorted(found) == sorted(
        [
            f"~/{REAR}: fps: 'fast': must be a number",
            f"~/{REAR}: rate_quality.b_min_kbps: [0, 400]: must have 3 entries, one per scaling factor",
            "~/cameras/top_view.yaml: rate_quality.b_full_kbps: 400: must be above the last b_min, 400",
            f"~/{GRAPH}: knobs.sending[0].element: 'gaet': no such element, did you mean gate?",
            f"~/{PAPER}: singel: unknown key, did you mean single?",
            f"~/{PAPER}: automatic.shareby_demand: unknown rule, did you mean share_by_demand?" + OWN_RULES,
            "command line: fps_max: -1: must be above 0",
            "command line: cameras.top_rear.weigth: unknown key, did you mean weight?",
            "command line: media.port: 99999: must be at most 65535",
        ]
    )


def test_the_same_problem_is_reported_once() -> None:
    problem = Problem("a.yaml", "b", "1", "must not")
    assert str(ConfigError([problem, problem])) == "a.yaml: b: 1: must not\n1 problem, nothing was started"
    two = ConfigError([problem, Problem("a.yaml", "", None, "must not either")])
    assert str(two).splitlines()[1:] == ["a.yaml: must not either", "2 problems, nothing was started"]


def test_the_environment_does_not_affect_the_configuration(conf: UserConf) -> None:
    conf.write("vehicle/mine.yaml", MINE.replace("top_view", "${oc.env:KIND}"))
    words = ("print", "vehicle=mine", "source=test", conf.word)
    result = process(*words, env={**os.environ, "KIND": "top_view"})
    assert (result.status, result.out) == (2, "")
    conf.write("vehicle/mine.yaml", MINE + "media: {host: '${oc.env:KIND}'}\n")
    result = process(*words, env={**os.environ, "KIND": "top_view"})
    assert result.err.splitlines()[0].endswith("media.host: Unsupported interpolation type oc.env")


def test_a_program_names_its_directory_like_the_command_line(conf: UserConf) -> None:
    """As an override, as text or as a path, but not two of them."""
    conf.write("vehicle/mine.yaml", "# @package _global_\ndefaults: [delivery_robot, _self_]\nname: mine\n")
    path = conf.path
    for words, named in (([f"conf={path}"], None), ([], str(path)), ([], path), ([f"conf={path}"], path)):
        assert configuration(["vehicle=mine", *words], named).vehicle().name == "mine"
    with pytest.raises(UserError) as error:
        configuration(["vehicle=mine", "conf=other"], path)
    assert str(error.value) == f"command line: conf: 'other': must name one directory; {path} was named, too"
