"""Keys: holders can drive and watch, others are refused, by real GStreamer, mosquitto and OpenSSL."""

from __future__ import annotations

import base64
import json
import os
import random
import re
import shutil
import socket
import ssl
import subprocess
import threading
import time
import uuid
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import inside
import pytest
from helpers import out_of_reach
from mcap.reader import make_reader
from soak.signals import MARK, marked_processes

from rig import LOOPBACK6, WAIT_S, free_port, needs_root, passes, process, small_robot, until
from rtsp_client import RtspClient, client_hello, tls
from runner.core.commands import Command
from runner.core.roles import Role
from runner.drive.read import read_drive
from runner.gst.pipeline import encrypt
from runner.gst.secure import StreamLogin
from runner.gst.server import NO_PASSWORD
from runner.gst.understanding import VERSION
from runner.link import Limit, limited_link
from runner.mqtt.broker import private_broker
from runner.mqtt.link import ControlLink
from runner.mqtt.login import Login
from runner.operator.live import live_operator
from runner.records.operator import Sample
from runner.security import keyring
from runner.security.authority import Authority
from runner.security.keyring import Keyring, mqtt_password, rtsp_password
from runner.settings import Endpoint

SECRET_FILES = (keyring.KEY, keyring.SECRET, keyring.MEDIA_SECRET, keyring.PASSPHRASE, keyring.TOKEN)
CAMERAS = ("front", "rear")
WORDS = (*small_robot(*CAMERAS), "source=test", "fps_max=15", "page.serve=false", "pqos=constant")
PATIENT = "control.expires_s=10"  # a busy machine delays requests
NAME = "delivery_robot"


def issue(directory, **names):
    authority = Authority(directory)
    with authority.opened():
        authority.issue("broker", Role.BROKER, ["127.0.0.1"])
        authority.issue(NAME, Role.VEHICLE, ["127.0.0.1"])
        for name, role in names.items():
            authority.issue(name, Role(role), [])
    return directory


@pytest.fixture(scope="module")
def issued(tmp_path_factory):
    people = {"alice": "controller", "carol": "controller", "bob": "watcher", "pqos": "predictor", "gnss": "positioner"}
    return issue(tmp_path_factory.mktemp("issued") / "keys", another="vehicle", **people)


@pytest.fixture
def keys(issued, tmp_path):
    return shutil.copytree(issued, tmp_path / "keys")


def issue_expired(keys):
    """The directory of a watcher whose certificate has expired."""
    authority = Authority(keys, lambda: datetime.now(UTC) - timedelta(days=400))
    with authority.opened():
        authority.issue("eve", Role.WATCHER, [])
    return keys / "eve"


def changed(keys, action, name, now=lambda: datetime.now(UTC)):
    """Rotate or revoke, as the verb does."""
    authority = Authority(keys, now)
    with authority.opened():
        getattr(authority, action)(name)


# --- control ----------------------------------------------------------------------------------------------------------


@contextmanager
def driving(keys, *words):
    """A vehicle with keys and its broker; yields (broker, words for the operator)."""
    media, control = free_port(), Endpoint(LOOPBACK6, free_port())
    common = (
        *WORDS,
        PATIENT,
        f"media.port={media}",
        f"control.port={control.port}",
        f"control.host={control.host}",
        *words,
    )
    with private_broker(control, keys / "broker") as broker, process("vehicle", *common, f"keys={keys / NAME}"):
        yield broker, common


@contextmanager
def operating(keys, common, name):
    with live_operator([*common, f"keys={keys / name}"]) as operator:
        operator.start()
        yield operator


def answer_to(operator, event):
    """The vehicle's answer to a request."""
    answers = []
    operator.station.ask(event, answers.append)
    return until(lambda: answers)[0]


def frames(operator):
    return {name: counters.frames for name, counters in operator.station.samples.items()}


@pytest.fixture
def refusal(tod):
    """Status and output of a verb that is expected to start nothing."""

    def run(verb, *words):
        status, out, err = tod(verb, *words, "duration_s=1")
        return status, (out + err).strip()

    return run


def test_an_ipv6_address_does_not_work_for_rtsp_with_keys(keys, refusal):
    status, output = refusal("vehicle", *WORDS, f"keys={keys / NAME}", "media.host=::1")
    assert (status, output) == (
        2,
        "command line: media.host: ::1: an IPv6 address does not work for RTSP with keys: "
        "give a name that stands for it, as in /etc/hosts",
    )


def test_video_and_control_pass_and_each_role_may_do_what_it_is_for(keys):
    with driving(keys) as (_, common), operating(keys, common, "alice") as alice:
        until(lambda: alice.station.state)
        until(lambda: frames(alice) and min(frames(alice).values()) > 10)
        assert alice.station.identity == "alice"
        assert answer_to(alice, {"event": "mode_selected", "mode": "collective"}).result == "applied"
        with operating(keys, common, "bob") as bob:
            until(lambda: bob.station.state)
            refused = answer_to(bob, {"event": "total_set", "kbps": 10})
            assert (refused.result, refused.reason) == (
                "refused",
                "a watcher may not request total_set; only controller or supervisor may",
            )
            assert answer_to(bob, {"event": "operator_connected"}).result == "applied"
        with operating(keys, common, "carol") as carol:
            until(lambda: carol.station.state)
            refused = answer_to(carol, {"event": "total_set", "kbps": 10})
            assert (refused.result, refused.reason) == ("refused", "alice is in control")
        state = alice.station.state
        assert state.mode == "collective"


