"""The vehicle's sound: its configuration and pipelines as text, and its part of the total."""

from __future__ import annotations

import json
from argparse import Namespace
from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest
from helpers import Command, Drive, UserConf
from msgspec import UNSET, UnsetType

from runner.configuration.config import configuration
from runner.core.budget import sound_kbps
from runner.core.events import parse
from runner.core.model import Mode
from runner.core.step import step
from runner.operator.notes import change_notes
from runner.operator.sound import UNEXPLAINED, sound_sample, sound_words
from runner.plans import sound_plan
from runner.records.vehicle import SoundState, VehicleState
from runner.system.clocks import ClockDifference

WIRE = Fraction("50.4")  # 60 bytes of Opus and 66 of headers, 50 times a second


# --- configuration ----------------------------------------------------------------------------------------------------


def test_without_sound_there_is_none() -> None:
    config = configuration([])
    assert "sound" not in config.document
    assert sound_plan(config.setup()) is None
    assert config.vehicle().sound == 0


@pytest.mark.parametrize(
    ("packet_ms", "kbps"), [(10, Fraction("76.8")), (20, WIRE), (40, Fraction("37.2")), (60, Fraction("32.8"))]
)
def test_headers_count(packet_ms: int, kbps: Fraction) -> None:
    assert sound_kbps(24, packet_ms, 66) == kbps
    assert configuration(["sound=test", f"sound.packet_ms={packet_ms}"]).vehicle().sound == kbps


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["sound.kbps=24.5"], "command line: sound.kbps: 24.5: must be a whole number"),
        (["sound.packet_ms=30"], "command line: sound.packet_ms: 30: must be one of 10, 20, 40, 60"),
        (["sound.dscpp=1"], "command line: sound.dscpp: unknown key, did you mean dscp?"),
        (
            ["sound.vehicle.4.properties.bitrat=1"],
            "command line: sound.vehicle[4].properties.bitrat: 1: opusenc has no such property, did you mean bitrate?",
        ),
        (
            ["sound.source.0.name=sent"],
            "conf/sound/alsa.yaml: vehicle[5].name: 'sent': is already the name of another element",
        ),
    ],
)
@pytest.mark.gst
def test_mistakes_are_named(tod: Command, words: list[str], problem: str) -> None:
    (found,) = tod("validate", "sound=test", *words).problems
    assert found.partition(";")[0] == problem


def test_a_camera_may_have_the_name_only_without_sound(tod: Command, conf: UserConf) -> None:
    mounted = "defaults:\n  - /cameras@cameras.sound: front_center\n"
    conf.write("vehicle/car.yaml", f"# @package _global_\nname: car\n{mounted}")
    assert tod("validate", conf.word, "vehicle=car").status == 0
    (found,) = tod("validate", conf.word, "vehicle=car", "sound=test").problems
    assert "is the name of the vehicle's sound; give this camera another one" in found


def test_a_file_must_exist(tod: Command, tmp_path: Path) -> None:
    missing = tmp_path / "siren.wav"
    (found,) = tod("print", "sound=file").problems
    assert found == "conf/sound/file.yaml: clip: null: must be given: the file that is played"
    (found,) = tod("print", "sound=file", f"sound.clip={missing}").problems
    assert found == f"command line: sound.clip: '{missing}': no such file"


# --- what is printed --------------------------------------------------------------------------------------------------


def test_print_shows_both_sides(tod: Command) -> None:
    printed = json.loads(tod("print", "sound=alsa", "source=test", "format=json").out)["sound"]
    assert printed["kbps_on_the_wire"] == 50.4
    assert printed["vehicle"].startswith("alsasrc name=source device=default provide-clock=false")
    assert "opusenc name=encoder bitrate=24000 bitrate-type=cbr frame-size=20" in printed["vehicle"]
    assert "rtpjitterbuffer name=jitterbuffer latency=40 do-lost=true" in printed["operator"]
    text = tod("print", "sound=alsa", "source=test").out.splitlines()
    assert "# sound: 50.4 kbit/s on the wire, taken from the total" in text
    assert f"gst-launch-1.0 {printed['operator']}" in text


def test_without_a_device_its_element_chooses(tod: Command) -> None:
    assert "pulsesrc name=source provide-clock" in tod("print", "sound=pulse", "source=test").out


