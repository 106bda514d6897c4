"""Keys: the files of each holder, their protection, and the effects of rotating and revoking."""

from __future__ import annotations

import json
import os
import re
import stat
import subprocess
import sys
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec, ed25519
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.x509.oid import NameOID
from helpers import out_of_reach

from runner.__main__ import main
from runner.configuration.config import configuration
from runner.core.events import EVENTS
from runner.core.roles import MAY_REQUEST, PEOPLE, Role, denial
from runner.errors import RunError, UserError
from runner.mqtt.login import Login
from runner.mqtt.messages import MAX_MESSAGE_BYTES
from runner.security import keyring
from runner.security.authority import Authority
from runner.security.broker_files import broker_settings
from runner.security.exposure import keyring_of
from runner.security.keyring import Keyring

NOW = datetime(2026, 5, 1, tzinfo=UTC)
FIRST = ("vehicle=car", "host=10.0.0.2,car.example", "controller=alice", "broker=10.0.0.1")


@pytest.fixture
def authority(tmp_path):
    authority = Authority(tmp_path / "keys", lambda: NOW)
    with authority.opened():
        authority.issue("car", Role.VEHICLE, ["10.0.0.2", "car.example"])
        authority.issue("broker", Role.BROKER, ["10.0.0.1"])
        for role in PEOPLE:
            authority.issue(f"a-{role}", role, [])
        yield authority


def certificate(authority, name):
    return x509.load_pem_x509_certificate((authority.directory / name / "own.crt").read_bytes())


def verified(authority, name, *options):
    """Output of OpenSSL, as an independent implementation."""
    directory = authority.directory
    words = ["-CAfile", directory / "authority/ca.crt", *options, directory / name / "own.crt"]
    ended = subprocess.run(["openssl", "verify", *words], capture_output=True, text=True, check=False)
    return ended.stdout + ended.stderr


@pytest.mark.parametrize(
    "age_d, words",
    [
        (300, "ok      car's certificate is valid until {end}"),
        (
            340,
            "MISSING car's certificate expires on {end}, in 25 days: `tod-runner keys output=DIR rotate=car` renews it",
        ),
        (400, "MISSING car's certificate expired on {end}: `tod-runner keys output=DIR rotate=car` renews it"),
        (
            -5,
            "MISSING car's certificate is valid from {begin} on, but it is {now} by this machine's clock: `tod-runner",
        ),
    ],
)
def test_doctor_names_a_certificate_that_expires_within_30_days(tod, tmp_path, age_d, words):
    now = datetime.now(UTC)
    issued = now - timedelta(days=age_d, hours=-1)
    authority = Authority(tmp_path / "keys", lambda: issued)
    with authority.opened():
        authority.issue("car", Role.VEHICLE, [])
    listed = tod("doctor", "ros", f"keys={tmp_path / 'keys' / 'car'}").out.splitlines()
    (line,) = (each for each in listed if "certificate" in each)
    ends, begins = issued + timedelta(days=365), issued - timedelta(hours=1)
    assert line.startswith(words.format(end=f"{ends:%Y-%m-%d}", begin=f"{begins:%Y-%m-%d}", now=f"{now:%Y-%m-%d}"))
    assert line in tod("doctor", "ros", f"keys={tmp_path / 'keys'}").out  # of all holders, as for a demo


@pytest.mark.parametrize(
    "words, why",
    [
        (["vehicle=car", "controller=a,b"], "controller: 'a,b': must be 1 to 64 letters"),
        (["vehicle=car", "controller=car"], "controller: 'car': is taken: car is a vehicle"),
        (["vehicle=car", "broker=10.0.0.1:8883"], "broker: '10.0.0.1:8883': must be addresses or names"),
        (["vehicle=car", "rotate=bob"], "rotate: 'bob': must be one of "),
        (["vehicle=car", "revoke=bob"], "revoke: 'bob': must be one of "),
    ],
)
def test_a_request_that_is_refused_makes_no_keys(tod, tmp_path, words, why):
    output = tmp_path / "keys"
    refused = tod("keys", f"output={output}", *words)
    assert refused.status == 2
    assert why in refused.err.replace("10.0.0.1:8883: must", "'10.0.0.1:8883': must")
    assert {path.name for path in output.iterdir()} <= {"authority"} if output.exists() else True