def stopped_at(operator):
    """When the last frame arrived, by time.monotonic; None if one has arrived in the last second."""
    before, at = frames(operator), time.monotonic()
    until(lambda: frames(operator) != before or time.monotonic() > at + 1)
    return at if frames(operator) == before else None


def mosquitto(program, endpoint, holder, *words, password=None, cafile=None, tls=True, certificate=True, user=None):
    """Exit status of a mosquitto client with a holder's keys, and what it printed."""
    ring = Keyring(holder)
    command = [program, "-h", endpoint.host, "-p", str(endpoint.port), "-q", "1", "-V", "mqttv5"]
    if tls:
        command += ["--cafile", cafile or ring.authority]
        command += ["--cert", ring.certificate, "--key", ring.key] if certificate else []
    own = keyring.mqtt_password(ring.secret) if password is None else password
    if own:
        command += ["-u", user or ring.holder.name, "-P", own]
    done = subprocess.run([*command, *words], capture_output=True, text=True, timeout=20, check=False)
    return done.returncode, done.stdout + done.stderr


@pytest.fixture
def broker(keys):
    endpoint = Endpoint("127.0.0.1", free_port())
    with private_broker(endpoint, keys / "broker"):
        yield endpoint


def published(endpoint, holder, topic, retain=False, **how):
    return mosquitto("mosquitto_pub", endpoint, holder, "-t", topic, "-m", "x", *(["-r"] if retain else []), **how)


PUBLISHED = (  # holder, topic, whether it is allowed
    ("alice", f"tod/{NAME}/request/alice", True),
    ("alice", f"tod/{NAME}/request/bob", False),
    ("alice", f"tod/{NAME}/state", False),
    ("alice", f"tod/{NAME}/reply/alice", False),
    (NAME, f"tod/{NAME}/state", True),
    (NAME, f"tod/{NAME}/reply/alice", True),
    (NAME, f"tod/{NAME}/steering", True),
    ("alice", f"tod/{NAME}/steering", False),
    (NAME, "tod/another/state", False),
    (NAME, "tod/another/reply/alice", False),
    (NAME, f"tod/another/request/{NAME}", False),
    ("pqos", f"tod/{NAME}/request/pqos", True),
    ("pqos", f"tod/{NAME}/reception/pqos", False),
)


def test_nobody_can_impersonate_another(keys, broker):
    for holder, topic, allowed in PUBLISHED:
        status, output = published(broker, keys / holder, topic)
        assert (status, "failed: Not authorized" in output) == (0, not allowed), (holder, topic, output)


def topics_received(endpoint, keys, holder, sender, last):
    """What a holder receives of all topics: their names, from what the broker stores up to the topic `last`."""
    ring = Keyring(keys / holder)
    words = ["--cafile", ring.authority, "--cert", ring.certificate, "--key", ring.key, "-u", holder]
    words += ["-P", keyring.mqtt_password(ring.secret), "-t", "tod/#", "-F", "%t"]
    command = ["mosquitto_sub", "-h", endpoint.host, "-p", str(endpoint.port), *words]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as listening:
        lines = []
        reader = threading.Thread(target=lambda: lines.extend(map(str.strip, listening.stdout)))
        reader.start()
        until(lambda: published(endpoint, keys / sender, last) and last in lines)  # what is stored comes first
        listening.terminate()
        reader.join()
    return sorted(line.removeprefix("tod/") for line in lines[: lines.index(last)])


def test_a_vehicle_receives_nothing_of_another_and_operators_what_they_need(keys, broker):
    told = ("advice", "configuration", "state", "steering", "telemetry")
    for name in told:
        assert published(broker, keys / NAME, f"tod/{NAME}/{name}", retain=True) == (0, "")
    assert published(broker, keys / "another", "tod/another/state", retain=True) == (0, "")
    own = [f"{NAME}/{name}" for name in told]
    everything = (
        ("another", "alice", "tod/another/request/alice", ["another/state"]),
        (NAME, "alice", f"tod/{NAME}/request/alice", [f"{NAME}/{name}" for name in ("configuration", *told[2::2])]),
        ("bob", NAME, f"tod/{NAME}/reply/bob", ["another/state", *own]),
        ("pqos", NAME, f"tod/{NAME}/reply/pqos", ["another/state", *own[2::2]]),
    )
    for holder, sender, last, expected in everything:
        assert topics_received(broker, keys, holder, sender, last) == expected, holder


