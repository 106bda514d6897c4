"""The vehicle's sound from its source to the operator's side, with real pipelines."""

from __future__ import annotations

import math
import random
import struct
import time
import wave
from collections import Counter
from contextlib import contextmanager
from itertools import pairwise
from statistics import median

import inside
import pytest

from keyed import CONTROLLER, VEHICLE, issue
from rig import free_port, until
from runner.security.keyring import Keyring

pytestmark = pytest.mark.gst
ROBOT = ["vehicle=delivery_robot", "source=test", "fps_max=5"]
HEARD = {"sound": True}
TONE_DB = -15.05  # RMS of a sine of a quarter of full scale
UDP_IP, SRTP_TAG = 28, 10


@contextmanager
def hearing(*words, keyring=None, viewer=None, **handlers):
    """Both sides of the sound. Yields the vehicle's side, the operator's, the reports of both, and the plan."""
    from runner.apply import OperatorSide, VehicleSide, check_machine, check_plan
    from runner.configuration.config import configuration
    from runner.plans import compile_plans, sound_plan

    setup = configuration([*ROBOT, "sound=test", *words, f"media.port={free_port()}"], check=check_plan).setup()
    plans, sound = compile_plans(setup), sound_plan(setup)
    lost, reported = check_machine(plans, sound, strict=False), []

    def report(stream, what):
        reported.append(f"{stream}: {what}")

    side = VehicleSide(plans, setup.media, report, keyring=keyring, lost=lost, sound=sound)
    try:
        operator = OperatorSide(plans, report, sound=sound, keyring=viewer, vehicle=setup.vehicle.name, **handlers)
        try:
            yield side, operator, reported, sound
        finally:
            operator.stop()
    finally:
        side.stop()


def received(operator, sending=HEARD):
    operator.sample(sending)
    return operator.sound


def test_packets_are_as_large_as_the_total_reckons_and_state_when_they_were_captured(monkeypatch):
    sizes, packets = [], []
    inside.losing(monkeypatch, "rtpjitterbuffer", "sink", lambda packet: sizes.append(packet.get_size()), "sound")
    with hearing(on_sound=packets.append) as (side, operator, *_):
        until(lambda: len(packets) > 100)
        began, first = time.monotonic(), len(packets)
        until(lambda: len(packets) >= first + 100)
        assert 1.5 < time.monotonic() - began < 6
        assert received(operator).lost == 0
        until(lambda: received(operator).level_db == pytest.approx(TONE_DB, abs=0.2))
        assert side.read_sound().encoded.bytes == 60 * side.read_sound().encoded.frames
    assert set(sizes) == {60 + 66 - UDP_IP - SRTP_TAG}
    numbers = [packet.number for packet in packets]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    assert {len(packet.data) for packet in packets} == {60}
    ages_ms = [1000 * (packet.arrived - packet.captured) for packet in packets[20:]]
    assert 0 < min(ages_ms) < 60
    steps = [b.captured - a.captured for a, b in pairwise(packets[20:])]
    assert median(steps) == pytest.approx(0.02, abs=0.0005)


def test_with_keys_it_is_encrypted_and_what_is_on_the_wire_counts(monkeypatch, tmp_path):
    keys = issue(tmp_path / "keys")
    vehicle, operator = (Keyring(keys / name) for name in (VEHICLE, CONTROLLER))
    sizes, packets = [], []
    inside.losing(monkeypatch, "udpsrc", "src", lambda packet: sizes.append(packet.get_size()), "sound")
    words = ["sound.packet_ms=40", f"keys={keys / VEHICLE}"]
    with hearing(*words, keyring=vehicle, viewer=operator, on_sound=packets.append):
        until(lambda: len(packets) > 50)
    assert {len(packet.data) for packet in packets} == {120}
    assert Counter(sizes).most_common(1)[0][0] == 120 + 66 - UDP_IP
    assert any(packet.captured for packet in packets)


def test_whoever_comes_hears_nothing_old():
    """The source runs from DESCRIBE on, and sound is sent from PLAY on: what it made in between is dropped."""
    from runner.gst import Gst
    from runner.gst.receiver import capture_time

    captured = []

    def on_packet(_pad, info):
        captured.append(capture_time(info.get_buffer()))
        return Gst.PadProbeReturn.OK

    with hearing(cameras=()) as (*_, sound):
        pipeline = Gst.parse_launch(sound.receiver)
        pipeline.get_by_name("depay").get_static_pad("src").add_probe(Gst.PadProbeType.BUFFER, on_packet)
        try:
            pipeline.set_state(Gst.State.PAUSED)
            until(lambda: is_set_up(pipeline))
            time.sleep(2)
            asked = time.time()
            pipeline.set_state(Gst.State.PLAYING)
            until(lambda: len(captured) > 20)
        finally:
            pipeline.set_state(Gst.State.NULL)
    assert min(captured[3:20]) > asked - 1  # the first ones were on their way already


def is_set_up(pipeline):
    """Whether its client has set the stream up."""
    return any(element.get_factory().get_name() == "udpsrc" for element in pipeline.iterate_recurse())


