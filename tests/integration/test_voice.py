"""The operator's voice from what a page sends to the vehicle's loudspeaker, with real pipelines."""

from __future__ import annotations

import math
import struct
import threading
import time
from contextlib import contextmanager

import inside
import pytest

from keyed import CONTROLLER, VEHICLE, WATCHER, issue
from rig import free_port, until
from runner.security.keyring import Keyring

pytestmark = pytest.mark.gst
ROBOT = ["vehicle=delivery_robot", "source=test", "fps_max=5"]
TONE_DB = -15.05  # RMS of a sine of a quarter of full scale
CHUNK_S, RATE, HZ = 0.01, 48_000, 440
END_S = 0.5  # after the key is released, and no later, there is silence


def tone(number):
    """A hundredth of a second of it, as a page sends it."""
    count = round(RATE * CHUNK_S)
    values = (math.sin(2 * math.pi * HZ * (number * count + i) / RATE) / 4 for i in range(count))
    return struct.pack(f"<{count}h", *(round(32767 * value) for value in values))


@contextmanager
def loudspeaker(heard, *words, keyring=None, lost=None):
    """A vehicle with a loudspeaker that writes to a file. Yields its side, its reports and its setup."""
    from runner.apply import VehicleSide, check_plan
    from runner.configuration.config import configuration
    from runner.plans import compile_plans, voice_plan

    port = f"media.port={free_port()}"
    setup = configuration([*ROBOT, "voice=file", f"voice.file={heard}", *words, port], check=check_plan).setup()
    reports, keyed = [], {"keyring": keyring, "lost": lost or {}}
    voice = voice_plan(setup)
    side = VehicleSide(
        compile_plans(setup), setup.media, lambda *what: reports.append(": ".join(what)), voice=voice, **keyed
    )
    try:
        yield side, reports, setup
    finally:
        side.stop()


@contextmanager
def operator(setup, name, keyring=None, reports=None):
    """An operator's side that may speak. Yields its sender."""
    from runner.apply import VoiceSender
    from runner.plans import voice_plan

    said = [] if reports is None else reports

    def report(*what):
        said.append(": ".join(what))

    sender = VoiceSender(voice_plan(setup), report, name, keyring, setup.vehicle.name)
    sender.follow(may_speak=True, is_heard=False)
    try:
        yield sender
    finally:
        sender.follow(may_speak=False, is_heard=False)
        time.sleep(0.1)


@contextmanager
def speaking(sender):
    """A key is held."""
    released = threading.Event()

    def speak():
        began, number = time.monotonic(), 0
        while not released.wait(max(0.0, began + number * CHUNK_S - time.monotonic())):
            sender.push(tone(number), began + number * CHUNK_S)
            number += 1

    thread = threading.Thread(target=speak)
    thread.start()
    try:
        yield
    finally:
        released.set()
        thread.join()


