"""The operator's voice: its configuration and pipelines as text."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from helpers import Command, UserConf

from runner.configuration.config import configuration
from runner.plans import voice_plan


def test_without_voice_there_is_none() -> None:
    config = configuration([])
    assert "voice" not in config.document
    assert voice_plan(config.setup()) is None


def test_it_takes_nothing_of_the_total() -> None:
    setup = configuration(["voice=alsa"]).setup()
    plan = voice_plan(setup)
    assert plan
    assert plan.wire_kbps == 44
    assert setup.vehicle.sound == 0


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["voice.packet_ms=30"], "command line: voice.packet_ms: 30: must be one of 10, 20, 40, 60"),
        (["voice.jitter_buffer_ms=500"], "command line: voice.jitter_buffer_ms: 500: must be at most 400"),
        (["voice.devise=hw:1"], "command line: voice.devise: unknown key, did you mean device?"),
        (
            ["voice.operator.0.name=mic"],
            "command line: voice.operator[0].name: 'mic': must be microphone, by which it is found",
        ),
        (
            ["voice.loudspeaker.0.properties.devise=1"],
            "command line: voice.loudspeaker[0].properties.devise: 1: pulsesink has no such property, "
            "did you mean device?",
        ),
    ],
)
@pytest.mark.gst
def test_mistakes_are_named(tod: Command, words: list[str], problem: str) -> None:
    (found,) = tod("validate", "voice=pulse", *words).problems
    assert found.partition(";")[0] == problem


def test_a_camera_may_have_the_name_only_without_voice(tod: Command, conf: UserConf) -> None:
    mounted = "defaults:\n  - /cameras@cameras.voice: front_center\n"
    conf.write("vehicle/car.yaml", f"# @package _global_\nname: car\n{mounted}")
    assert tod("validate", conf.word, "vehicle=car").status == 0
    (found,) = tod("validate", conf.word, "vehicle=car", "voice=alsa").problems
    assert "is the name of the operator's voice; give this camera another one" in found


def test_a_file_must_be_named(tod: Command, tmp_path: Path) -> None:
    (found,) = tod("print", "voice=file").problems
    assert found == "conf/voice/file.yaml: file: null: must be given: the file that voice is written to"
    assert f"location={tmp_path}/heard" in tod("print", "voice=file", f"voice.file={tmp_path}/heard").out


def test_print_shows_both_sides(tod: Command) -> None:
    printed = json.loads(tod("print", "voice=pulse", "source=test", "format=json").out)["voice"]
    assert printed["kbps_on_the_wire"] == 44
    assert "opusenc name=encoder bitrate=24000 bitrate-type=cbr frame-size=20" in printed["operator"]
    assert "rtpjitterbuffer name=jitterbuffer latency=60 do-lost=true" in printed["vehicle"]
    assert "pulsesink name=loudspeaker provide-clock=false" in printed["server"]
    text = tod("print", "voice=pulse", "source=test").out.splitlines()
    assert "# voice: 44 kbit/s on the wire, on the downlink, while somebody speaks" in text
    assert f"gst-launch-1.0 {printed['operator']}" in text