def test_the_broker_refuses_intruders_and_says_so(keys, tmp_path):
    broker, reports = Endpoint("127.0.0.1", free_port()), []
    with private_broker(broker, keys / "broker", reports.append):
        _intrude(keys, broker, tmp_path)
        reasons = ("not authorised", "wrong version number", "verify failed", "did not return a certificate")
        assert passes(lambda: len(reports) >= len(reasons), 20), reports
    for reason, report in zip(reasons, reports, strict=True):
        assert report.startswith("the MQTT broker refused a client at 127.0.0.1: "), report
        assert reason in report


def _intrude(keys, broker, tmp_path):
    topic = f"tod/{NAME}/request/alice"
    assert published(broker, keys / "alice", topic) == (0, "")
    others = issue(tmp_path / "others", alice="controller")
    expired = issue_expired(keys)
    for intruder, how in (
        (keys / "alice", {"password": ""}),
        (keys / "alice", {"password": "guessed"}),
        (keys / "alice", {"user": "bob"}),
        (keys / "alice", {"tls": False}),
        (others / "alice", {"cafile": keys / "alice" / "ca.crt"}),
        (expired, {}),
        (keys / "alice", {"certificate": False}),
    ):
        assert published(broker, intruder, topic, **how)[0] != 0, (intruder, how)
    assert published(broker, keys / "alice", topic) == (0, "")


def test_the_broker_refuses_a_revoked_certificate_although_the_password_is_right(keys, tmp_path):
    """Revoked while the broker runs; it reads its new files."""
    old, mixed, broker, reports = tmp_path / "old", tmp_path / "mixed", Endpoint("127.0.0.1", free_port()), []
    shutil.copytree(keys / "alice", old)
    topic = f"tod/{NAME}/request/alice"
    with private_broker(broker, keys / "broker", reports.append) as running:
        assert published(broker, old, topic) == (0, "")
        changed(keys, "rotate", "alice")
        shutil.copytree(keys / "alice", mixed)
        for name in (keyring.CERTIFICATE, keyring.KEY):
            shutil.copy(old / name, mixed)
        running.check()
        until(lambda: published(broker, keys / "alice", topic) == (0, ""))
        assert published(broker, mixed, topic)[0] != 0
        until(lambda: reports)
    assert "verify failed" in reports[-1], reports


def test_revoked_holders_are_disconnected_and_stay_out(keys):
    old = keys.parent / "old"
    shutil.copytree(keys / "alice", old)
    with (
        driving(keys) as (broker, common),
        operating(keys, common, "bob") as bob,
        live_operator([*common, f"keys={old}"]) as alice,
    ):
        alice.start()
        until(lambda: alice.station.state and bob.station.state and min(frames(alice).values(), default=0) > 10)
        changed(keys, "revoke", "alice")
        broker.reload()
        began = time.monotonic()
        until(lambda: alice.station.state is None)
        assert time.monotonic() - began < 5
        assert until(lambda: stopped_at(alice)) - began < 5
        assert bob.station.state
        assert published(broker_of(common), old, f"tod/{NAME}/request/alice")[0] != 0


def test_a_vehicle_with_revoked_keys_is_disconnected(keys):
    old = keys.parent / "old"
    shutil.copytree(keys / NAME, old)
    with sending(keys, vehicle_keys=old) as (plans, _), watching(plans, keys / "alice") as (seen, messages):
        until(lambda: min(seen().values()) > 10, every_s=0.1)
        changed(keys, "rotate", NAME)
        began = time.monotonic()
        until(lambda: any("the vehicle's keys are no longer accepted" in what for what in seen() and messages))
        assert time.monotonic() - began < 5
        until(lambda: are_still(seen))


def are_still(seen):
    """Whether no picture arrives within 2 s; the last ones arrive while a receiver is being stopped."""
    before = seen()
    time.sleep(2)
    return seen() == before


@pytest.mark.soak
def test_connections_survive_the_expiry_of_certificates(keys):
    """Certificates of both sides expire while they stream; nobody new is admitted."""
    ends = datetime.now(UTC) + timedelta(seconds=12)
    for name in (NAME, "alice"):
        changed(keys, "rotate", name, lambda: ends - timedelta(days=365))
    with sending(keys) as (plans, _), watching(plans, keys / "alice") as (seen, messages):
        until(lambda: min(seen().values()) > 10, every_s=0.1)
        time.sleep(max(0.0, (ends - datetime.now(UTC)).total_seconds()) + 1)
        before = seen()
        until(lambda: min(seen().values()) > max(before.values()) + 20, every_s=0.1)
        assert not messages, messages
        with watching(plans, keys / "bob") as (late, refusals):
            until(lambda: refusals)
            assert not any(late().values())


def test_rotated_keys_take_effect_without_a_restart(keys):
    """Keys of everyone, while the vehicle streams."""
    with driving(keys) as (broker, common), operating(keys, common, "alice") as alice:
        until(lambda: alice.station.state and min(frames(alice).values(), default=0) > 10)
        for name in ("broker", NAME, "alice"):
            changed(keys, "rotate", name)
        broker.end()
        with private_broker(broker_of(common), keys / "broker"):
            until(lambda: alice.station.state is None)
            until(lambda: alice.station.state)
            before = frames(alice)
            until(lambda: min(frames(alice).values()) > max(before.values()) + 20)
            assert answer_to(alice, {"event": "mode_selected", "mode": "collective"}).result == "applied"


