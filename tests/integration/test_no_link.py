"""Why there is no control link: each way in which a broker's address gives none is named, by real peers."""

from __future__ import annotations

import shutil
import socket
import struct
import threading
import time
from contextlib import ExitStack, contextmanager, suppress
from datetime import UTC, datetime, timedelta

import pytest

from rig import ROBOT, free_port, until
from runner.core.roles import Role
from runner.mqtt.broker import private_broker
from runner.mqtt.link import ControlLink
from runner.mqtt.login import Login
from runner.security import keyring
from runner.security.authority import Authority
from runner.security.keyring import Keyring
from runner.settings import Endpoint
from runner.vehicle.live import live_vehicle

pytestmark = pytest.mark.gst

NAME = "delivery_robot"
HOLDERS = {"broker": Role.BROKER, NAME: Role.VEHICLE}
LATER = timedelta(days=30)
YEAR = timedelta(days=365)


def issue(directory, **ages):
    """Keys of a broker and a vehicle, issued so long ago."""
    with Authority(directory).opened():
        pass
    for name, role in HOLDERS.items():
        authority = Authority(directory, lambda name=name: datetime.now(UTC) - ages.get(name, timedelta(0)))
        with authority.opened():
            authority.issue(name, role, ["127.0.0.1"])
    return directory


def day(at):
    return f"{at:%Y-%m-%d}"


@contextmanager
def connecting(endpoint, keys=None):
    """A link that connects with a vehicle's keys; yields what it reports, after the address."""
    notes = []
    begin = f"no control link: MQTT broker at {endpoint}: "
    login = Login(Keyring.of(keys / NAME), notes.append) if keys else None
    listen = {f"tod/{NAME}/request/+": print}
    link = ControlLink(
        endpoint, None, listen, lambda here: None, lambda what: notes.append(what.removeprefix(begin)), login
    )
    link.connect()
    try:
        yield link, notes
    finally:
        link.close()


@contextmanager
def program(endpoint, answer):
    """Another program, which handles each connection in a thread of its own."""
    with socket.create_server((endpoint.host, endpoint.port)) as server:

        def serve():
            with suppress(OSError):
                while True:
                    threading.Thread(target=handle, args=(server.accept()[0],), daemon=True).start()

        def handle(line):
            with line, suppress(OSError):
                answer(line)

        threading.Thread(target=serve, daemon=True).start()
        try:
            yield
        finally:
            server.shutdown(socket.SHUT_RDWR)


def says(words, waits=True):
    def answer(line):
        line.recv(999)
        line.sendall(words)
        while waits and line.recv(999):
            pass

    return answer


def resets(line):
    line.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    line.recv(1)


def echoes(line):
    while words := line.recv(999):
        line.sendall(words)


def greets(line):
    line.sendall(b"SSH-2.0-OpenSSH_9.2p1\r\n")
    line.recv(1)
    line.recv(999)


def is_silent(line):
    time.sleep(20)


HTTP = b"HTTP/1.1 400 Bad Request\r\nConnection: close\r\n\r\n"
CLOSED = "the connection was closed without an answer: no MQTT broker, or one that expects TLS and keys; retrying"
NO_TLS = "does not speak TLS: a broker without keys, or another program; retrying"
SILENT = "accepts connections but does not answer; retrying"


def test_an_expired_certificate_of_its_own_is_named(tmp_path):
    """TLS 1.3: the broker refuses it only after this side's handshake, with an alert."""
    broker = Endpoint("127.0.0.1", free_port())
    ends = datetime.now(UTC) - timedelta(days=35)
    keys = issue(tmp_path / "keys", **{NAME: YEAR + timedelta(days=35)})
    with private_broker(broker, keys / "broker"), connecting(broker, keys) as (link, notes):
        until(lambda: len(notes) == 2)
        expired = f"own certificate expired on {day(ends)}"
        renewal = f"{expired}: `tod-runner keys output=DIR rotate=NAME` renews it"
        assert notes == [renewal, f"{expired}; retrying"]
        assert link.fault == f"no control link: MQTT broker at {broker}: {expired}"


