"""Plans checked against registries of other machines; what comes with the package needs no GStreamer here."""

from __future__ import annotations

import importlib.util
import lzma
import os
from pathlib import Path

import pytest
from helpers import Command, UserConf, process

from runner.elements.description import EnumValue, Property
from runner.elements.dump import targets
from runner.elements.values import value_problem

TARGETS = ("gstreamer-1.22", "gstreamer-1.26", "gstreamer-1.28")
ONE = ("graph=h264_rtsp", "source=test", "vehicle=delivery_robot")
GRAPH = "~/graph/h264_rtsp.yaml"


def problems(tod: Command, conf: UserConf, target: str, *words: str) -> list[str]:
    found = tod("validate", conf.word, *ONE, f"target={target}", *words).problems
    return [problem.replace(str(conf.path), "~") for problem in found]


def test_the_registries_that_come_with_the_package() -> None:
    assert tuple(targets()) == TARGETS


@pytest.mark.parametrize("target", TARGETS)
def test_the_packaged_files_fit_each_of_them(tod: Command, target: str) -> None:
    for graph in ("h264_srt", "openh264_rtsp", "h264_rkmpp_rtsp"):
        done = tod("validate", f"target={target}", f"graph={graph}", *ONE[1:])
        assert done.status == 0, done.err
        assert f"checked against {target}: GStreamer {target.removeprefix('gstreamer-')}." in done.out
    missing = "not checked: the GStreamer element mpph264enc is not in "
    assert f"{missing}{target}; on Debian: apt-get install gstreamer1.0-rockchip1" in done.out


@pytest.mark.parametrize("target", TARGETS)
def test_mistakes_are_found_as_on_that_machine(tod: Command, conf: UserConf, target: str) -> None:
    changes = {
        "quantizer: 10": "quantizer: 100",
        "medium: {preset: superfast": "medium: {preset: superfst",
        "intra-refresh: true": "intra-refresh: maybe",
        "threads: 1 ": "treads: 1 ",
        "name: depay, element: rtph264depay": "name: depay, element: rtph264depai",
    }
    conf.change("graph/h264_rtsp.yaml", changes)
    presets = "None, ultrafast, superfast, veryfast, faster, fast, medium, slow, slower, veryslow, placebo"
    where = f"{GRAPH}: encoder[0].properties"
    found = problems(tod, conf, target)
    assert set(found) >= {
        f"{where}.speed-preset: 'superfst': must be one of {presets}",
        f"{where}.intra-refresh: 'maybe': must be a boolean",
        f"{where}.quantizer: 100: must be from 0 to 50",
        f"{where}.treads: 1: x264enc has no such property, did you mean threads?",
        f"{GRAPH}: operator[1].element: 'rtph264depai': unknown element in {target}, did you mean rtph264depay?",
    }, found


@pytest.mark.parametrize("target", TARGETS)
def test_links_and_knobs(tod: Command, conf: UserConf, target: str) -> None:
    conf.change("graph/h264_rtsp.yaml", {"element: rtph264pay": "element: rtph265pay"})
    (found,) = problems(tod, conf, target)
    message = "could not link sent to pay0: x264enc gives video/x-h264, rtph265pay takes video/x-h265; in place of"
    assert f"{message} rtph265pay: " in found
    assert "rtph264pay" in found.partition("rtph265pay: ")[2]
    conf.change("graph/h264_rtsp.yaml", {"property: bitrate, value: kbps": "property: threads, value: kbps"})
    assert problems(tod, conf, target) == [
        f"{GRAPH}: knobs.bitrate[0].property: 'threads': x264enc does not declare threads as mutable while playing; "
        "if it is, list it under mutable"
    ]


def test_what_only_a_newer_version_has(tod: Command, conf: UserConf) -> None:
    conf.change("graph/h264_rtsp.yaml", {"threads: 1 ": "nal-hrd: cbr\n      threads: 1 "})
    (found,) = problems(tod, conf, "gstreamer-1.22")
    assert found.startswith(f"{GRAPH}: encoder[0].properties.nal-hrd: 'cbr': x264enc has no such property")
    assert tod("validate", conf.word, *ONE, "target=gstreamer-1.28").status == 0


def test_an_element_that_only_the_vehicle_has(tod: Command, conf: UserConf) -> None:
    conf.write("source/csi.yaml", "elements: [{name: sensor, element: nvarguscamerasrc, properties: {sensor-id: 0}}]\n")
    (found,) = problems(tod, conf, "gstreamer-1.28", "source=csi")
    rule = (
        "unknown element in gstreamer-1.28; if only the vehicle has it, `needs` beside the elements names its package"
    )
    assert found == f"~/source/csi.yaml: elements[0].element: 'nvarguscamerasrc': {rule}"
    with (conf.path / "source/csi.yaml").open("a") as file:
        file.write("needs: {nvarguscamerasrc: nvidia-l4t-camera}\n")
    words = ("graph=h264_rtsp", "source=csi", "vehicle=delivery_robot")
    done = tod("validate", conf.word, *words, "target=gstreamer-1.28")
    note = "not checked: the GStreamer element nvarguscamerasrc is not in gstreamer-1.28; on Debian: apt-get install"
    assert (done.status, f"{note} nvidia-l4t-camera" in done.out) == (0, True), done
    if importlib.util.find_spec("gi"):
        doctor = tod("doctor", "vehicle", conf.word, *words)
        missing = "MISSING the GStreamer element nvarguscamerasrc is not installed; on Debian: apt-get install"
        assert (doctor.status, f"{missing} nvidia-l4t-camera" in doctor.out) == (1, True), doctor