def broker_of(common):
    port = next(word for word in common if word.startswith("control.port="))
    return Endpoint(LOOPBACK6, int(port.partition("=")[2]))


# --- video ------------------------------------------------------------------------------------------------------------


@contextmanager
def sending(keys, *words, vehicle_keys=None):
    """A vehicle's cameras; yields (plans, reports)."""
    from runner.apply import VehicleSide, check_plan
    from runner.configuration.config import configuration
    from runner.plans import compile_plans

    own = [*WORDS, f"media.port={free_port()}", f"keys={keys / NAME}", *words]
    setup = configuration(own, check=check_plan).setup()
    plans, reports = compile_plans(setup), []
    side = VehicleSide(
        plans,
        setup.media,
        lambda who, what: reports.append(f"{who}: {what}"),
        keyring=Keyring(vehicle_keys or keys / NAME),
    )
    knobs = {"sending": True, "size": (320, 180), "bitrate": 300}
    side.turn([Command(camera, knob, value) for camera in CAMERAS for knob, value in knobs.items()])
    try:
        yield plans, reports
    finally:
        side.stop()


@contextmanager
def watching(plans, holder, vehicle=NAME):
    """A function that returns the frames received of each camera, and the side's messages."""
    from runner.apply import OperatorSide

    messages = []
    side = OperatorSide(
        plans,
        lambda cameras, what: messages.append(f"{cameras}: {what}"),
        keyring=Keyring(holder) if holder else None,
        vehicle=vehicle,
    )
    try:
        yield lambda: {name: each.frames for name, each in side.sample(dict.fromkeys(CAMERAS, True)).items()}, messages
    finally:
        side.stop()


@pytest.mark.parametrize(("graph", "host"), [("h264_rtsp", "127.0.0.1"), ("h264_srt", LOOPBACK6)])
def test_only_key_holders_receive_pictures(keys, graph, host):
    with (
        sending(keys, f"graph={graph}", f"graph.first_port={free_port(3)}", f"media.host={host}") as (plans, _),
        watching(plans, keys / "bob") as (seen, messages),
    ):
        until(lambda: min(seen().values()) > 10, every_s=0.1)
        assert not messages, messages


def test_a_revoked_viewer_receives_no_pictures_over_srt(keys, tmp_path):
    """Both sides use the new secret without a restart; what the revoked holder knows opens nothing."""
    revoked = tmp_path / "revoked"
    shutil.copytree(keys / "carol", revoked)
    with sending(keys, "graph=h264_srt", f"graph.first_port={free_port(3)}") as (plans, reports):
        with watching(plans, keys / "bob") as (seen, _):
            until(lambda: min(seen().values()) > 10, every_s=0.1)
            changed(keys, "revoke", "carol")
            until(lambda: {f"{camera}: there are new keys" for camera in CAMERAS} <= set(reports), every_s=0.1)
            before = seen()
            until(lambda: all(frames > before[name] + 10 for name, frames in seen().items()), every_s=0.1)
        with watching(plans, revoked) as (seen, _):
            end = time.monotonic() + 4
            while time.monotonic() < end:
                assert set(seen().values()) == {0}
                time.sleep(0.1)


def test_rtsp_refuses_intruders(keys, tmp_path):
    others = issue(tmp_path / "others", alice="controller")
    shutil.copy(keys / "alice" / keyring.AUTHORITY, others / "alice")  # otherwise it would itself refuse the vehicle
    wrong = tmp_path / "wrong"
    shutil.copytree(keys / "alice", wrong)
    (wrong / keyring.SECRET).write_text("guessed")
    revoked = tmp_path / "revoked"
    shutil.copytree(keys / "carol", revoked)
    changed(keys, "revoke", "carol")
    expired = issue_expired(keys)
    with sending(keys) as (plans, reports):
        intruders = (others / "alice", wrong, revoked, expired, keys / "pqos", None)
        with ExitStack() as stack:
            all_seen = [stack.enter_context(watching(plans, holder)) for holder in intruders]
            with watching(plans, keys / "alice") as (seen, _):
                until(lambda: min(seen().values()) > 30, every_s=0.1)
            for holder, (own, _) in zip(intruders, all_seen, strict=True):
                assert set(own().values()) == {0}, holder
            until(lambda: len(refusals(reports)) == len(intruders))
            refused = refusals(reports)  # of a revoked viewer, the wording depends on which file is read first
            _revoked_while_watching(keys, plans, reports)
    assert refused == sorted(
        f"keys: refused an RTSP client at 127.0.0.1: {why}"
        for why in (
            "its certificate is not accepted: unknown-ca",
            "its password is wrong",
            "its certificate is revoked",
            "its certificate is not accepted: expired",
            "pqos may not watch",
            "it has not completed a TLS handshake with a certificate",
        )
    )
    secret = (keys / "alice" / keyring.SECRET).read_text()
    assert not any(secret in what for what in reports)


def refusals(reports):
    """What was refused. On a busy machine, a watcher may end between the challenge of the server and its answer."""
    return sorted(what for what in reports if "refused" in what and not what.endswith(NO_PASSWORD))