def test_another_program_is_named_once_until_the_broker_is_there():
    broker = Endpoint("127.0.0.1", free_port())
    named = "an HTTP server answers there, not a broker; retrying"
    with connecting(broker) as (link, notes):
        with program(broker, says(HTTP, waits=False)):
            until(lambda: named in notes)
            time.sleep(1.0)  # two more attempts
        with private_broker(broker):
            assert link.wait_connected(20)
            until(lambda: link.fault is None)
    assert notes.count(named) == 1
    assert notes[-1] == f"connected to the MQTT broker at {broker}"


@pytest.mark.soak
@pytest.mark.players
@pytest.mark.parametrize(
    "answer, plain, encrypted",
    [
        (says(HTTP, waits=False), "an HTTP server answers there, not a broker; retrying", NO_TLS),
        (says(HTTP), "an HTTP server answers there, not a broker; retrying", NO_TLS),
        (greets, "an SSH server answers there, not a broker; retrying", NO_TLS),
        (says(b"RTSP/1.0 400 Bad Request\r\n\r\n"), "an RTSP server answers there, not a broker; retrying", NO_TLS),
        (
            says(b"220 mail\r\n"),
            "another program, which says b'220 mail\\r\\n', answers there, not a broker; retrying",
            NO_TLS,
        ),
        (says(b"", waits=False), CLOSED, NO_TLS),
        (lambda line: None, CLOSED, NO_TLS),
        (resets, CLOSED, NO_TLS),
        (is_silent, SILENT, SILENT),
        (
            says(b"\x20\x02\0\0", waits=False),
            "the broker ended the connection when this side subscribed; retrying",
            NO_TLS,
        ),
        (says(b"\x20\x02\0\x01", waits=False), "refused: unsupported protocol version; retrying", NO_TLS),
    ],
)
@pytest.mark.parametrize("tls", [False, True])
def test_every_other_program_is_named(tmp_path, answer, plain, encrypted, tls):
    broker = Endpoint("127.0.0.1", free_port())
    keys = issue(tmp_path / "keys") if tls else None
    with program(broker, answer), connecting(broker, keys) as (_, notes):
        until(lambda: notes)
        time.sleep(2.5)
    assert notes == [encrypted if tls else plain]


def ends_after_subscribing(line):
    line.recv(999)
    line.sendall(b"\x20\x02\0\0")  # CONNACK
    subscribed = line.recv(999)
    line.sendall(b"\x90\x03" + subscribed[2:4] + b"\1")  # SUBACK
    time.sleep(0.1)


@pytest.mark.soak
@pytest.mark.players
def test_a_broker_that_ends_each_connection_is_named_once_until_it_does_not():
    broker = Endpoint("127.0.0.1", free_port())
    named = "the broker ends each connection soon after it is made; retrying"
    with connecting(broker) as (link, notes):  # its first attempt may be before the program listens
        with program(broker, ends_after_subscribing):
            until(lambda: named in notes)
            named_at = notes.index(named)
            time.sleep(2.5)
            assert notes[named_at:] == [named]
        with private_broker(broker):
            until(lambda: not link.check() and link.fault is None, every_s=0.2)
    assert notes[-1] == f"connected to the MQTT broker at {broker}"


@pytest.mark.soak
@pytest.mark.players
def test_a_program_that_repeats_what_it_hears_is_named():
    broker = Endpoint("127.0.0.1", free_port())
    with program(broker, echoes), connecting(broker) as (_, notes):
        until(lambda: notes)
        time.sleep(2.5)
    assert len(notes) == 1
    assert notes[0].startswith("another program, which says b'\\x10")


def not_yet(keys):
    """The vehicle's certificate begins in the future: its clock is behind, or the authority's was ahead."""
    return issue(keys, **{NAME: -LATER})


def expired_broker(keys):
    return issue(keys, broker=YEAR + LATER)


def broker_not_yet(keys):
    return issue(keys, broker=-LATER)


def foreign(keys):
    """The vehicle's own certificate is of another authority, which it does not know itself."""
    other = issue(keys.with_name("other"))
    issue(keys)
    for name in (keyring.CERTIFICATE, keyring.KEY):
        shutil.copy(other / NAME / name, keys / NAME / name)
    return keys


