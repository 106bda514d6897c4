"""Every file and every combination; all problems of a user's files together."""

from __future__ import annotations

import importlib.util
import os
import threading
from concurrent.futures import Executor
from contextlib import AbstractContextManager
from multiprocessing import active_children

import pytest
from helpers import CONF, Command, UserConf, process, source_for

from runner.configuration.config import configuration
from runner.configuration.files import GROUPS
from runner.configuration.rule_lists import OWN_RULES
from runner.plans import compile_plans
from runner.system import spawned
from runner.verbs import validate

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


@pytest.mark.slow
@pytest.mark.parametrize("words", [["source=test"], pytest.param([], marks=pytest.mark.soak)])
def test_what_is_packaged_is_valid(words: list[str]) -> None:
    """Every file, and every combination with one source; `make soak` takes all, and tests/golden plans with all."""
    result = process("validate", "all=true", *words)
    files = sum(map(count, (".", *GROUPS)))
    assert (result.status, result.err) == (0, "")
    first, *notes = result.out.splitlines()
    assert first.startswith(f"valid: {files} files, ")
    assert int(first.split()[3]) > count("vehicle") * count("graph") + count("experiment")
    assert all(note.startswith(("not checked: ", "nothing was checked against the GStreamer")) for note in notes)


# --- many runs --------------------------------------------------------------------------------------------------------

PER_WORKER = 2  # fewer than are worth the start of a worker, which makes no difference to what is found
RUNS = "".join(f"    run{n}: [control.port={2000 + n}]\n" for n in range(2 * PER_WORKER))
EXPERIMENT = """# @package _global_
defaults: [driving_test, _self_]
experiment:
  runs:
"""