def test_a_certificate_states_name_role_hosts_and_term(authority):
    car = certificate(authority, "car")
    assert [each.value for each in car.subject] == ["vehicle", "car"]
    assert car.subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value == "car"
    hosts = car.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert [str(each) for each in hosts.get_values_for_type(x509.IPAddress)] == ["10.0.0.2"]
    assert hosts.get_values_for_type(x509.DNSName) == ["car.example", "car"]
    assert car.not_valid_after_utc == NOW + timedelta(days=365)
    assert "own.crt: OK" in verified(authority, "car", "-attime", str(int(NOW.timestamp())), "-purpose", "sslserver")
    assert "own.crt: OK" in verified(authority, "a-watcher", "-attime", str(int(NOW.timestamp())))
    late = str(int((NOW + timedelta(days=366)).timestamp()))
    assert "certificate has expired" in verified(authority, "car", "-attime", late)


def test_secrets_are_readable_by_their_owner_only(authority):
    for path in authority.directory.rglob("*"):
        mode = stat.S_IMODE(path.stat().st_mode)
        if path.is_file() and path.name not in ("ca.crt", "own.crt", "own.json", "crl.pem", ".lock"):
            assert mode == 0o600, path
    assert stat.S_IMODE(authority.directory.stat().st_mode) == 0o700


def test_each_holder_has_the_files_of_its_role(authority):
    common = {"ca.crt", "own.crt", "own.key", "own.secret", "own.json", "crl.pem"}
    extra = {
        "car": {"people.json", "srt.passphrase"},
        "broker": {"passwords", "access", "mosquitto.conf"},
        "a-controller": {"media.secret", "page.token"},
        "a-supervisor": {"media.secret", "page.token"},
        "a-watcher": {"media.secret", "page.token"},
        "a-predictor": set(),
        "a-positioner": set(),
    }
    for name, files in extra.items():
        assert set(os.listdir(authority.directory / name)) == common | files


def test_vehicle_and_operator_derive_the_same_passwords(authority):
    car, operator = Keyring.of(authority.directory / "car"), Keyring.of(authority.directory / "a-controller")
    assert car.people()["a-controller"].rtsp == keyring.rtsp_password(operator.secret, "car")
    assert car.people()["a-controller"].rtsp != keyring.rtsp_password(operator.secret, "another")
    assert car.people()["a-predictor"].rtsp == ""
    passphrase = keyring.srt_passphrase(operator.read(keyring.MEDIA_SECRET), "car")
    assert car.read(keyring.PASSPHRASE).decode() == passphrase
    assert 10 <= len(passphrase) <= 79
    assert {name: person.role for name, person in car.people().items()} == {f"a-{role}": role for role in PEOPLE}


def test_an_empty_secret_is_none_and_the_last_one_stays_in_force(authority, monkeypatch):
    """A file that is copied in place is empty for a moment; anybody could compute what is derived from nothing."""
    monkeypatch.setattr(keyring, "CHECK_S", 0)
    ring, notes = Keyring.of(authority.directory / "a-controller"), []
    token, known = ring.watched(keyring.TOKEN, notes.append), ring.read(keyring.TOKEN)
    (ring.directory / keyring.TOKEN).write_bytes(b"")
    with pytest.raises(UserError, match=f"{keyring.TOKEN}: .*: is empty"):
        ring.read(keyring.TOKEN)
    assert token.get() == known
    assert [note.endswith("is empty; the previous content stays in force") for note in notes] == [True]