# --- its part of the total --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("modes", ["paper", "safe"])
def test_cameras_share_what_sound_leaves(modes: str) -> None:
    drive = Drive(f"modes={modes}", "sound=test")
    drive.accept("bitrate_predicted", kbps=3000)
    assert drive.total == 3000 - WIRE
    assert drive.run.decision.asked == 3000
    assert "total 3000 -> 2949.6: sound takes 50.4" in drive["front_left"].reason
    drive.accept("copies_counted", copies={"sound": 2})
    assert drive.total == 3000 - 2 * WIRE


def test_it_takes_no_more_than_there_is() -> None:
    drive = Drive("modes=paper", "sound=test")
    drive.accept("bitrate_predicted", kbps=20)
    assert drive.total == 0
    assert not any(setting.sending for setting in drive.run.decision.settings.values())


def test_each_of_several_uplinks_carries_it() -> None:
    drive = Drive("modes=safe", "sound=test", "uplinks={a: {address: 10.0.0.1}, b: {address: 10.0.0.2}}")
    drive.accept("bitrate_predicted", kbps=3000)
    assert drive.total == 3000 - 2 * WIRE


def test_what_the_operator_sets_for_cameras_is_theirs() -> None:
    drive = Drive("modes=paper", "sound=test")
    drive.accept("bitrate_predicted", kbps=3000)
    before = {name: drive.sent(name) for name in drive.vehicle.cameras}
    drive.accept("mode_selected", mode="single")
    assert {name: drive.sent(name) for name in drive.vehicle.cameras} == before


def test_entering_collective_keeps_the_total_again_and_again() -> None:
    drive = Drive("modes=paper", "sound=test")
    drive.accept("bitrate_predicted", kbps=3000)
    for mode in ("collective", "automatic", "collective"):
        drive.accept("mode_selected", mode=mode)
        assert drive.total == 3000 - WIRE
    drive.accept("total_set", kbps=1000)
    assert (drive.total, drive.run.decision.asked) == (1000 - WIRE, 1000)


def test_reports_are_of_cameras_alone() -> None:
    """What the operator's side measures is what sound has left to them: it is not taken off again."""
    drive = Drive("modes=safe", "sound=test")
    drive.accept("operator_connected", t=1.0)
    for t in range(2, 30):
        total = drive.reports(float(t), 2000)
    other = Drive("modes=safe")
    other.accept("operator_connected", t=1.0)
    for t in range(2, 30):
        same = other.reports(float(t), 2000)
    assert total == pytest.approx(float(same), rel=0.01)


def test_without_sound_no_copies_of_it_are_known() -> None:
    drive = Drive("modes=paper")
    event = parse({"t": 0, "event": "copies_counted", "copies": {"sound": 2}})
    assert step(drive.vehicle, drive.run, event).refused


# --- what the operator reads ------------------------------------------------------------------------------------------


def stated(**keys: Any) -> VehicleState:
    return VehicleState(1.0, "", Mode.AUTOMATIC, 0, 0, {}, **keys)


RECEIVED = Namespace(
    packets=100, bytes=6000, lost=3, level_db=-15.04, latency_ms=52.26, foreign=0, rebuilt=1, refused=False
)
CLOCK = ClockDifference(ahead_s=-0.006, bound_s=0.001)


@pytest.mark.parametrize(
    ("received", "sound", "words"),
    [
        ({}, SoundState(), "sound: 46 ms old, -15 dB, 3 packets lost"),
        ({"level_db": None}, SoundState(), "sound: nothing arrives"),
        ({"level_db": None}, SoundState("no such device"), "sound: no such device"),
        (
            {"refused": True},
            SoundState(refused={"anna": "one viewer per camera"}),
            "sound: refused by the vehicle: one viewer per camera",
        ),
        ({"refused": True}, SoundState(), f"sound: refused by the vehicle: {UNEXPLAINED}"),
        ({"latency_ms": None}, SoundState(), "sound: age unknown, -15 dB, 3 packets lost"),
    ],
)
def test_the_table_has_a_line_for_it(received: dict[str, Any], sound: SoundState, words: str) -> None:
    sample = sound_sample(Namespace(**{**vars(RECEIVED), **received}), stated(sound=sound), CLOCK, "anna")
    assert not isinstance(sample, UnsetType)
    assert sound_words(sample) == words


def test_a_side_without_sound_states_none() -> None:
    assert sound_sample(None, stated(), CLOCK, "anna") is UNSET


def test_a_lost_source_is_noted_once() -> None:
    works, lost = stated(sound=SoundState()), stated(sound=SoundState("no such device"))
    assert list(change_notes(works, lost)) == ["sound lost: no such device"]
    assert list(change_notes(lost, lost)) == []
    assert list(change_notes(lost, works)) == ["sound found again"]
    assert list(change_notes(stated(), works)) == []