@pytest.mark.parametrize(
    "content, expected",
    [
        (None, "must be one of gstreamer-1.22, gstreamer-1.26, gstreamer-1.28, or a file that `tod-runner doctor"),
        (b"x", "or a file that `tod-runner doctor registry=FILE` wrote: Input format not supported by decoder"),
        (
            lzma.compress(b"[]"),
            "or a file that `tod-runner doctor registry=FILE` wrote: Expected `object`, got `array`",
        ),
    ],
)
def test_a_target_that_is_none(tod: Command, tmp_path: Path, content: bytes | None, expected: str) -> None:
    if content is not None:
        (tmp_path / "van").write_bytes(content)
    done = tod("validate", f"target={tmp_path}/van")
    assert (done.status, done.err.count("\n")) == (2, 1)
    assert done.err.startswith(f"command line: target: {tmp_path}/van: must be one of")
    assert expected in done.err


NUMBER, REAL = Property("gint", -5, 20), Property("gdouble", 0.0, 1.0)
TUNE = Property("T", flags=(EnumValue("fast", 1, "Fast decode"), EnumValue("zero", 4, "Zero latency")))


@pytest.mark.parametrize(
    "kind, value, expected",
    [
        (NUMBER, "0x10", None),
        (NUMBER, "012", None),
        (NUMBER, "-6", "must be from -5 to 20"),
        (NUMBER, "max", None),
        (NUMBER, 1.5, "must be a int"),
        (NUMBER, True, "must be a int"),
        (REAL, "1e-3", None),
        (REAL, 1.5, "must be from 0.0 to 1.0"),
        (TUNE, "fast+4", None),
        (TUNE, "Zero latency", None),
        (TUNE, "fast+slow", "must be one of fast, zero"),
        (Property("E", enum=TUNE.flags), "4", None),
        (Property("E", enum=TUNE.flags), "3", "must be one of fast, zero"),
        (Property("gboolean"), "yes", None),
        (Property("GstFraction"), "1/0", "must be a GstFraction"),
        (Property("GstCaps"), "x", "must be a GstCaps"),
        (Property("gchararray"), "anything", None),
    ],
)
def test_values(kind: Property, value: str | float | bool, expected: str | None) -> None:
    assert value_problem(kind, value, lambda type_name, text: False) == expected


@pytest.mark.gst
@pytest.mark.skipif(importlib.util.find_spec("gi") is None, reason="PyGObject is not installed")
def test_values_are_read_as_gstreamer_reads_them() -> None:
    from runner.apply import LIVE

    numbers = ("1", "-1", "0x10", "010", "1.5", ".5", "1e3", "abc", "", "true", "No", "min", "MAX", "nan")
    words = ("superfast", "3", "99", "0x1", "zerolatency", "zerolatency+fastdecode", "1+zerolatency", "nil", "")
    for name, kind in LIVE.properties("x264enc").items():
        unbounded = Property(kind.type, enum=kind.enum, flags=kind.flags)
        for text in () if kind.type == "gchararray" else words if kind.enum or kind.flags else numbers:
            ours = value_problem(unbounded, text, LIVE.reads) is None
            assert ours == LIVE.reads(kind.type, text), (name, kind.type, text)


@pytest.mark.gst
@pytest.mark.skipif(importlib.util.find_spec("gi") is None, reason="PyGObject is not installed")
def test_the_registry_of_this_machine_in_a_file(tod: Command, tmp_path: Path) -> None:
    """Of a machine with four of this one's plugins: to load all takes seconds."""
    from runner.apply import LIVE
    from runner.elements.dump import DumpedRegistry, read_dump
    from runner.gst import Gst

    elements = ("capsfilter", "x264enc", "rtspsrc", "rtph264pay")
    plugins = tmp_path / "plugins"
    plugins.mkdir()
    for element in elements:
        file = Path(Gst.ElementFactory.find(element).get_plugin().get_filename())
        (plugins / file.name).symlink_to(file)
    own = {"GST_PLUGIN_SYSTEM_PATH_1_0": str(plugins), "GST_REGISTRY": str(tmp_path / "registry.bin")}
    van = tmp_path / "van.registry"
    done = process("doctor", "print", f"registry={van}", env=os.environ | own)
    assert (done.status, done.out.splitlines()[-1].split(":")[0]) == (0, f"written {van}"), done
    kept = DumpedRegistry("van", read_dump(str(van)), LIVE.reads)
    for element in elements:
        assert kept.find(element) == LIVE.find(element)
        assert kept.properties(element) == LIVE.properties(element)
    payloaders = list(kept.alike("Codec/Payloader/Network/RTP"))
    assert payloaders == [name for name in LIVE.alike("Codec/Payloader/Network/RTP") if name in kept.names()] != []
    checked = tod("validate", f"target={van}", *ONE)
    missing = f"not checked: the GStreamer element videocrop is not in {van}; on Debian: apt-get install"
    assert (checked.status, f"{missing} gstreamer1.0-plugins-good" in checked.out) == (0, True), checked