def test_files_out_of_reach_are_read_again_when_they_are_back(authority, monkeypatch):
    """As while root copies a directory and then hands it to the user of the side."""
    monkeypatch.setattr(keyring, "CHECK_S", 0)
    ring, notes = Keyring.of(authority.directory / "a-controller"), []
    token, known = ring.watched(keyring.TOKEN, notes.append), ring.read(keyring.TOKEN)
    with out_of_reach(ring.directory):
        assert [token.get(), token.get()] == [known, known]
        with pytest.raises(UserError, match="permission denied"):
            ring.read(keyring.TOKEN)
    (ring.directory / keyring.TOKEN).write_bytes(b"new")
    opened = Path.open
    monkeypatch.setattr(Path, "open", lambda *_: (_ for _ in ()).throw(PermissionError(13, "Permission denied")))
    assert token.get() == known
    monkeypatch.setattr(Path, "open", opened)  # only its owner has changed, which neither time nor size shows
    assert token.get() == b"new"
    assert [note.endswith("permission denied; the previous content stays in force") for note in notes] == [True]


def test_new_keys_for_the_broker_count_once_they_are_complete(authority, monkeypatch):
    """Otherwise a directory that is copied file by file would end the control link."""
    monkeypatch.setattr(keyring, "CHECK_S", 0)
    directory, notes = authority.directory / "a-controller", []
    old_key = (directory / keyring.KEY).read_bytes()
    login = Login(Keyring.of(directory), notes.append)
    authority.rotate("a-controller")
    new_key = (directory / keyring.KEY).read_bytes()
    (directory / keyring.KEY).write_bytes(old_key)
    assert [login.has_changed(), login.has_changed()] == [False, False]
    assert ["own.crt" in note and "the previous content stays in force" in note for note in notes] == [True]
    (directory / keyring.KEY).write_bytes(new_key)
    assert login.has_changed()
    login.refresh()
    assert not login.has_changed()


def test_the_broker_is_reached_with_the_last_keys_while_new_ones_cannot_be_read(authority, monkeypatch):
    monkeypatch.setattr(keyring, "CHECK_S", 0)
    directory = authority.directory / "a-controller"
    login = Login(Keyring.of(directory), lambda note: None)
    password = login.refresh()
    for name in (keyring.KEY, keyring.REVOKED, keyring.SECRET):
        (directory / name).unlink()
    assert (login.has_changed(), login.refresh()) == (False, password)
    assert login.context.cert_store_stats()["crl"] == 1


def test_each_revocation_list_is_later_than_the_one_before(authority):
    """Even within a second: OpenSSL would use the old one, which a server keeps beside the new one."""

    def list_of(name):
        return x509.load_pem_x509_crl((authority.directory / name / keyring.REVOKED).read_bytes())

    times = [list_of("broker").last_update_utc]
    for name in ("a-watcher", "a-predictor", "car"):
        authority.rotate(name)
        times.append(list_of("broker").last_update_utc)
    assert times == sorted(set(times))
    assert times[-1] < NOW
    assert list_of("a-watcher").fingerprint(SHA256()) == list_of("broker").fingerprint(SHA256())


def test_a_network_that_needs_no_keys():
    robot, private, insecure = (
        configuration(["vehicle=delivery_robot", "control.host=10.9.0.1", *words]).setup()
        for words in ([], ["insecure=10.9.0.0/24"], ["insecure=true"])
    )

    def needs(setup, host):
        """Whether keys are needed."""
        try:
            return keyring_of(replace(setup, media=replace(setup.media, host=host))) is not None
        except UserError:
            return True

    assert needs(robot, "10.9.0.2")
    assert not needs(private, "10.9.0.2")
    assert not needs(insecure, "10.9.0.2")
    assert all(needs(private, host) for host in ("10.9.1.2", "car.example", "fd00::1"))
    assert not private.insecure, "which would open ROS, too"


