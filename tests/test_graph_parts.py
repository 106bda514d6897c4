"""Graphs that build on each other: one part replaced, the rest inherited, problems reported with their file."""

from __future__ import annotations

import pytest
from helpers import CONF, Command, UserConf

from runner.configuration.compose import compose
from runner.configuration.config import configuration
from runner.core.model import Graph

BASED = sorted(path.stem for path in (CONF / "graph").glob("*.yaml") if path.stem != "h264_rtsp")
BASES = {  # others build on h264_rtsp
    **dict.fromkeys(("h265_va_rtsp", "h265_nvenc_rtsp", "pass_through_h265"), "h265_rtsp"),
    "pass_through_v4l2": "pass_through",
}
OPEN = "defaults: [h264_rtsp, _self_]\nencoder:\n"
ENCODER = "  - {name: encoder, element: openh264enc, properties: {complexity: low}}\n"
WHOLE = "[{name: gate, element: valve}, {name: crop, element: videocrop}, {name: size, element: capsfilter}, "
UNUSED = "encoder: is unused; include it in vehicle as ${..encoder}"


def graph(conf: UserConf, *words: str, camera: str = "front_left") -> Graph:
    return configuration(["source=test", *words], conf.path, runnable=False).vehicle().cameras[camera].graph


def names(graph: Graph) -> str:
    return " ".join(element.name for element in graph.vehicle)


def test_packaged_graphs_state_only_what_differs() -> None:
    for name in BASED:
        every = (CONF / f"graph/{name}.yaml").read_text().splitlines()
        lines = [line for line in every if not line.lstrip().startswith("#")]
        # Another format has elements of its own at both ends, another codec on the wire, too.
        assert len(lines) <= (36 if name == "h265_rtsp" else 26), name
        assert f"defaults: [{BASES.get(name, 'h264_rtsp')}, _self_]" in lines


def test_an_encoder_is_replaced_alone(conf: UserConf) -> None:
    conf.write("graph/mine.yaml", OPEN + ENCODER + "  - {name: parse, element: h264parse}\n")
    mine = graph(conf, "graph=mine")
    assert names(mine) == "gate crop scaler size encoder parse sent pay0"
    assert mine.vehicle[4].properties == {"complexity": "low"}  # and none of x264enc's


@pytest.mark.parametrize("camera, factory", [("front_left", "openh264enc"), ("front_right", "x264enc")])
def test_a_mounted_graph_builds_on_another_too(conf: UserConf, camera: str, factory: str) -> None:
    mine = graph(conf, "+graph@cameras.front_left.graph=openh264_rtsp", camera=camera)
    assert mine.vehicle[4].factory == factory


def test_a_mount_may_refer_to_the_graph_of_all(conf: UserConf) -> None:
    mine = graph(conf, "graph=openh264_rtsp", "cameras.front_left.graph=${graph}")
    assert mine.vehicle[4].factory == "openh264enc"


def test_the_command_line_changes_a_part(conf: UserConf) -> None:
    assert graph(conf, "graph.encoder.0.properties.quantizer=20").vehicle[4].properties["quantizer"] == 20


@pytest.mark.parametrize(
    "words, properties",
    [
        ((), "tune=zerolatency speed-preset=superfast option-string=repeat-headers=0 intra-refresh"),
        (("graph.effort=high",), "tune=zerolatency speed-preset=veryfast option-string=repeat-headers=0 intra-refresh"),
        (
            ("graph=h264_srt", "graph.effort=lowest"),
            "speed-preset=ultrafast option-string=repeat-headers=0:cabac=1:8x8dct=1:deblock=0,0 intra-refresh",
        ),
        (
            ("graph.effort=low", "graph.efforts.low.preset=faster"),
            "speed-preset=faster option-string",
        ),
    ],
)
def test_an_effort_sets_properties_of_the_encoder(tod: Command, words: tuple[str, ...], properties: str) -> None:
    out = tod("print", "source=test", "vehicle=delivery_robot", *words).out
    assert out.count(properties) == out.count("x264enc") > 0


