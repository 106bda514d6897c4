"""Every file and every combination; files of the user's own with all problems at once."""

from __future__ import annotations

import importlib.util

import pytest
from helpers import CONF, Command, UserConf, process

from runner.compose import GROUPS

ONE = {  # a single combination
    "vehicle": "delivery_robot",
    "modes": "paper",
    "graph": "h264_rtsp",
    "source": "test",
    "pqos": "constant",
    "recording": "x264",
    "study": "paper",
    "link": "null",
    "experiment": "null",
}


def count(group: str) -> int:
    return len(list((CONF / group).glob("*.yaml")))


def test_what_is_packaged_is_valid() -> None:
    """All graphs and vehicles; the rest of the combinations is a step of its own in `make test`."""
    result = process("validate", "source=test", "modes=paper")
    files = sum(map(count, (".", *GROUPS)))
    combinations = count("vehicle") * count("graph")
    assert (result.status, result.err) == (0, "")
    first, *notes = result.out.splitlines()
    assert first == f"{files} files and {combinations} combinations of vehicle, modes, graph, source are valid"
    assert all(note.startswith(("not checked: ", "nothing was checked against the GStreamer")) for note in notes)


def one(*every: str) -> list[str]:
    """Choices that leave a single combination, but every file of some groups."""
    return [f"{group}={choice}" for group, choice in ONE.items() if group not in every]


def problems(tod: Command, conf: UserConf, *words: str) -> list[str]:
    return [line.replace(str(conf.path), "~") for line in tod("validate", conf.word, *words).problems]


def test_a_users_files_are_checked_all_at_once(tod: Command, conf: UserConf) -> None:
    conf.write("vehicel/x.yaml", "a: 1\n").write("foo.yaml", "a: 1\n").write("modes/y.yaml", "a: [\n")
    conf.change("cameras/top_view.yaml", {"fps: 30": "fsp: 30"})
    groups = f"the groups are {', '.join(f'{group}/' for group in GROUPS)}"
    assert problems(tod, conf) == [
        "~/cameras/top_view.yaml: fsp: unknown key, did you mean fps?",
        f"~/foo.yaml: belongs to no group, {groups}",
        "~/modes/y.yaml: line 2: expected the node content, but found '<stream end>'",
        f"~/vehicel/x.yaml: belongs to no group, {groups}",
    ]


def test_what_a_file_alone_does_not_show(tod: Command, conf: UserConf) -> None:
    conf.change("cameras/mast_1200p.yaml", {"[0, 300]": "[0, 0]"})
    conf.change("modes/paper.yaml", {"share_by_demand": "share_by_demnd"})
    assert sorted(problems(tod, conf, *one("modes")), reverse=True) == [
        "~/modes/paper.yaml: automatic[2]: 'share_by_demnd': unknown rule, did you mean share_by_demand?",
        "~/cameras/mast_1200p.yaml: rate_quality.b_min_kbps: [0, 0]: must rise from 0",
    ]


def test_a_users_additions_are_combined_with_everything(tod: Command, conf: UserConf) -> None:
    conf.write("modes/mine.yaml", "defaults: [paper, _self_]\n")
    result = tod("validate", conf.word, *one("modes"))
    assert result.status == 0
    assert f"and {count('modes') + 1} combinations" in result.out


def test_maps_are_no_configuration(tod: Command, conf: UserConf) -> None:
    conf.write("maps/opencv.yaml", "%YAML:1.0\n---\na: !!opencv-matrix\n")
    assert tod("validate", conf.word, *one()).status == 0


@pytest.mark.parametrize(
    "rows, told",
    [
        ("lon,lat,kbps\n", "must have rows, there is none"),
        ("lon,lat\n1,2\n", None),
        (None, "no such file"),
    ],
)
def test_maps_are_read(tod: Command, conf: UserConf, rows: str | None, told: str | None) -> None:
    conf.change("pqos/map.yaml", {"maps/demo_loop.csv": "maps/mine.csv"})
    if rows is not None:
        conf.write("maps/mine.csv", rows)
    (problem,) = problems(tod, conf, *one("pqos"))
    assert problem.startswith("~/pqos/map.yaml: file: ")
    assert told is None or told in problem


@pytest.mark.gst
@pytest.mark.skipif(importlib.util.find_spec("gi") is None, reason="PyGObject is not installed")
@pytest.mark.parametrize(
    "old, new, told",
    [
        ("element: x264enc", "element: x264encc", "vehicle[4].element: 'x264encc'"),
        ("quantizer: 10", "quantiser: 10", "vehicle[4].properties.quantiser"),
        ("quantizer: 10", "quantizer: 100", "vehicle[4].properties.quantizer"),
        ("speed-preset: superfast", "speed-preset: superfst", "vehicle[4].properties.speed-preset"),
        ("property: bitrate, value: kbps", "property: threads, value: kbps", "knobs.bitrate[0].property"),
        ("property: bitrate, value: kbps", "property: bitrat, value: kbps", "knobs.bitrate[0].property"),
    ],
)
def test_against_the_registry(tod: Command, conf: UserConf, old: str, new: str, told: str) -> None:
    conf.change("graph/h264_rtsp.yaml", {old: new})
    found = problems(tod, conf, *one())
    assert any(problem.startswith(f"~/graph/h264_rtsp.yaml: {told}") for problem in found), found


@pytest.mark.gst
@pytest.mark.skipif(importlib.util.find_spec("gi") is None, reason="PyGObject is not installed")
@pytest.mark.parametrize(
    "old, new, told",
    [
        ("element: avenc_ffv1", "element: avenc_ffv2", "elements[0].element: 'avenc_ffv2': unknown element, "),
        ("slices: 4", "slices: -4", "elements[0].properties.slices: -4: must be from 0 to 2147483647"),
        ("name: encoder", "name: waiting", "elements[0].name: 'waiting': is already the name of another element"),
        ("element: matroskamux, properties: {timecodescale: 1000}", "element: h264parse", "elements: could not link"),
    ],
)
def test_ways_to_record_are_checked_though_none_is_chosen(
    tod: Command, conf: UserConf, old: str, new: str, told: str
) -> None:
    conf.change("recording/ffv1.yaml", {old: new})
    (found,) = problems(tod, conf, *one("recording"))
    assert found.startswith(f"~/recording/ffv1.yaml: {told}")


def test_a_way_of_measuring_models_is_checked(tod: Command, conf: UserConf) -> None:
    conf.change("study/paper.yaml", {"[50, 63,": "[63, 50,"})
    (problem,) = problems(tod, conf, *one("study"))
    assert problem.startswith("~/study/paper.yaml: bitrates_kbps: [63, 50, ")
    assert problem.endswith(": must rise")