@pytest.mark.parametrize("action", ["rotate", "revoke", "issue"])
@pytest.mark.parametrize(("name", "changes"), [("a-watcher", True), ("car", True), ("a-predictor", False)])
def test_srt_gets_a_new_secret_with_the_keys_that_reveal_it(authority, action, name, changes):
    """SRT has no certificates: whoever knows the passphrase may watch, or send."""
    authority.issue("truck", Role.VEHICLE, [])
    files = (
        authority.directory / "a-controller" / keyring.MEDIA_SECRET,
        authority.directory / "truck" / "srt.passphrase",
    )
    before = [file.read_bytes() for file in files]
    known = next(each for each in authority.holders() if each.name == name)
    getattr(authority, action)(name, *([known.role, ["10.9.9.9"]] if action == "issue" else []))
    secret, passphrase = (file.read_bytes() for file in files)
    assert [secret != before[0], passphrase != before[1]] == [changes, changes]
    assert passphrase.decode() == keyring.srt_passphrase(secret, "truck")


@pytest.mark.parametrize("host", ["münchen.example", "10.0.0.1:8883", "car.example:8554", "a,b", "a b", "-a", ""])
def test_hosts_that_no_certificate_can_name_change_nothing(authority, host):
    before = certificate(authority, "car").serial_number
    rule = "must be addresses or names without a port, in ASCII: an international one begins with xn--"
    with pytest.raises(UserError, match=rf"^command line: host: (.*: )?{rule}$"):
        authority.issue("car", Role.VEHICLE, ["10.0.0.1", host])
    assert certificate(authority, "car").serial_number == before
    assert [each.revoked for each in authority.holders() if each.name == "car"] == [None]


def test_issuing_again_changes_nothing(authority):
    before = certificate(authority, "car").serial_number
    assert not authority.issue("car", Role.VEHICLE, [])
    assert not authority.issue("car", Role.VEHICLE, ["car.example", "10.0.0.2"])
    assert certificate(authority, "car").serial_number == before
    assert authority.issue("car", Role.VEHICLE, ["10.0.0.3"])
    assert certificate(authority, "car").serial_number != before


def killed_here(*_):
    raise KeyboardInterrupt


def test_the_next_run_completes_what_a_killed_run_left_out(authority, monkeypatch):
    with monkeypatch.context() as killed, pytest.raises(KeyboardInterrupt):
        killed.setattr(keyring, "Holder", killed_here)
        authority.issue("bob", Role.WATCHER, [])
    (bob,) = (issued for issued in authority.holders() if issued.name == "bob")
    authority.issue("eve", Role.WATCHER, [])
    assert set(Keyring(authority.directory / "car").people()) == {"eve", *(f"a-{role}" for role in PEOPLE)}
    assert authority.issue("bob", Role.WATCHER, [])
    assert "bob" in Keyring(authority.directory / "car").people()
    assert Keyring(authority.directory / "car").revoked() == {int(bob.serial, 16)}


def test_an_interrupted_revocation_is_completed_by_repeating_it(authority, monkeypatch):
    serial = certificate(authority, "a-watcher").serial_number
    with monkeypatch.context() as killed, pytest.raises(KeyboardInterrupt):
        killed.setattr("runner.security.authority.revocation_list", killed_here)
        authority.revoke("a-watcher")
    assert Keyring(authority.directory / "car").revoked() == set()
    authority.revoke("a-watcher")
    assert Keyring(authority.directory / "car").revoked() == {serial}
    assert "a-watcher" not in Keyring(authority.directory / "car").people()
    assert not (authority.directory / "a-watcher").exists()


def test_new_secrets_that_others_may_read_are_not_used(authority, monkeypatch):
    monkeypatch.setattr(keyring, "CHECK_S", 0)
    ring, notes = Keyring(authority.directory / "car"), []
    passphrase = ring.watched_passphrase(notes.append)
    known, file = passphrase.get(), ring.directory / "srt.passphrase"
    file.unlink()
    file.write_text("another, longer than before")
    file.chmod(0o644)
    assert passphrase.get() == known
    assert "others may read it (mode 644); chmod 600; the previous content stays in force" in notes[0]
    file.chmod(0o600)
    assert passphrase.get() == "another, longer than before"