@pytest.mark.slow
def test_worker_processes_report_the_same_as_one_process(
    tod: Command, conf: UserConf, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(validate, "PER_WORKER", PER_WORKER)
    wrong = "    fast: [control.port=-1]\n    slow: [control.prt=1]\n"
    conf.write("experiment/many.yaml", EXPERIMENT + RUNS + wrong)
    conf.write("experiment/narrow.yaml", f"{EXPERIMENT}{RUNS}{wrong}cameras:\n  ghost: {{weight: 2}}\n")
    pools: list[int] = []
    pool = spawned.process_pool

    def noted(workers: int) -> AbstractContextManager[Executor]:
        pools.append(workers)
        return pool(workers)

    monkeypatch.setattr(spawned, "process_pool", noted)
    expected = [  # nothing of the runs of an experiment that is broken itself
        "~/experiment/many.yaml: experiment.runs.fast: control.port=-1: must be at least 1",
        "~/experiment/many.yaml: experiment.runs.slow: control.prt=1: unknown key, did you mean port?",
        "~/experiment/narrow.yaml: cameras.ghost: no camera of that name is mounted; its kind is named in the defaults "
        "list: /cameras@cameras.ghost: KIND",
    ]
    for cores in ({0, 1}, {0}):
        monkeypatch.setattr(os, "sched_getaffinity", lambda _pid, cores=cores: cores)
        assert problems(tod, conf) == expected
    assert pools == [2]


@pytest.mark.slow
def test_without_shared_memory_one_process_checks_everything(
    tod: Command, conf: UserConf, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(_workers: int) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, "sched_getaffinity", lambda _pid: {0, 1})
    monkeypatch.setattr(validate, "PER_WORKER", PER_WORKER)
    monkeypatch.setattr(spawned, "process_pool", refused)
    conf.write("experiment/many.yaml", f"{EXPERIMENT}{RUNS}    fast: [control.port=-1]\n")
    assert problems(tod, conf) == ["~/experiment/many.yaml: experiment.runs.fast: control.port=-1: must be at least 1"]


@pytest.mark.slow
def test_a_worker_process_that_dies_is_reported(tod: Command, conf: UserConf, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _pid: {0, 1})
    monkeypatch.setattr(validate, "PER_WORKER", PER_WORKER)
    conf.write("experiment/many.yaml", EXPERIMENT + RUNS)
    ended = threading.Event()

    def kill() -> None:
        while not ended.wait(0.01):
            for worker in active_children():
                worker.kill()

    killing = threading.Thread(target=kill)
    killing.start()
    result = tod("validate", conf.word)
    ended.set()
    killing.join()
    assert result.status == 1
    assert "a worker process ended without a result: it may have run out of memory" in result.err


# --- choices ----------------------------------------------------------------------------------------------------------


@pytest.mark.slow  # composes many configurations
@pytest.mark.parametrize(
    "words",
    [
        pytest.param(["pqos=trace"], marks=pytest.mark.soak),
        ["graph=h264_srt", "vehicle=delivery_robot"],
        pytest.param(["cameras.rear_center.weight=2"], marks=pytest.mark.soak),
        ["+experiment=driving_test"],
    ],
)
def test_a_choice_is_not_combined_with_unchosen_files(tod: Command, words: list[str]) -> None:
    result = tod("validate", *words)
    assert (result.status, result.err) == (0, "")
    files = sum(map(count, (".", *GROUPS)))
    assert result.out.splitlines()[0] == f"valid: {files} files, 1 configuration"


def one(*every: str) -> list[str]:
    """Choices that leave a single combination, but every file of some groups."""
    return [f"{group}={choice}" for group, choice in ONE.items() if group not in every]


def problems(tod: Command, conf: UserConf, *words: str) -> list[str]:
    return [line.replace(str(conf.path), "~") for line in tod("validate", conf.word, *words).problems]


def test_all_files_of_a_user_are_checked_together(tod: Command, conf: UserConf) -> None:
    conf.write("vehicel/x.yaml", "a: 1\n").write("foo.yaml", "a: 1\n").write("modes/y.yaml", "a: [\n")
    conf.write("cameras/front/x.yaml", "a: 1\n").write("camera/x.yaml", "a: 1\n").write("cameras.yaml", "a: 1\n")
    conf.write("cameras/foo.yml", "a: 1\n").write("graph/a,b.yaml", "a: 1\n").write("graph/true.yaml", "a: 1\n")
    conf.write("source/empty.yaml", "").write(".github/x.yml", "a: 1\n").write("modes/.x.yaml", "a: [\n").write(
        "maps/opencv.yaml", "%YAML:1.0\n"
    )
    conf.change("cameras/top_view.yaml", {"fps: 30": "fsp: 30"})
    folder = f"would be ignored: must be in the folder of its group, one of {', '.join(GROUPS)}, or config.yaml"
    name = "could not be chosen: the name must be letters, digits, _ and -, and no number, true, false or null"
    assert sorted(problems(tod, conf)) == sorted(
        [
            f"~/cameras.yaml: {folder}",
            f"~/foo.yaml: {folder}",
            "~/camera/x.yaml: would be ignored: no such group as camera/, did you mean cameras?",
            "~/cameras/foo.yml: would be ignored: Hydra reads foo.yaml",
            "~/cameras/top_view.yaml: fsp: unknown key, did you mean fps?",
            "~/cameras/front/x.yaml: would be ignored: files must be directly in cameras/, not in subfolders",
            f"~/graph/a,b.yaml: {name}",
            f"~/graph/true.yaml: {name}",
            "~/modes/y.yaml: line 2: expected the node content, but found '<stream end>'",
            "~/source/empty.yaml: is empty, must be a mapping",
            "~/vehicel/x.yaml: would be ignored: no such group as vehicel/, did you mean vehicle?",
        ]
    )


@pytest.mark.slow
def test_problems_that_only_composition_shows(tod: Command, conf: UserConf) -> None:
    conf.change("cameras/mast_1200p.yaml", {"[0, 300]": "[0, 0]"})
    conf.change("modes/paper.yaml", {"share_by_demand": "share_by_demnd"})
    assert sorted(problems(tod, conf, *one("modes")), reverse=True) == [
        "~/modes/paper.yaml: automatic.share_by_demnd: unknown rule, did you mean share_by_demand?" + OWN_RULES,
        "~/cameras/mast_1200p.yaml: rate_quality.b_min_kbps: [0, 0]: must start at 0 and be strictly increasing",
    ]


def test_each_file_is_tried_and_each_vehicle_with_each_graph_and_source(tod: Command, conf: UserConf) -> None:
    conf.write("modes/mine.yaml", "defaults: [paper, _self_]\n")
    result = tod("validate", conf.word)
    assert (result.status, result.out.splitlines()[0]) == (0, "valid: 1 file, 2 configurations")
    for name in ("a", "b"):
        conf.change("vehicle/delivery_robot.yaml", {}).change("graph/h264_rtsp.yaml", {})
        (conf.path / "vehicle/delivery_robot.yaml").rename(conf.path / f"vehicle/{name}.yaml")
        (conf.path / "graph/h264_rtsp.yaml").rename(conf.path / f"graph/{name}.yaml")
    result = tod("validate", conf.word)
    assert (result.status, result.out.splitlines()[0]) == (0, "valid: 5 files, 10 configurations")
    result = tod("validate", conf.word, "vehicle=a")
    assert (result.status, result.out.splitlines()[0]) == (0, "valid: 5 files, 4 configurations")


@pytest.mark.slow
def test_a_kind_of_camera_that_no_vehicle_mounts_is_tried(tod: Command, conf: UserConf) -> None:
    conf.change("cameras/top_view.yaml", {"3000": "400"})
    (conf.path / "cameras/top_view.yaml").rename(conf.path / "cameras/mine.yaml")
    assert problems(tod, conf) == [
        "~/cameras/mine.yaml: rate_quality.b_full_kbps: 400: must be above the last b_min, 400"
    ]


def test_a_map_of_the_user_with_the_defaults(tod: Command, conf: UserConf) -> None:
    conf.write("maps/yard.csv", (CONF / "maps/demo_loop.csv").read_text())
    result = tod("validate", conf.word, "pqos.file=maps/yard.csv")
    assert (result.status, result.out.splitlines()[0]) == (0, "valid: 0 files, 1 configuration")


def test_maps_are_no_configuration(tod: Command, conf: UserConf) -> None:
    conf.write("maps/opencv.yaml", "%YAML:1.0\n---\na: !!opencv-matrix\n")
    assert tod("validate", conf.word, *one()).status == 0


@pytest.mark.parametrize(
    "rows, expected",
    [
        ("lon,lat,kbps\n", "must have rows"),
        ("lon,lat\n1,2\n", None),
        (None, "no such file"),
    ],
)
def test_maps_are_read(tod: Command, conf: UserConf, rows: str | None, expected: str | None) -> None:
    conf.change("pqos/map.yaml", {"maps/demo_loop.csv": "maps/mine.csv"})
    if rows is not None:
        conf.write("maps/mine.csv", rows)
    (problem,) = problems(tod, conf, *one("pqos"))
    assert problem.startswith("~/pqos/map.yaml: file: ")
    assert expected is None or expected in problem


@pytest.mark.gst
@pytest.mark.skipif(importlib.util.find_spec("gi") is None, reason="PyGObject is not installed")
@pytest.mark.parametrize(
    "old, new, expected",
    [
        ("element: x264enc", "element: x264encc", "encoder[0].element: 'x264encc'"),
        ("quantizer: 10", "quantiser: 10", "encoder[0].properties.quantiser"),
        ("quantizer: 10", "quantizer: 100", "encoder[0].properties.quantizer"),
        (
            "medium: {preset: superfast",
            "medium: {preset: superfst",
            "encoder[0].properties.speed-preset: 'superfst': must be one of None, ultrafast, superfast, veryfast, ",
        ),
        (
            "tune: zerolatency",
            "tune: zerolatenci",
            "encoder[0].properties.tune: 'zerolatenci': must be one of stillimage, fastdecode, zerolatency",
        ),
        ("property: bitrate, value: kbps", "property: threads, value: kbps", "knobs.bitrate[0].property"),
        ("property: bitrate, value: kbps", "property: bitrat, value: kbps", "knobs.bitrate[0].property"),
    ],
)
def test_against_the_registry(tod: Command, conf: UserConf, old: str, new: str, expected: str) -> None:
    conf.change("graph/h264_rtsp.yaml", {old: new})
    found = problems(tod, conf, *one())
    assert any(problem.startswith(f"~/graph/h264_rtsp.yaml: {expected}") for problem in found), found


@pytest.mark.gst
@pytest.mark.skipif(importlib.util.find_spec("gi") is None, reason="PyGObject is not installed")
def test_elements_of_the_packaged_graphs_have_a_package() -> None:
    """So that a machine that lacks one is told what to install."""
    from runner.elements.packages import PACKAGE_OF
    from runner.gst import Gst

    for graph in (file.stem for file in (CONF / "graph").glob("*.yaml")):
        for plan in compile_plans(configuration([f"graph={graph}", f"source={source_for(graph)}"]).setup()):
            for element in (*plan.vehicle, *plan.operator):
                found = Gst.ElementFactory.find(element.factory)
                is_core = found is not None and found.get_plugin_name() == "coreelements"
                assert is_core or element.factory in {*PACKAGE_OF, *plan.needs}, element.factory


@pytest.mark.gst
@pytest.mark.skipif(importlib.util.find_spec("gi") is None, reason="PyGObject is not installed")
def test_named_pads_against_the_registry(tod: Command, conf: UserConf) -> None:
    conf.change("graph/h264_srt.yaml", {"{sink: send_rtp_sink, src: send_rtp_src}": "{sink: send_sink, src: src_1}"})
    found = problems(tod, conf, *one(), "graph=h264_srt")
    where = "~/graph/h264_srt.yaml: sender[2].pads"
    assert found[:2] == [
        f"{where}.sink: 'send_sink': rtpsession has no such sink pad; "
        "expected one of recv_rtcp_sink, recv_rtp_sink, send_rtp_sink",
        f"{where}.src: 'src_1': rtpsession has no such src pad; "
        "expected one of recv_rtp_src, send_rtcp_src, send_rtp_src, sync_src",
    ]


@pytest.mark.gst
@pytest.mark.skipif(importlib.util.find_spec("gi") is None, reason="PyGObject is not installed")
@pytest.mark.parametrize(
    "old, new, expected",
    [
        ("element: avenc_ffv1", "element: avenc_ffv2", "elements[0].element: 'avenc_ffv2': unknown element, "),
        ("slices: 4", "slices: -4", "elements[0].properties.slices: -4: must be from 0 to 2147483647"),
        ("name: encoder", "name: waiting", "elements[0].name: 'waiting': is already the name of another element"),
        ("element: matroskamux, properties: {timecodescale: 1000}", "element: h264parse", "elements: could not link"),
    ],
)
def test_recording_files_are_checked_although_none_is_chosen(
    tod: Command, conf: UserConf, old: str, new: str, expected: str
) -> None:
    conf.change("recording/ffv1.yaml", {old: new})
    (found,) = problems(tod, conf, *one("recording"))
    assert found.startswith(f"~/recording/ffv1.yaml: {expected}")


@pytest.mark.gst
@pytest.mark.skipif(importlib.util.find_spec("gi") is None, reason="PyGObject is not installed")
def test_media_that_do_not_fit_are_named_with_what_would(tod: Command, conf: UserConf) -> None:
    """Not only `could not link sent to pay0`, which names elements between which nothing is wrong."""
    conf.change("graph/h264_rtsp.yaml", {"element: rtph264pay": "element: rtph265pay"})
    found = problems(tod, conf, *one(), "graph=h264_rtsp")
    message = (
        "could not link sent to pay0: x264enc gives video/x-h264, rtph265pay takes video/x-h265; in place of rtph265pay"
    )
    assert any(f"{message}: " in problem and "rtph264pay" in problem for problem in found), found


def test_a_study_is_checked(tod: Command, conf: UserConf) -> None:
    conf.change("study/paper.yaml", {"[50, 63,": "[63, 50,"})
    (problem,) = problems(tod, conf, *one("study"))
    assert problem.startswith("~/study/paper.yaml: bitrates_kbps: [63, 50, ")
    assert problem.endswith(": must be strictly increasing")


# --- combinations -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_reference_to_another_group_is_combined_with_each_of_its_files(tod: Command, conf: UserConf) -> None:
    conf.write("pqos/mine.yaml", "defaults: [constant, _self_]\nkbps: ${graph.mtu_bytes}\n")
    one_of_each = [f"{group}={name}" for group, name in ONE.items() if group not in ("pqos", "graph")]
    plain = tod("validate", "all=true", *one_of_each)
    with_mine = tod("validate", "all=true", conf.word, *one_of_each)
    assert (plain.status, with_mine.status) == (0, 0), with_mine.err
    before, after = (int(result.out.split()[3]) for result in (plain, with_mine))
    served = [file for file in (CONF / "graph").glob("*.yaml") if source_for(file.stem) == "test"]
    assert after - before == 1 + len(served)  # the file alone, and with each graph


# --- FILE -------------------------------------------------------------------------------------------------------------


def test_a_file_is_checked_with_those_that_build_on_it(tod: Command, conf: UserConf) -> None:
    conf.change("cameras/compact_480p.yaml", {"fps: 30": "fsp: 30"}).write("modes/broken.yaml", "a: [\n")
    conf.write("modes/a.yaml", "defaults: [paper, _self_]\n").write("modes/b.yaml", "defaults: [a, _self_]\n")
    result = tod("validate", str(conf.path / "modes/a.yaml"))
    assert (result.status, result.out.splitlines()[0]) == (0, "valid: 1 file, 2 configurations")
    names = [str(conf.path / name) for name in ("modes/broken.yaml", "cameras/compact_480p.yaml")]
    assert [problem.split(": ")[0] for problem in tod("validate", *names).problems] == sorted(names)


def test_a_file_is_found_from_inside_its_folder(tod: Command, conf: UserConf, monkeypatch: pytest.MonkeyPatch) -> None:
    conf.write("modes/a.yaml", "defaults: [paper, _self_]\n")
    monkeypatch.chdir(conf.path / "modes")
    result = tod("validate", "a.yaml")
    assert (result.status, result.out.splitlines()[0]) == (0, "valid: 1 file, 1 configuration")


def test_a_file_that_the_command_line_chooses_is_checked(tod: Command, conf: UserConf) -> None:
    van = "# @package _global_\ndefaults: [/cameras@cameras.front: missing, _self_]\nname: van\n"
    conf.write("vehicle/van.yaml", van).write("modes/mine.yaml", "defaults: [paper, _self_]\n")
    file = str(conf.path / "vehicle/van.yaml")
    for words in ([], ["vehicle=van"], ["modes=mine", "vehicle=van"]):
        assert [p.split(": ")[0] for p in tod("validate", file, *words).problems] == [file]
    conf.write("cameras/mine.yaml", "defaults: [compact_480p, _self_]\n")
    result = tod(
        "validate", str(conf.path / "cameras/mine.yaml"), "vehicle=delivery_robot", "cameras@cameras.rear=mine"
    )
    assert (result.status, result.out.splitlines()[0]) == (0, "valid: 1 file, 2 configurations")
    result = tod("validate", str(conf.path / "modes/mine.yaml"), "modes=mine", "modes.single.0=null")
    assert result.status == 2


def test_files_of_two_directories(tod: Command, conf: UserConf) -> None:
    for name in ("one", "two"):
        conf.write(f"{name}/modes/a.yaml", "defaults: [paper, _self_]\n")
    result = tod("validate", *(str(conf.path / name / "modes/a.yaml") for name in ("one", "two")))
    assert (result.status, result.out.splitlines()[0]) == (0, "valid: 2 files, 2 configurations")


@pytest.mark.parametrize(
    "word, expected",
    [
        ("{}/modes/b.yaml", "{}/modes/b.yaml: no such file"),
        ("{}/modes", "{}/modes: must be NAME=VALUE, or a file that ends in .yaml or .yml"),
        ("", "must be NAME=VALUE, or a file that ends in .yaml or .yml"),
        (".", ".: must be NAME=VALUE, or a file that ends in .yaml or .yml"),
        ("{}/../x.yaml", "{}/../x.yaml: is in no configuration directory: none above it has vehicle/, cameras/, ..."),
    ],
)
def test_a_word_that_names_no_file_of_a_configuration(tod: Command, conf: UserConf, word: str, expected: str) -> None:
    conf.write("modes/a.yaml", "defaults: [paper, _self_]\n").write("../x.yaml", "a: 1\n")
    result = tod("validate", word.format(conf.path))
    assert (result.status, result.err) == (2, f"command line: {expected.format(conf.path)}\n")


def test_files_in_linked_folders_are_checked_and_loops_are_not_followed(tod: Command, conf: UserConf) -> None:
    shared = conf.path.with_name("shared")
    conf.write("../shared/vehicle/van.yaml", "defaults: [delivery_robot]\nheigth: 1\n").write(
        "../shared/graph/old/mine.yaml", ""
    ).write("config.yaml", "{}\n")
    for name in ("vehicle", "graph"):
        (conf.path / name).symlink_to(shared / name)
    (shared / "vehicle" / "up").symlink_to(conf.path)  # loops: to the directory itself, one of each other, far above
    (shared / "vehicle" / "across").symlink_to(shared / "graph")
    (shared / "graph" / "across").symlink_to(shared / "vehicle")
    (conf.path / "cameras").symlink_to("/")
    found = [line.replace(str(conf.path), "~") for line in tod("validate", conf.word).problems]
    nested = "would be ignored: files must be directly in"
    assert [line for line in found if "van.yaml" in line or "mine.yaml" in line] == [
        f"~/graph/across/van.yaml: {nested} graph/, not in subfolders",
        f"~/graph/old/mine.yaml: {nested} graph/, not in subfolders",
        "~/vehicle/van.yaml: heigth: unknown key; expected one of defaults, name, cameras, uplinks, latency,"
        " dimensions",
        f"~/vehicle/across/old/mine.yaml: {nested} vehicle/, not in subfolders",
    ]
    named = tod("validate", str(conf.path / "vehicle" / "van.yaml")).problems
    assert [line.replace(str(conf.path), "~") for line in named] == [line for line in found if "heigth" in line]