def _revoked_while_watching(keys, plans, reports):
    """A watcher's stream ends, although the vehicle could not read its keys for a moment."""
    with watching(plans, keys / "bob") as (seen, _):
        until(lambda: min(seen().values()) > 10, every_s=0.1)
        with out_of_reach(keys):
            until(lambda: any("permission denied" in what for what in reports))
        assert not any("no longer accepted" in what for what in reports)
        changed(keys, "revoke", "bob")
        until(lambda: len([what for what in reports if "its keys are no longer accepted" in what]) >= len(CAMERAS))


def client_of(plans, holder):
    """A connection to the first camera, with a holder's keys, that has requested nothing but the methods."""
    client = RtspClient(plans[0].operator[0].properties["location"], keys=holder)
    assert client.ask("OPTIONS") == 200
    return client


def test_a_revoked_holder_that_watches_nothing_is_disconnected_too(keys):
    with (
        sending(keys) as (plans, reports),
        client_of(plans, keys / "bob") as bob,
        client_of(plans, keys / "alice") as alice,
    ):
        changed(keys, "revoke", "bob")
        assert bob.ended()
        until(lambda: "keys: refused an RTSP client at 127.0.0.1: its keys are no longer accepted" in reports)
        assert alice.ask("OPTIONS") == 200


def test_a_revoked_holder_starts_no_camera(keys, monkeypatch):
    """Not even on a connection that is not closed yet."""
    monkeypatch.setattr("runner.gst.server.WATCH_MS", 3_600_000)
    monkeypatch.setattr("runner.security.keyring.CHECK_S", 0)
    with sending(keys) as (plans, reports), client_of(plans, keys / "bob") as bob:
        changed(keys, "revoke", "bob")
        assert bob.ask("DESCRIBE", Accept="application/sdp") == 403
        assert not any("pipeline built" in report for report in reports)


def other_key(encoded):
    """A message with keys (MIKEY) whose last key is another one, in base64."""
    message = bytearray(base64.b64decode(encoded))
    message[-2] ^= 0xFF  # the end of its salt, in front of the kind of the MAC
    return base64.b64encode(message).decode()


def test_keys_that_do_not_fit_are_reported_with_both_versions(keys, monkeypatch):
    monkeypatch.setattr("runner.gst.mikey.in_one_piece", other_key)
    with sending(keys) as (plans, _), watching(plans, keys / "bob") as (seen, messages):
        until(lambda: max(seen().values()) > 0 or messages, every_s=0.1)
        versions = f"GStreamer {VERSION} here, {VERSION} on the vehicle"
        told = f"packets arrive, but none can be decrypted; {versions}; install the same tod-runner on both sides"
        assert messages[0].partition(": ")[2] == told
        assert max(seen().values()) == 0


def test_feedback_that_the_vehicle_does_not_understand_is_reported(keys, monkeypatch):
    """Pictures arrive, but none that is lost is sent again."""
    chance = random.Random(1)
    inside.losing(monkeypatch, "udpsrc", "src", lambda packet: packet.get_size() > 200 and chance.random() < 0.1)
    monkeypatch.setattr("runner.gst.camera_media.write_keys", lambda _: None)
    monkeypatch.setattr("runner.gst.mikey.in_one_piece", other_key)  # of the key for feedback
    monkeypatch.setattr("runner.gst.understanding.REQUESTS", 10)
    with sending(keys) as (plans, _), watching(plans, keys / "bob") as (seen, messages):
        until(lambda: min(seen().values()) >= 0 and messages, every_s=0.1)
        assert "nothing that was lost is repaired" in messages[0]
        assert min(seen().values()) > 0


def test_srtp_keys_come_from_the_systems_generator(keys, monkeypatch):
    """GStreamer's own are outputs of a generator that also makes the nonces which the server hands to everybody."""
    drawn = []

    def draw(count):
        drawn.append(os.urandom(count))
        return drawn[-1]

    monkeypatch.setattr("runner.gst.srtp.token_bytes", draw)
    with sending(keys) as (plans, _), watching(plans, keys / "alice") as (seen, _):
        until(lambda: min(seen().values()) > 10, every_s=0.1)
        assert len(drawn) == 2 * len(CAMERAS)  # of each camera's video, and of what the operator sends for it
        with client_of(plans, keys / "bob") as bob:
            assert bob.ask("DESCRIBE", Accept="application/sdp") == 200
            offered = re.findall(r"a=key-mgmt:mikey (\S+)", bob.body)
    assert offered
    assert all(any(key in base64.b64decode(each) for key in drawn) for each in offered)
    assert len(set(drawn)) == len(drawn)