@pytest.mark.parametrize("action", ["rotate", "revoke"])
def test_all_others_learn_what_was_revoked(authority, action):
    before, secret = certificate(authority, "a-watcher").serial_number, (authority.directory / "a-watcher/own.secret")
    old = secret.read_bytes()
    getattr(authority, action)("a-watcher")
    for name in ("car", "a-controller", "broker"):
        assert Keyring(authority.directory / name).revoked() == {before}
    passwords = (authority.directory / "broker/passwords").read_text()
    people = Keyring(authority.directory / "car").people()
    if action == "rotate":
        assert secret.read_bytes() != old
        assert people["a-watcher"].rtsp == keyring.rtsp_password(secret.read_bytes(), "car")
    else:
        assert not secret.exists()
        assert "a-watcher" not in people
        assert "a-watcher" not in passwords


def test_the_broker_takes_every_message_and_keeps_no_session_for_good():
    settings = dict(line.split(" ", 1) for line in broker_settings("/keys").splitlines())
    header, topic = 5, 2 + 3 * 65  # MQTT 5.0, 2.1; the longest names
    assert MAX_MESSAGE_BYTES + header + topic <= int(settings["max_packet_size"]) < 1.1 * MAX_MESSAGE_BYTES
    assert settings["persistent_client_expiration"] == "1d"


def test_all_problems_of_a_directory_are_reported_together(authority):
    car = authority.directory / "car"
    (car / "own.key").unlink()
    (car / "own.secret").chmod(0o644)
    with pytest.raises(UserError) as raised:
        Keyring.of(car, keyring.MEDIA_SECRET)
    assert str(raised.value).endswith(
        "own.key: no such file or directory; own.secret: others may read it (mode 644); chmod 600; "
        "media.secret: no such file or directory"
    )


def pem(key, encryption):
    form = (serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8)
    return key.private_bytes(*form, encryption)


@pytest.mark.parametrize(
    ("file", "content"),
    [
        ("authority/issued.json", lambda: b'[{"name": "car"'),
        ("authority/issued.json", lambda: b"[{}]"),
        ("car/own.crt", lambda: b"damaged"),
        ("authority/ca.crt", lambda: b"damaged"),
        ("authority/authority.key", lambda: b"damaged"),
        (
            "authority/authority.key",
            lambda: pem(ec.generate_private_key(ec.SECP256R1()), serialization.BestAvailableEncryption(b"secret")),
        ),
        (
            "authority/authority.key",
            lambda: pem(ed25519.Ed25519PrivateKey.generate(), serialization.NoEncryption()),
        ),
    ],
)
def test_a_damaged_file_is_named(tmp_path, capsys, file, content):
    output = tmp_path / "keys"
    assert main(["keys", f"output={output}", *FIRST]) == 0
    (output / file).write_bytes(content())
    assert main(["keys", f"output={output}", "watcher=new"]) == 1
    assert capsys.readouterr().err.startswith(f"{output / file}: not as `tod-runner keys` writes it: ")


def test_a_damaged_certificate_is_renewed_as_advised(tmp_path, capsys):
    output = tmp_path / "keys"
    assert main(["keys", f"output={output}", *FIRST]) == 0
    (output / "car/own.crt").write_bytes(b"damaged")
    assert main(["keys", f"output={output}", "watcher=bob"]) == 1
    assert capsys.readouterr().err.endswith("; rotate=car renews it\n")
    assert main(["keys", f"output={output}", "rotate=car"]) == 0


def test_two_processes_do_not_change_the_same_keys(authority):
    other = Authority(authority.directory)
    with pytest.raises(RunError, match="another process is changing these keys"), other.opened():
        pass


# --- the verb ---------------------------------------------------------------------------------------------------------


