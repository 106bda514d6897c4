"""Dry run: the JSON contract, text that a shell runs, decisions with reasons."""

from __future__ import annotations

import json
import shlex
import shutil
import subprocess
from typing import Any

import pytest
from helpers import CONF, Command, UserConf, source_for
from omegaconf import OmegaConf

from runner.configuration.config import configuration
from runner.configuration.listing import UNSTATED, listing
from runner.configuration.origin import Composed, Part

pytestmark = pytest.mark.usefixtures("composed_once")

GRAPHS = sorted(path.stem for path in (CONF / "graph").glob("*.yaml"))
SETTING = {"on", "sending", "demand_kbps", "kbps", "scaling", "roi", "width", "height", "reason"}


def printed(tod: Command, *words: str) -> dict[str, Any]:
    result = tod("print", "format=json", *words)
    assert result.status == 0, result.err
    document: dict[str, Any] = json.loads(result.out)
    return document


def test_the_json_contract(tod: Command) -> None:
    document = printed(tod, "source=test", "total_kbps=3000")
    assert list(document) == ["mode", "total_kbps", "cameras"]
    assert (document["mode"], document["total_kbps"]) == ("automatic", 3000)
    assert len(document["cameras"]) == 8
    for camera in document["cameras"].values():
        assert list(camera) == ["vehicle", "operator", "server", "decision"]
        assert set(camera["decision"]) == SETTING
    assert document["cameras"]["front_left"]["decision"] == {
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


@pytest.mark.parametrize(
    "words, decided",
    [
        (["total_kbps=8000"], ("automatic", 8000, 1454)),
        (["total_kbps=8000", "mode=collective"], ("collective", 8000, 1454)),
        (["total_kbps=8000", "mode=single"], ("single", 7997, 1454)),  # what automatic would decide
        ([], ("automatic", 3000, 545)),
        (["mode=single"], ("single", 2995, 545)),
        (["total_kbps=0"], ("automatic", 0, 0)),
        (["total_kbps=2999.5"], ("automatic", 2999.5, 545)),
        (["total_kbps=40000"], ("automatic", 40000, 6000)),
    ],
)
@pytest.mark.parametrize("modes", ["paper", "safe"])
def test_the_decision(tod: Command, modes: str, words: list[str], decided: tuple[str, float, int]) -> None:
    document = printed(tod, "source=test", f"modes={modes}", *words)
    left = document["cameras"]["front_left"]["decision"]
    assert (document["mode"], document["total_kbps"], left["kbps"]) == decided


def test_the_text(tod: Command) -> None:
    document = printed(tod, "source=test", "total_kbps=3000")
    result = tod("print", "source=test", "total_kbps=3000")
    expected = ["# tum_q7, mode automatic, total 3000 kbit/s"]
    for name, camera in document["cameras"].items():
        decision = camera["decision"]
        size = f"{decision['width']}x{decision['height']}"
        expected += ["", f"# {name}: {size} at {decision['kbps']} kbit/s: {decision['reason']}"]
        expected += [f"gst-launch-1.0 {camera['vehicle']}", f"gst-launch-1.0 {camera['operator']}"]
        expected += [f"# server: {camera['server']}"]
    assert (result.status, result.out.splitlines(), result.err) == (0, expected, "")


def test_a_camera_that_is_not_sent_is_marked(tod: Command) -> None:
    lines = tod("print", "source=test", "total_kbps=0").out.splitlines()
    assert "# front_left: not sending: 0 of 6000 kbit/s, range [0, 300) -> 0.125, below 1 kbit/s: not sending" in lines
    vehicle = printed(tod, "source=test", "total_kbps=0")["cameras"]["front_left"]["vehicle"]
    assert "valve name=gate drop-mode=forward-sticky-events drop=true" in vehicle


@pytest.mark.parametrize(
    "graph, source",
    [(graph, source) for graph in GRAPHS for source in sorted({"v4l2", source_for(graph)})]
    + [(graph, "appsrc") for graph in GRAPHS if source_for(graph) == "test"],
)
def test_every_line_is_one_command_of_words(tod: Command, graph: str, source: str) -> None:
    for camera in printed(tod, f"graph={graph}", f"source={source}")["cameras"].values():
        for line in (camera["vehicle"], camera["operator"]):
            words = shlex.split(line)
            assert shlex.join(words).replace("'!'", "!") == line
            assert all(word == "!" or "=" in word or word.replace(".", "_").isidentifier() for word in words)
            assert "{" not in line


@pytest.fixture
def clip(conf: UserConf) -> str:
    """A path that contains everything a shell or Hydra would interpret."""
    name = 'it\'s a "clip" with $HOME, {braces}, a=b & ü.mp4'
    conf.write(name, b"")
    return str(conf.path / name)


def test_quoting_survives_a_shell(tod: Command, conf: UserConf, clip: str) -> None:
    conf.write("source/mine.yaml", f"defaults: [file, _self_]\nclip: {json.dumps(clip)}\n")
    line = printed(tod, "source=mine", conf.word)["cameras"]["front_left"]["vehicle"]
    echoed = subprocess.run(
        ["sh", "-c", f"for word in {line.replace(' ! ', ' ')}; do printf '%s\\n' \"$word\"; done"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert f"location={clip}" in echoed.stdout.splitlines()
    assert shlex.split(line)[:3] == ["filesrc", "name=file", f"location={clip}"]


@pytest.mark.gst
@pytest.mark.skipif(not shutil.which("gst-launch-1.0"), reason="gst-launch-1.0 is not installed")
def test_gstreamer_reads_the_server_string_as_the_shell_reads_the_line(tod: Command, conf: UserConf, clip: str) -> None:
    gst = pytest.importorskip("gi.repository.Gst")
    gst.init(None)
    conf.write("source/mine.yaml", f"defaults: [file, _self_]\nclip: {json.dumps(clip)}\n")
    server = printed(tod, "source=mine", conf.word)["cameras"]["front_left"]["server"]
    description = server.removeprefix("( ").removesuffix(" )")
    assert gst.parse_launch(description).get_by_name("file").get_property("location") == clip


def test_a_stand_in_for_frames_generated_in_python_is_reported(tod: Command) -> None:
    names = "front_left, front_center, front_right, rear_center, top_front, top_left, top_right, top_rear"
    note = f"videotestsrc stands in for the frames of {names}"
    result = tod("print", "source=appsrc", "format=json")
    camera = json.loads(result.out)["cameras"]["front_left"]
    assert result.err.strip() == note
    assert camera["vehicle"].startswith("videotestsrc ")
    assert camera["server"].startswith("( appsrc ")
    assert f"# {note}" in tod("print", "source=appsrc").out.splitlines()


def test_the_default_source_has_a_stand_in_until_it_is_rendered(tod: Command) -> None:
    camera = printed(tod)["cameras"]["front_left"]
    assert camera["vehicle"].startswith("videotestsrc ")


def test_a_transport_without_a_server(tod: Command) -> None:
    camera = printed(tod, "source=test", "graph=h264_srt")["cameras"]["front_center"]
    assert camera["server"] is None
    assert "srtsink" in camera["vehicle"] and "7101" in camera["vehicle"]
    assert camera["operator"].startswith("srtsrc ") and "7101" in camera["operator"]
    assert "# server:" not in tod("print", "source=test", "graph=h264_srt").out


@pytest.mark.parametrize(
    "word, expected",
    [
        ("total_kbps=many", "command line: total_kbps: 'many': must be a number of 0 or more"),
        ("total_kbps=-1", "command line: total_kbps: '-1': must be a number of 0 or more"),
        ("total_kbps=nan", "command line: total_kbps: 'nan': must be a number of 0 or more"),
        ("total_kbps=inf", "command line: total_kbps: 'inf': must be a number of 0 or more"),
        ("total_kbps=", "command line: total_kbps: '': must not be empty"),
        ("format=xml", "command line: format: 'xml': must be one of text, json, yaml"),
        ("conf=/nowhere", "command line: conf: /nowhere: no such directory"),
    ],
)
def test_wrong_arguments(tod: Command, word: str, expected: str) -> None:
    assert tod("print", "source=test", word) == (2, "", f"{expected}\n")


# --- format=yaml ------------------------------------------------------------------------------------------------------

MOUNTS = ("+graph@cameras.front.graph=h264_srt", "+source@cameras.rear.source=v4l2")


@pytest.mark.parametrize(
    "words",
    [
        (
            "graph=openh264_rtsp",
            "modes=steady",
            "cameras.front_left.rate_quality.b_min_kbps=[0,1,2]",
            "log={video: true}",
        ),
        ("vehicle=delivery_robot", *MOUNTS, "~cameras.mast", "modes.automatic.follow_link.reserve_kbps=7"),
        ("experiment=bottleneck", "link=relay", "study=paper", "pqos=trace"),
        ("vehicle=delivery_robot", "graph=h264_jetson_rtsp", "latency={fixed_ms: 1e1}", "fps_max=12.5"),
    ],
)
def test_yaml_loads_as_the_configuration_and_every_value_has_an_origin(tod: Command, words: tuple[str, ...]) -> None:
    status, out, err = tod("print", "source=test", "format=yaml", *words)
    assert (status, err) == (0, "")
    assert OmegaConf.to_container(OmegaConf.create(out)) == configuration(["source=test", *words]).document
    assert UNSTATED not in out


def test_yaml_names_the_file_or_the_override_of_each_value(tod: Command, conf: UserConf) -> None:
    conf.write("cameras/own.yaml", "defaults: [compact_480p, _self_]\nfps: 12\n")
    mounts = "defaults: [{/cameras@cameras.a: own}, {/cameras@cameras.b: own}, _self_]\n"
    cameras = 'cameras: {a: {weight: 2}, b: {device: "/dev/${name}"}}\n'
    conf.write("vehicle/van.yaml", f"# @package _global_\n{mounts}name: van\n{cameras}")
    words = ("vehicle=van", "source=test", "cameras.b.fps=9", "+cameras.a.place={row: 0, column: 0}")
    out = tod("print", conf.word, *words, "format=yaml").out
    own, van, kind = (conf.path / "cameras/own.yaml", conf.path / "vehicle/van.yaml", "conf/cameras/compact_480p.yaml")
    expected = f"""\
cameras:
  a:
    width_px: 848  # {kind}
    height_px: 480  # {kind}
    fps: 12  # {own}
    fov_deg: 78  # {kind}
    rate_quality: {{scaling: [0.25, 0.5, 1.0], b_min_kbps: [0, 120, 500], b_full_kbps: 1500}}  # {kind}
    weight: 2  # {van}
    place: {{row: 0, column: 0}}  # command line: +cameras.a.place={{row: 0, column: 0}}
  b:
    width_px: 848  # {kind}
    height_px: 480  # {kind}
    fps: 9  # command line: cameras.b.fps=9
    fov_deg: 78  # {kind}
    rate_quality: {{scaling: [0.25, 0.5, 1.0], b_min_kbps: [0, 120, 500], b_full_kbps: 1500}}  # {kind}
    device: /dev/van  # {van}
"""
    assert sorted(out[out.index("cameras:") : out.index("\nname: ")].splitlines()) == sorted(expected.splitlines())
    assert f"\nname: van  # {van}\n" in out


def test_yaml_does_not_guess_where_the_order_of_files_is_unusual(tod: Command, conf: UserConf) -> None:
    """A vehicle that lets the kind of camera win: the value, not the usual order, determines the file."""
    text = "# @package _global_\ndefaults: [_self_, {/cameras@cameras.a: compact_480p}]\nname: van\n"
    conf.write("vehicle/van.yaml", f"{text}cameras: {{a: {{fps: 99, weight: 2}}}}\n")
    out = tod("print", conf.word, "vehicle=van", "source=test", "format=yaml").out
    assert "\n    fps: 30  # conf/cameras/compact_480p.yaml\n" in out
    assert f"\n    weight: 2  # {conf.path}/vehicle/van.yaml\n" in out


@pytest.mark.parametrize("text", ["on", "1e3", "a\nb", "x\n", "# no comment", " a", "{b}", "é", "null", "0x1", "a: b"])
def test_yaml_writes_text_as_omegaconf_reads_it(text: str) -> None:
    document = {"a": text, "b": [text], text: 1}
    written = listing(Composed(document, [Part("file", (), document)]))
    assert OmegaConf.to_container(OmegaConf.create(written)) == document
    assert len(written.splitlines()) == 3


def test_yaml_is_of_a_valid_configuration_and_decides_nothing(tod: Command) -> None:
    assert tod("print", "format=yaml", "total_kbps=3").err == (
        "command line: total_kbps: has no effect with format=yaml\n"
    )
    assert tod("print", "format=yaml", "fps_max=0").problems == ["command line: fps_max: 0: must be above 0"]


X265 = """
defaults: [h264_rtsp, _self_]
encoder:
  - {name: encoder, element: x265enc, properties: {tune: zerolatency, speed-preset: ultrafast, MORE}}
PARSE
sender:
  - {name: sent, element: identity}
  - {name: pay0, element: rtph265pay, properties: {pt: 96, mtu: "{mtu_bytes}", config-interval: -1}}
operator:
  - ${..receiver}
  - {name: depay, element: rtph265depay}
  - {name: received, element: identity}
  - {name: decoder, element: avdec_h265}
  - {name: sink, element: fakesink}
wire:
  operator: [{name: wire, element: udpsrc, properties: {caps: "application/x-rtp,encoding-name=H265"}}]
knobs:
  bitrate: [{element: encoder, property: bitrate, value: kbps}]
"""
LACKS = (
    "graph.vehicle: x265enc ! identity ! rtph265pay: later key pictures lack parameter sets,"
    " who joins later sees nothing; h265parse with config-interval: -1 in front of pay0 adds them"
)


@pytest.mark.gst
@pytest.mark.parametrize(
    ("more", "parse", "lacks"),
    [
        ("key-int-max: 30", "", True),
        ('option-string: "repeat-headers=1"', "", False),
        ("key-int-max: 30", "  - {name: parse, element: h265parse, properties: {config-interval: -1}}", False),
    ],
)
def test_a_graph_whose_later_key_pictures_lack_parameter_sets_is_reported(
    tod: Command, conf: UserConf, more: str, parse: str, lacks: bool
) -> None:
    """x265's are CRA pictures, in front of which rtph265pay repeats none until GStreamer 1.28."""
    gst = pytest.importorskip("runner.gst").Gst
    for element in ("x265enc", "avdec_h265"):
        if gst.ElementFactory.find(element) is None:
            pytest.skip(f"needs {element}")
    conf.write("graph/h265.yaml", X265.replace("MORE", more).replace("PARSE", parse))
    words = (conf.word, "vehicle=delivery_robot", "source=test", "graph=h265")
    for verb in ("print", "validate"):
        result = tod(verb, *words)
        assert result.status == 0, result.err
        said = {"print": f"front: {LACKS}", "validate": LACKS}[verb]
        assert (said in (result.err + result.out).splitlines()) is (lacks and gst.version() < (1, 28))