@pytest.mark.parametrize(
    "words, problem",
    [
        (("graph.effort=most",), "'most': must be one of lowest, low, medium, high, exact, did you mean lowest?"),
        (
            ("graph.effort=high", "~graph.efforts.high"),
            "high: must be one of lowest, low, medium, exact, which this graph's encoder supports",
        ),
        (("graph=openh264_rtsp", "graph.effort=low"), "low: must be medium, which this graph's encoder supports"),
    ],
)
def test_an_effort_that_the_encoder_lacks_is_rejected(tod: Command, words: tuple[str, ...], problem: str) -> None:
    assert tod("print", "source=test", *words).problems == [f"command line: graph.effort: {problem}"]


def test_a_whole_list_replaces_the_list_with_its_parts(conf: UserConf) -> None:
    text = f"defaults: [openh264_rtsp, _self_]\nvehicle: {WHOLE}"
    conf.write("graph/mine.yaml", text + "{name: encoder, element: x264enc}, {name: pay0, element: rtph264pay}]\n")
    assert [element.factory for element in graph(conf, "graph=mine").vehicle][3:] == ["x264enc", "rtph264pay"]


def test_the_composed_graph_is_whole_lists() -> None:
    document = compose(["graph=h264_srt", "+graph@cameras.front_left.graph=openh264_rtsp"]).document
    for composed in (document["graph"], document["cameras"]["front_left"]["graph"]):
        assert not {"encoder", "sender", "receiver"} & set(composed)
        assert all(isinstance(entry, dict) for side in ("vehicle", "operator") for entry in composed[side])


@pytest.mark.slow
@pytest.mark.parametrize(
    "text, problem",
    [
        (
            OPEN + "  - {name: encoder, elemnt: openh264enc}\n",
            "encoder[0].elemnt: unknown key, did you mean element?",
        ),
        (
            OPEN + ENCODER.replace("low", '"{lowest}"'),
            "encoder[0].properties.complexity: '{lowest}': ",
        ),
        (OPEN + ENCODER + ENCODER, "encoder[1].name: 'encoder': is already the name of another element"),
        (OPEN.replace("encoder", "encodr") + ENCODER, "encodr: unknown key, did you mean encoder?"),
        (
            OPEN + ENCODER + "vehicle: [encoder]\n",
            "vehicle[0]: 'encoder': must be a mapping",
        ),
        (
            "defaults: [h264_rtsp, _self_]\nsender:\n  - {name: sent, element: identity}\n",
            "sender[0].name: 'sent'",  # as the other value of a rule about the list that includes it
        ),
    ],
)
@pytest.mark.parametrize("word", ["graph=mine", "+graph@cameras.front_left.graph=mine"])
def test_a_problem_names_the_part_and_its_file(
    conf: UserConf, tod: Command, text: str, problem: str, word: str
) -> None:
    conf.write("graph/mine.yaml", text)
    found = [line.partition("/graph/mine.yaml: ")[2] for line in tod("print", "source=test", word, conf.word).problems]
    assert any(line.startswith(problem) for line in found), found


@pytest.mark.parametrize(
    "old, new, path",
    [
        ("name: depay", "name: client", "operator[1].name"),
        ('"{mtu_bytes}"', '"{mtu}"', "sender[1].properties.mtu"),
        ("threads: 1", "threads: '{many}'", "encoder[0].properties.threads"),
    ],
)
def test_a_path_is_the_one_in_the_file(conf: UserConf, tod: Command, old: str, new: str, path: str) -> None:
    conf.change("graph/h264_rtsp.yaml", {old: new})
    found = {tuple(line.split(": ")[:2]) for line in tod("print", "source=test", conf.word).problems}
    assert found == {(f"{conf.path}/graph/h264_rtsp.yaml", path)}


def test_a_part_that_no_list_includes_is_rejected(conf: UserConf, tod: Command) -> None:
    conf.change("graph/h264_rtsp.yaml", {"  - ${..encoder}\n": ENCODER})
    # The packaged graph defines an encoder that the user's list would silently ignore.
    assert tod("print", "source=test", "graph=openh264_rtsp", conf.word).problems == [
        f"conf/graph/openh264_rtsp.yaml: {UNUSED}"
    ]


def test_an_override_of_a_part_by_its_number_names_the_command_line(tod: Command) -> None:
    assert tod("print", "graph.vehicle.4.properties.threads=2").problems == [
        "command line: graph.vehicle[4].name: missing: must be given",
        "command line: graph.vehicle[4].element: missing: must be given",
    ]