def of_another_fleet(keys):
    """All of the vehicle's files are of another authority than the broker's."""
    other = issue(keys.with_name("other"))
    issue(keys)
    shutil.rmtree(keys / NAME)
    shutil.copytree(other / NAME, keys / NAME)
    return keys


def revoked(keys):
    issue(keys)
    old = keys.with_name("old")
    shutil.copytree(keys / NAME, old)
    authority = Authority(keys)
    with authority.opened():
        authority.rotate(NAME)
    shutil.rmtree(keys / NAME)
    shutil.copytree(old, keys / NAME)
    return keys


def wrong_password(keys):
    issue(keys)
    (keys / NAME / keyring.SECRET).write_bytes(b"another")
    return keys


@pytest.mark.soak
@pytest.mark.players
@pytest.mark.parametrize(
    "made, named",
    [
        (not_yet, "own certificate is valid from "),
        (expired_broker, "the broker's certificate has expired, by this machine's clock; retrying"),
        (broker_not_yet, "the broker's certificate is not valid yet, by this machine's clock; retrying"),
        (foreign, "the broker's keys are of another authority than this side's certificate; retrying"),
        (of_another_fleet, "the broker's certificate is of another authority than these keys; retrying"),
        (revoked, "the broker refuses this side's certificate as revoked; retrying"),
        (wrong_password, "refused: not authorized; retrying"),
    ],
)
def test_keys_that_do_not_fit_are_named(tmp_path, made, named):
    broker = Endpoint("127.0.0.1", free_port())
    keys = made(tmp_path / "keys")
    with private_broker(broker, keys / "broker"), connecting(broker, keys) as (_, notes):
        until(lambda: notes)
        time.sleep(2.5)
    assert [note[: len(named)] for note in notes] == [named]


@pytest.mark.soak
@pytest.mark.players
@pytest.mark.parametrize("tls", [False, True])
def test_only_one_side_with_keys_is_named(tmp_path, tls):
    broker = Endpoint("127.0.0.1", free_port())
    keys = issue(tmp_path / "keys")
    with (
        private_broker(broker, None if tls else keys / "broker"),
        connecting(broker, keys if tls else None) as (_, notes),
    ):
        until(lambda: notes)
        time.sleep(2.5)
    assert (
        notes == [NO_TLS]
        if tls
        else notes[0] in (CLOSED, "expects TLS: give keys=DIR, made by `tod-runner keys`; retrying")
    )


def test_certificates_that_expire_soon_are_mentioned_at_the_start(tmp_path):
    broker = Endpoint("127.0.0.1", free_port())
    own, peer = (datetime.now(UTC) + timedelta(days=days, hours=1) for days in (11, 29))
    keys = issue(tmp_path / "keys", **{NAME: timedelta(days=354, hours=-1), "broker": timedelta(days=336, hours=-1)})
    with ExitStack() as stack:
        link, notes = stack.enter_context(connecting(broker, keys))
        renewal = "`tod-runner keys output=DIR rotate=NAME` renews it"
        soon = f"own certificate expires on {day(own)}, in 11 days: {renewal}"
        assert notes[0] == soon  # also without a broker
        stack.enter_context(private_broker(broker, keys / "broker"))
        assert link.wait_connected(20)
        until(lambda: f"the broker's certificate expires on {day(peer)}, in 29 days: {renewal}" in notes)
        assert notes.count(soon) == 1
        assert {whose: day(datetime.fromtimestamp(at, UTC)) for whose, at in link.certificate_ends().items()} | {
            "the authority's": ""
        } == {"own": day(own), "the broker's": day(peer), "the authority's": ""}


def test_a_line_that_cannot_be_written_is_not_the_last():
    lines = []

    def write(line):
        lines.append(line)
        if len(lines) == 1:
            raise OSError("no space left on device")

    words = (*ROBOT, f"media.port={free_port()}", f"control.port={free_port()}")
    with live_vehicle(words, say=write) as live:
        live.start()
        until(lambda: len(lines) > 1)