def test_without_its_secret_an_operator_accepts_no_stream(keys, monkeypatch):
    """A listener without a passphrase would show the pictures of anybody who connects."""
    from gi.repository import Gst

    passphrases = []
    monkeypatch.setattr("runner.gst.secure.encrypt", lambda _, passphrase: passphrases.append(passphrase))
    login = StreamLogin(Keyring.of(keys / "alice"), NAME, print)
    (keys / "alice" / keyring.MEDIA_SECRET).unlink()
    pipeline = Gst.parse_launch("srtsrc name=client ! fakesink")
    for _ in range(2):
        assert "no such file" in login.prepare(pipeline, pipeline.get_by_name("client"))
    assert len(set(passphrases)) == 2
    assert all(10 <= len(passphrase) <= 79 for passphrase in passphrases)


def test_a_new_pipeline_is_not_ended_for_the_certificate_of_the_last_one(keys):
    """The handshake that shows the vehicle's new one may take longer than until the next check."""
    from gi.repository import Gio, Gst

    login = StreamLogin(Keyring.of(keys / "alice"), NAME, print)
    certificate = Gio.TlsCertificate.new_from_file(str(keys / NAME / keyring.CERTIFICATE))
    pipeline = Gst.parse_launch("rtspsrc name=client ! fakesink")
    assert login.prepare(pipeline, pipeline.get_by_name("client")) is None
    assert pipeline.get_by_name("client").emit("accept-certificate", None, certificate, Gio.TlsCertificateFlags(0))
    assert login.withdrawn() is None
    changed(keys, "rotate", NAME)
    until(login.withdrawn)
    assert login.prepare(pipeline, pipeline.get_by_name("client")) is None
    assert login.withdrawn() is None


@pytest.mark.parametrize("element", ["srtsrc", "srtsink"])  # operator, vehicle
def test_srt_uses_aes_256(element):
    from gi.repository import Gst

    pipeline = Gst.parse_launch(f"bin. ( {element} name=srt uri=srt://127.0.0.1:1 )")
    encrypt(pipeline, "a passphrase")
    assert int(pipeline.get_by_name("srt").get_property("pbkeylen")) == 256 // 8


@pytest.mark.parametrize("version", [ssl.TLSVersion.TLSv1_2, ssl.TLSVersion.TLSv1_3])
def test_the_broker_accepts_nothing_older_than_tls_1_3(keys, broker, version):
    context = tls(keys / "alice")
    context.maximum_version = version
    refusal = pytest.raises(ssl.SSLError) if version < ssl.TLSVersion.TLSv1_3 else nullcontext()
    with refusal, socket.create_connection((broker.host, broker.port), 60) as line, context.wrap_socket(line):
        pass


def test_a_peer_that_is_not_the_broker_is_left_until_the_broker_is_back(keys):
    impostor = keys.parent / "impostor"
    shutil.copytree(keys / "broker", impostor)
    for name in (keyring.CERTIFICATE, keyring.KEY):
        shutil.copy(keys / "alice" / name, impostor)
    endpoint, notes, connected = Endpoint("127.0.0.1", free_port()), [], threading.Event()
    will = (f"tod/{NAME}/state", {"online": False})
    login = Login(Keyring.of(keys / NAME), notes.append)
    attempts, check = [], login.check
    login.check = lambda connection: (attempts.append(1), check(connection))
    listen = {f"tod/{NAME}/request/+": print}
    link = ControlLink(endpoint, will, listen, lambda is_up: is_up and connected.set(), notes.append, login)
    with private_broker(endpoint, impostor):
        link.connect()
        until(lambda: len(attempts) > 3)
        assert not connected.is_set()
    with private_broker(endpoint, keys / "broker"):
        assert connected.wait(20), notes
    link.close()
    refused = "the peer is not the broker: its certificate has a different role; retrying"
    assert len([note for note in notes if note.endswith(refused)]) == 1


def test_an_operator_knows_its_vehicle(keys):
    """Another vehicle of the same fleet answers at that address."""
    with sending(keys) as (plans, _), watching(plans, keys / "alice", vehicle="another") as (seen, _):
        end = time.monotonic() + 4
        while time.monotonic() < end:
            assert set(seen().values()) == {0}
            time.sleep(0.2)


def test_silent_clients_do_not_block_others(keys, monkeypatch):
    """Neither clients that only connect, nor those that stop in the middle of a handshake: they are too many."""
    with ExitStack() as stack, sending(keys) as (plans, _):
        port = plans[0].operator[0].properties["location"].rpartition(":")[2].partition("/")[0]
        silent = [stack.enter_context(socket.create_connection(("127.0.0.1", int(port)))) for _ in range(60)]
        for sock in silent[::2]:
            sock.sendall(client_hello(keys / "bob"))
        with monkeypatch.context() as patch, watching(plans, keys / "alice") as (seen, _):
            patch.setattr("runner.gst.clients.FIRST_REQUEST_S", 10 * WAIT_S)  # as long as a few may be silent
            until(lambda: min(seen().values()) > 5, 5 * WAIT_S, every_s=0.1)
        for sock in silent:
            sock.settimeout(10)
            with suppress(ConnectionError):
                while sock.recv(4096):
                    pass