def level_db(heard, seconds=0.5):
    """RMS of the last part of a file."""
    data = heard.read_bytes()[-2 * round(RATE * seconds) :]
    samples = struct.unpack(f"<{len(data) // 2}h", data[: len(data) // 2 * 2])
    return 10 * math.log10(sum(each * each for each in samples) / max(1, len(samples)) / 32768**2 + 1e-10)


def written(heard):
    return heard.stat().st_size if heard.exists() else 0


@pytest.mark.parametrize("with_keys", [False, True])
def test_the_operator_in_control_is_heard_until_the_key_is_released(tmp_path, with_keys):
    heard, keys, reports = tmp_path / "heard", issue(tmp_path / "keys") if with_keys else None, []
    words = [f"keys={keys / VEHICLE}"] if keys else []
    vehicle, alice = (Keyring(keys / name) if keys else None for name in (VEHICLE, CONTROLLER))
    with loudspeaker(heard, *words, keyring=vehicle) as (side, of_vehicle, setup):
        side.give_control([CONTROLLER], CONTROLLER)
        with operator(setup, CONTROLLER, alice, reports) as sender:
            until(lambda: side.read_voice().operator == CONTROLLER)
            for _ in range(2):
                before = written(heard)
                with speaking(sender):
                    until(lambda: side.read_voice().speaking)
                    until(lambda before=before: written(heard) > before + 4 * RATE)
                    until(lambda: level_db(heard) == pytest.approx(TONE_DB, abs=1))
                    at_release = written(heard)
                until(lambda: not side.read_voice().speaking)
                assert written(heard) - at_release < END_S * 2 * RATE
        until(lambda: side.read_voice().operator is None)
    assert reports == of_vehicle == []


def test_nobody_else_is_heard(tmp_path):
    """Not one who only watches, nor a second operator, nor one whose control has passed to another."""
    heard, keys, reports = tmp_path / "heard", issue(tmp_path / "keys"), []
    alice, bob = (Keyring(keys / name) for name in (CONTROLLER, WATCHER))
    with loudspeaker(heard, f"keys={keys / VEHICLE}", keyring=Keyring(keys / VEHICLE)) as (side, of_vehicle, setup):
        side.give_control([CONTROLLER], CONTROLLER)
        with operator(setup, WATCHER, bob, reports) as sender, speaking(sender):
            until(lambda: of_vehicle)
            assert of_vehicle == [f"voice: refused 127.0.0.1 ({WATCHER}): {CONTROLLER} is in control"]
            with operator(setup, CONTROLLER, bob, reports) as pretender, speaking(pretender):  # by its own certificate
                time.sleep(2)
            assert side.read_voice().operator is None
        with operator(setup, CONTROLLER, alice, reports) as sender, speaking(sender):
            until(lambda: written(heard) > RATE)
            side.give_control([WATCHER], WATCHER)
            until(lambda: side.read_voice().operator is None)
            silent = written(heard)
            until(lambda: f"voice: refused 127.0.0.1 ({CONTROLLER}): {WATCHER} is in control" in of_vehicle)
            assert written(heard) == silent
    assert f"voice: disconnected {CONTROLLER}, who is no longer in control" in of_vehicle
    assert of_vehicle.count(f"voice: refused 127.0.0.1 ({WATCHER}): {CONTROLLER} is in control") == 1


def test_one_whose_connection_the_vehicle_has_ended_connects_again(tmp_path):
    """As when another process of the same operator has taken its place, and ends; the client does not notice."""
    heard, reports = tmp_path / "heard", []
    with loudspeaker(heard) as (side, _, setup), operator(setup, CONTROLLER, reports=reports) as sender:
        side.give_control([CONTROLLER], CONTROLLER)

        def is_heard():
            found = side.read_voice().operator == CONTROLLER
            sender.follow(may_speak=True, is_heard=found)
            return found

        until(is_heard, every_s=0.1)
        with operator(setup, CONTROLLER) as other:
            until(lambda: side.read_voice().operator is None, every_s=0.001)
            with speaking(other):
                until(lambda: side.read_voice().speaking)
        until(lambda: not is_heard(), every_s=0.1)
        until(is_heard, every_s=0.1)
        with speaking(sender):
            until(lambda: side.read_voice().speaking)
    assert reports[:1] == ["voice: the vehicle has ended the connection"]


def test_what_comes_late_is_not_played(tmp_path, monkeypatch):
    """A link holds packets for a second, and delivers them when the key has been released."""
    heard, flows = tmp_path / "heard", threading.Event()
    flows.set()
    inside.holding_voice(monkeypatch, flows)
    with loudspeaker(heard) as (side, _, setup):
        side.give_control([CONTROLLER], CONTROLLER)
        with operator(setup, CONTROLLER) as sender:
            until(lambda: side.read_voice().operator == CONTROLLER)
            with speaking(sender):
                until(lambda: written(heard) > RATE)
                flows.clear()
                time.sleep(1)
            time.sleep(0.5)
            before = written(heard)
            flows.set()
            time.sleep(1)
            assert written(heard) - before < 0.2 * 2 * RATE


def test_a_loudspeaker_that_does_not_open_is_named(tmp_path):
    from runner.apply import check_machine
    from runner.configuration.config import configuration
    from runner.plans import voice_plan

    missing = tmp_path / "missing" / "heard"
    setup = configuration([*ROBOT, "voice=file", f"voice.file={missing}"]).setup()
    lost = check_machine([], None, voice_plan(setup), strict=False)
    assert lost["voice"].startswith(f"filesink {missing}: Could not open file")