def test_one_command_makes_what_a_vehicle_and_an_operator_need(tmp_path, capsys):
    output = tmp_path / "keys"
    assert main(["keys", f"output={output}", *FIRST]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert [line.split()[:2] for line in printed[:3]] == [["vehicle", "car"], ["controller", "alice"], ["broker"] * 2]
    assert printed[0].endswith("10.0.0.2, car.example")
    assert printed[-1] == f"copy to their machines: {output}/alice, {output}/broker, {output}/car"
    secrets = {path.read_text().strip() for path in output.rglob("*") if path.name in ("own.secret", "media.secret")}
    assert not any(secret in line for secret in secrets for line in printed)
    assert main(["keys", f"output={output}", *FIRST]) == 0
    assert "copy" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "command line: output: must be given: the directory for all keys"),
        (("output={}", "vehicle=a b"), "command line: vehicle: 'a b': must be 1 to 64 letters, digits, _ and -"),
        (("output={}", "vehicle=broker"), "command line: vehicle: 'broker': must be 1 to 64 letters"),
        (("output={}", "host=10.0.0.2"), "command line: host: 10.0.0.2: must come with the name of a vehicle"),
        (("output={}", "revoke=x"), "command line: revoke: 'x': must be one of (none yet)"),
        (("output={}", "modes=paper"), "command line: modes=paper: unknown argument; expected one of output, "),
    ],
)
def test_mistakes_are_named(tmp_path, capsys, words, message):
    assert main(["keys", *(word.format(tmp_path / "keys") for word in words)]) == 2
    assert capsys.readouterr().err.startswith(message)


def test_an_expired_certificate_is_listed_as_such(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("runner.security.authority.VALID", timedelta(minutes=-30))
    assert main(["keys", f"output={tmp_path / 'keys'}", "watcher=bob"]) == 0
    assert re.search(r"bob +expired \d{4}-\d\d-\d\d, rotate=bob renews it\n", capsys.readouterr().out)


def test_a_directory_with_other_files_is_not_touched(tmp_path, capsys):
    (tmp_path / "mine.txt").write_text("mine")
    assert main(["keys", f"output={tmp_path}", *FIRST]) == 2
    assert "it contains other files" in capsys.readouterr().err
    assert os.listdir(tmp_path) == ["mine.txt"]


def test_a_name_has_one_role(tmp_path, capsys):
    assert main(["keys", f"output={tmp_path / 'keys'}", *FIRST]) == 0
    assert main(["keys", f"output={tmp_path / 'keys'}", "watcher=alice"]) == 2
    assert "'alice': is taken: alice is a controller" in capsys.readouterr().err


# --- roles x events ---------------------------------------------------------------------------------------------------

OWN = (
    *("link_measured", "copies_counted", "stream_measured", "source_reported"),
    *("control_passed", "control_restored", "attention_changed", "view_reported"),
)
PRESENCE = ("operator_connected", "operator_disconnected")
DRIVEN = {*EVENTS} - {*OWN, "clock_advanced", "bitrate_predicted", "position_reported", "steering_reported"}
ALLOWED = {
    Role.CONTROLLER: DRIVEN - {"control_taken"},
    Role.SUPERVISOR: DRIVEN,
    Role.WATCHER: {*PRESENCE, "stop_requested"},
    Role.PREDICTOR: {"bitrate_predicted"},
    Role.POSITIONER: {"position_reported", "steering_reported"},
    Role.VEHICLE: set(),
    Role.BROKER: set(),
    None: set(),
}


@pytest.mark.parametrize("role", [*Role, None])
@pytest.mark.parametrize("event", EVENTS)
def test_requests_that_roles_may_make(role, event):
    assert (denial(role, event) is None) == (event in ALLOWED[role])


def test_a_denial_names_the_permitted_roles():
    assert set(MAY_REQUEST) == set(Role)
    assert denial(Role.WATCHER, "total_set") == "a watcher may not request total_set; only controller or supervisor may"
    assert denial(Role.WATCHER, "clock_advanced").endswith("; only the vehicle generates it")
    assert denial(None, "total_set") == "unknown operator: not listed in the vehicle's keys"


def test_keys_loads_no_driving_code():
    code = (
        "import sys; import runner.verbs.keys; print([m for m in ('gi', 'hydra', 'numpy', 'paho') if m in sys.modules])"
    )
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "[]"


def test_json_files_are_readable(authority):
    assert json.loads((authority.directory / "car/people.json").read_text())["a-watcher"]["role"] == "watcher"