def test_neither_plain_rtsp_nor_the_password_of_another_is_accepted(keys, tmp_path):
    mixed = tmp_path / "mixed"
    shutil.copytree(keys / "bob", mixed)
    for file in (keyring.SECRET, keyring.HOLDER):
        shutil.copy(keys / "alice" / file, mixed)
    with sending(keys) as (plans, reports):
        plain = [replace(plan, operator=_unencrypted(plan)) for plan in plans]
        with (
            watching(plain, None) as (seen, _),
            watching(plans, mixed) as (mixed_seen, _),
            watching(plans, keys / "alice") as (own, _),
        ):
            until(lambda: min(own().values()) > 30 and len(refusals(reports)) > 1, every_s=0.1)
            assert {*seen().values(), *mixed_seen().values()} == {0}
    assert refusals(reports) == [
        "keys: refused an RTSP client at 127.0.0.1: certificate belongs to bob, password to alice",
        "keys: refused an RTSP client at 127.0.0.1: it has not completed a TLS handshake with a certificate",
    ]


def _unencrypted(plan):
    client, *rest = plan.operator
    location = client.properties["location"].replace("rtsps:", "rtsp:")
    return (replace(client, properties={**client.properties, "location": location}), *rest)


@pytest.mark.parametrize("graph", ["h264_rtsp", pytest.param("h264_srt", marks=pytest.mark.soak)])
def test_a_demo_with_keys_streams_and_shows_no_secret(tod, keys, tmp_path, graph):
    """Neither in its output nor its drive, nor the MCAP of that, nor what a list of processes shows.

    Its page is served to other machines, so that all kinds of secrets are in use.
    """
    authority = Authority(keys)
    with authority.opened():
        authority.issue("alice", Role.CONTROLLER, ["127.0.0.2"])
    drive, mark = tmp_path / "drive", uuid.uuid4().hex
    page = ("page.serve=true", "page.host=0.0.0.0", f"page.port={free_port()}")
    ports = (f"media.port={free_port()}", f"control.port={free_port()}", f"graph.first_port={free_port()}")
    words = (*WORDS, *page, *ports, f"graph={graph}", f"keys={keys}", f"log={drive}")
    with process("demo", *words, "duration_s=4", env={MARK: mark}) as demo:
        until(lambda: (drive / "operator.jsonl").exists() and len(marked_processes(mark)) == 4)
        shown = [
            Path(f"/proc/{pid}", name).read_bytes() for pid in marked_processes(mark) for name in ("cmdline", "environ")
        ]
        output, _ = demo.communicate(timeout=60)
    assert demo.returncode == 0, output
    sampled = list(read_drive(drive).sides["operator"].of(Sample))
    assert min(camera.frames for camera in sampled[-1].cameras.values()) > 20
    assert tod("export", str(drive)).status == 0
    with (drive / "drive.mcap").open("rb") as file:
        mcap = make_reader(file)
        exported = [message.data for *_, message in mcap.iter_messages()]
        exported += [str(each.metadata).encode() for each in mcap.iter_metadata()]
    assert len(exported) > 100
    everything = b"\n".join((*shown, output.encode(), *exported, *(path.read_bytes() for path in drive.iterdir())))
    assert NAME.encode() in everything
    assert [secret for secret in _secrets(keys) if secret in everything] == []


def _secrets(keys):
    """What must not be shown: the contents of secret files, and the passwords that follow from them."""
    files = [path for path in keys.rglob("*") if path.name in SECRET_FILES]
    own = [Keyring(path.parent).secret for path in files if path.name == keyring.SECRET]
    passwords = [password.encode() for each in own for password in (mqtt_password(each), rtsp_password(each, NAME))]
    return [max(path.read_bytes().split(), key=len) for path in files] + passwords  # of a key, one line


# --- what others on the network can read ------------------------------------------------------------------------------

ETH_P_ALL = 0x0003
LEGIBLE = (b"delivery_robot", b"front", b"rear", b"alice", b"operator_connected", b'"event"', b'"cameras"', b"x264")
SPS = 7  # type of a NAL unit


def recognisable(unit):
    """Parts of a picture that a decoder can start with, as they appear in RTP and, within its packets, in MPEG-TS."""
    units = {nal[0] & 31: nal for nal in re.split(rb"\x00\x00\x00?\x01", bytes(unit.data))[1:]}
    if SPS not in units:
        return []
    picture = max(units.values(), key=len)
    parts = [picture[at : at + 16] for at in (40, 80, 120, 160)]
    return [units[SPS][:12], *(part for part in parts if len(part) == 16)]


@contextmanager
def captured(address):
    """The packets of the network device with an address, as one string of bytes, once the block has ended."""
    shown = json.loads(subprocess.check_output(["ip", "-j", "addr"], text=True))
    devices = {each["local"]: device["ifname"] for device in shown for each in device["addr_info"] if "local" in each}
    packets = []
    with socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0) as tap:  # with a protocol it would hear all devices
        tap.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8_000_000)
        tap.bind((devices[address], ETH_P_ALL))
        yield packets
        tap.setblocking(False)
        with suppress(BlockingIOError):
            while True:
                packets.append(tap.recv(65_536))