def test_lost_packets_are_concealed(monkeypatch):
    """2 % of the packets are lost: what a program hears has no holes, and a tone keeps its level."""
    chance, chunks = random.Random(1), []
    inside.losing(monkeypatch, "rtpjitterbuffer", "sink", lambda _: chance.random() < 0.02, "sound")
    # A busy machine is late, which loses sound of its own.
    patient = ["sound.jitter_buffer_ms=1000", "sound.vehicle.3.properties.max-size-time=5000000000"]
    with hearing(*patient, on_samples=lambda captured, data: chunks.append((captured, data))) as (_, operator, *_):
        until(lambda: received(operator).lost >= 5, seconds=60)
        until(lambda: received(operator).level_db is not None)
    heard = chunks[25:]
    levels = [rms(data) for _, data in heard]
    assert min(levels) > 0.1 * median(levels)  # several in a row fade away
    assert sum(levels) / len(levels) > 0.9 * median(levels)
    lasts = [len(data) / 2 / 48000 for _, data in heard[:-1]]  # one chunk conceals losses in a row
    assert [b - a for (a, _), (b, _) in pairwise(heard)] == pytest.approx(lasts, abs=0.005)


def rms(data):
    samples = struct.unpack(f"<{len(data) // 2}h", data)
    return (sum(each * each for each in samples) / len(samples)) ** 0.5


def test_a_source_that_does_not_open_is_tried_again_and_pictures_go_on(tmp_path):
    siren = tmp_path / "siren.wav"
    siren.write_bytes(b"")  # is found, and holds nothing
    units = []
    with hearing("sound=file", f"sound.clip={siren}", on_unit=lambda camera, unit: units.append(camera)) as sides:
        side, operator, reported, _ = sides
        whys = (f"filesrc {siren}: Stream contains no data", f"filesrc {siren} gives no sound within 3 s")
        assert side.read_sound().lost in whys
        until(lambda: len(set(units)) == len(operator.sample({})))
        assert received(operator, {"sound": False}).packets == 0
        write_tone(siren, seconds=1)
        until(lambda: side.read_sound().lost is None, seconds=30)
        until(lambda: received(operator).packets > 30, seconds=30)
        before = list(reported)
        until(lambda: received(operator).packets > 160, seconds=60)  # of three rounds
        assert reported == before  # it begins again, and nobody needs to know
        assert received(operator).rebuilt == 0


def test_a_device_that_is_not_there_is_named_and_pictures_go_on(monkeypatch, tmp_path):
    monkeypatch.setenv("PULSE_SERVER", f"unix:{tmp_path}/nobody")
    words, units = ["sound=pulse", "sound.device=unplugged"], []
    with hearing(*words, on_unit=lambda camera, unit: units.append(camera)) as (side, operator, *_):
        assert side.read_sound().lost == "pulsesrc unplugged: Failed to connect: Connection refused"
        until(lambda: len(set(units)) == len(operator.sample({})))


def test_sound_that_ends_is_reported_begins_again_and_pictures_go_on():
    units = []
    ends = "sound.source.0.properties.num-buffers=50"
    with hearing(ends, on_unit=lambda camera, unit: units.append(camera)) as (_, operator, reported, _):
        until(lambda: received(operator).rebuilt >= 1, seconds=30)
        before, packets = len(units), received(operator).packets
        until(lambda: received(operator).packets > packets, seconds=30)
        until(lambda: len(units) > before)
        assert "sound: the stream ended" in reported
        assert not [line for line in reported if "ended" in line and not line.startswith("sound: ")]


def write_tone(path, seconds):
    with wave.open(str(path), "wb") as file:
        file.setnchannels(1)
        file.setsampwidth(2)
        file.setframerate(48000)
        samples = (int(8000 * math.sin(440 * 2 * math.pi * n / 48000)) for n in range(48000 * seconds))
        file.writeframes(b"".join(struct.pack("<h", each) for each in samples))


def test_a_program_gets_samples_with_their_time():
    from runner.apply import VehicleSide, check_plan
    from runner.configuration.config import configuration
    from runner.frames import live_sound
    from runner.plans import sound_plan

    words = [*ROBOT, "sound=test", f"media.port={free_port()}"]
    setup = configuration(words, check=check_plan).setup()
    side = VehicleSide([], setup.media, lambda *_: None, sound=sound_plan(setup))
    try:
        with live_sound(words) as sounds:
            heard = [sounds.next(timeout_s=30) for _ in range(50)]
    finally:
        side.stop()
    assert all(each and each.samples.dtype == "int16" and len(each.samples) for each in heard)
    assert all(b.captured > a.captured for a, b in pairwise(heard))
    assert min(time.time() - each.captured for each in heard) > 0
    assert rms(heard[-1].samples.tobytes()) == pytest.approx(32768 * 10 ** (TONE_DB / 20), rel=0.1)


def test_a_program_must_choose_sound():
    from runner.errors import UserError
    from runner.frames import live_sound

    with pytest.raises(UserError, match="sound: null: must be chosen"), live_sound(ROBOT):
        pass