@needs_root
@pytest.mark.parametrize(
    ("graph", "encrypted"),
    [
        ("h264_rtsp", True),
        ("h264_rtsp", False),
        ("h264_srt", True),
        pytest.param("h264_srt", False, marks=pytest.mark.soak),
    ],
)
def test_nothing_on_the_wire_can_be_read(keys, encrypted, graph, tmp_path):
    media, control = (Endpoint("127.0.0.1", free_port()) for _ in range(2))
    limit = Limit(lambda t: 20_000, queue_ms=200, delay_ms=0)
    words = (*WORDS, f"graph={graph}", f"graph.first_port={free_port(3)}")
    own = {name: [f"keys={keys / name}"] if encrypted else [] for name in (NAME, "alice")}
    with (
        limited_link("netns", limit, media, control, lambda line: None, dials=graph == "h264_srt") as link,
        private_broker(link.broker, keys / "broker" if encrypted else None),
        captured(link.broker.host) as packets,
        process("vehicle", *words, *link.vehicle_overrides, *own[NAME], before=link.vehicle_command),
        live_operator([*words, *link.operator_overrides, *own["alice"]]) as operator,
    ):
        pictures = []
        operator.start(lambda camera, unit: pictures.extend(recognisable(unit)))
        until(lambda: operator.station.state and min(frames(operator).values(), default=0) > 20)
        assert answer_to(operator, {"event": "mode_selected", "mode": "collective"}).result == "applied"
    everything = b"".join(packets)
    assert len(packets) > 200
    assert pictures
    parts, names = set(pictures), {*LEGIBLE, *(b"RTSP/1.0",) * (graph == "h264_rtsp")}
    legible = [text for text in (*names, *parts) if text in everything]
    if encrypted:
        assert legible == [], [packet for packet in packets if any(text in packet for text in legible)][:3]
    else:
        assert names - {b"alice"} <= set(legible)
        assert len(parts.intersection(legible)) > len(parts) / 2, "others are cut by MPEG-TS"


# --- what is refused before anything starts ---------------------------------------------------------------------------


NEEDS_KEYS = "give keys=DIR, created by `tod-runner keys`, or insecure=true"


HOSTS = (("media", "192.0.2.1"), ("control", "192.0.2.2"))


@pytest.mark.parametrize("verb", ["vehicle", "operator", "demo", "latency", "latency loop=true", "ros"])
def test_a_network_needs_keys(verb, refusal):
    """Refused before anything listens."""
    verb, *more = [*verb.split(), *(["camera=front"] if "latency" in verb else [])]
    found = "media.host 192.0.2.1 and control.host 192.0.2.2 are not loopback addresses"
    hosts = [f"{end}.host={address}" for end, address in HOSTS]
    assert refusal(verb, *WORDS, *more, *hosts) == (2, f"command line: keys: {found}: {NEEDS_KEYS}")


@pytest.mark.parametrize(("end", "address"), HOSTS)
def test_a_network_needs_keys_whichever_address_is_beyond_this_machine(end, address, refusal):
    found = f"{end}.host {address} is not a loopback address"
    expected = (2, f"command line: keys: {found}: {NEEDS_KEYS}")
    assert refusal("operator", *WORDS, f"{end}.host={address}") == expected


@pytest.mark.parametrize("verb", ["operator", "latency"])
def test_a_page_on_a_network_needs_keys(verb, refusal):
    words = (*WORDS, *(["camera=front"] if verb == "latency" else []), "page.serve=true", "page.host=0.0.0.0")
    rule = "give keys=DIR, created by `tod-runner keys`; browsers play video by HTTPS only"
    status, output = refusal(verb, *words)
    assert (status, output.splitlines()[-1]) == (
        2,
        f"command line: page.host: 0.0.0.0: is not a loopback address: {rule}",
    )


def test_a_relay_cannot_read_what_keys_encrypt(keys, refusal, tmp_path):
    words = (*WORDS, "link=relay", f"keys={keys}", f"log={tmp_path / 'drive'}")
    assert refusal("demo", *words) == (
        2,
        "command line: link: relay: rewrites ports in RTSP, which keys encrypt; link=netns passes it unread",
    )


def test_a_demo_names_the_keys_that_it_lacks(keys, refusal):
    changed(keys, "revoke", "alice")
    changed(keys, "revoke", "carol")
    status, output = refusal("demo", *WORDS, f"keys={keys}")
    assert (status, output) == (2, f"keys: {keys}: lacks keys: tod-runner keys output={keys} controller=NAME")


def test_keys_of_another_role_are_refused(keys, refusal):
    status, output = refusal("vehicle", *WORDS, f"keys={keys / 'alice'}")
    assert (status, "people.json: no such file" in output) == (2, True)
    status, output = refusal("operator", *WORDS, f"keys={keys / 'pqos'}")
    assert (status, "media.secret: no such file" in output) == (2, True)
    shutil.copytree(keys / "bob", keys / "copy")
    (keys / "copy" / "own.json").write_text('{"name": "bob", "role": "predictor"}')
    status, output = refusal("operator", *WORDS, f"keys={keys / 'copy'}")
    assert (status, output) == (
        2,
        f"keys: {keys / 'copy'}: must be those of a controller, a supervisor or a watcher, not of predictor bob",
    )
