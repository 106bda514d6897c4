"""A company's broker and authority carry a drive, and let nobody in whom `tod-runner keys` does not know."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from company import Company
from recipes import lines

from rig import WAIT_S, free_port, passes, process, run, small_robot, until
from runner.core.roles import Role
from runner.mqtt.link import ControlLink, login_of
from runner.operator.live import live_operator
from runner.security.broker_files import foreign_rules
from runner.security.company import CompanyAuthority
from runner.security.keyring import Keyring
from runner.settings import Control, Endpoint, ForeignBroker

pytestmark = pytest.mark.gst

NAME, PREFIX = "delivery_robot", "acme/tod"
HOLDERS = {NAME: Role.VEHICLE, "alice": Role.CONTROLLER, "bob": Role.WATCHER}
RULES = foreign_rules(PREFIX, HOLDERS.items())
WORDS = (
    *small_robot("front"),
    "source=test",
    "fps_max=15",
    "page.serve=false",
    "pqos=constant",
    "control.expires_s=10",
)


def issue(company, output):
    """Keys whose certificates the company has signed."""
    authority = CompanyAuthority(output, bundle=company.ca)
    with authority.opened():
        files = []
        for name, role in HOLDERS.items():
            authority.issue(name, role, ["127.0.0.1"] if role is Role.VEHICLE else [])
            files.append(company.directory / f"{output.name}-{name}.pem")
            files[-1].write_bytes(company.sign(authority.request(name)))
        authority.take(files)
    return output


@pytest.fixture(scope="module")
def company(tmp_path_factory):
    return Company(tmp_path_factory.mktemp("company") / "acme")


@pytest.fixture(scope="module")
def keys(company, tmp_path_factory):
    return issue(company, tmp_path_factory.mktemp("signed") / "keys")


def side(keys, company, name, *words):
    """Words for a side that logs in to the company's broker by user and password."""
    return (
        *WORDS,
        f"keys={keys / name}",
        f"control.prefix={PREFIX}",
        "control.foreign=true",
        f"control.credentials={company.credentials(name, name[::-1])}",
        "control.topics_guarded=true",
        *words,
    )


def published(company, broker, user, topic, *words):
    """What a client says that publishes with a login of the company's."""
    command = ["mosquitto_pub", "-h", broker.host, "-p", str(broker.port), "--cafile", company.ca, "-q", "1"]
    command += ["-u", user, "-P", user[::-1], "-t", topic, *words]
    done = subprocess.run(command, capture_output=True, text=True, timeout=20, check=False)
    return done.stdout + done.stderr


def followed(company, directory, **stand_ins):
    """The recipe of docs/deployment.md, up to what starts; returns the words of each side, and of each doctor's."""
    words = {}
    for name in ("root.pem", "issuing.pem", "issuing.key"):
        shutil.copy(company.directory / name, directory / f"acme-{name}")
    for line in lines("A company's broker and authority"):
        text = line.text
        for written, here in {"tum_q7": NAME, "10.0.0.2": "127.0.0.1", "mqtt.acme.example": "localhost"}.items():
            text = text.replace(written, here)
        verb, *rest = text.removeprefix("tod-runner ").split()
        if verb in ("vehicle", "operator", "doctor"):
            login = company.credentials(NAME, NAME[::-1]) if line.where == "vehicle" else stand_ins["login"]
            place = {"mqtt.login": str(login), "tod-keys": str(directory / "keys" / NAME), "8883": stand_ins["port"]}
            place["keys/alice"] = str(directory / "keys" / "alice")
            own = [word.replace(key, value) for word in rest for key, value in place.items() if key in word]
            words[(verb, line.where)] = [*(word for word in rest if not any(k in word for k in place)), *own, *WORDS]
        elif not text.startswith(("rsync", "chmod")):
            text = text.replace("controller=alice", "controller=alice watcher=bob")
            path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
            subprocess.run(["bash", "-ec", text], cwd=directory, env={**os.environ, "PATH": path}, check=True)
    return words


def test_a_company_s_broker_and_authority_carry_a_drive_and_nobody_acts_for_another(company, tmp_path, tod):
    broker, media = Endpoint("127.0.0.1", free_port()), f"media.port={free_port()}"
    words = followed(company, tmp_path, login=company.credentials("alice", "ecila"), port=str(broker.port))
    vehicle, operator, (_, *doctor) = (
        [*words[key], media] for key in (("vehicle", "vehicle"), ("operator", "operator"), ("doctor", "operator"))
    )
    forged = '{"id": "1", "as_of": 1, "event": "mode_selected", "mode": "single"}'
    requests = f"{PREFIX}/{NAME}/request"
    with company.broker(broker, HOLDERS, (tmp_path / "tod.acl").read_text(), "localhost", "127.0.0.1"):
        diagnosed = tod("doctor", "ros", *doctor).out
        assert f"broker localhost:{broker.port}: lets nobody write in the name of another" in diagnosed
        with process("vehicle", *vehicle), live_operator(operator) as alice:
            alice.start()
            until(lambda: alice.station.samples and alice.station.samples["front"].frames > 10)
            answers = []
            alice.station.ask({"event": "mode_selected", "mode": "collective"}, answers.append)
            assert until(lambda: answers)[0].result == "applied"
            for topic, refused in ((f"{requests}/alice", True), (f"{requests}/bob", False)):
                for version in ("mqttv311", "mqttv5"):
                    said = published(company, broker, "bob", topic, "-m", forged, "-V", version)
                    assert ("Not authorized" in said) == (refused and version == "mqttv5"), (topic, said)
            alice.station.ask({"event": "operator_connected"}, answers.append)
            assert until(lambda: answers[1:])[0].result == "applied"
            assert alice.station.state.mode == "collective"
            until(lambda: alice.station.telemetry.refused > 1)
            assert alice.station.telemetry.refused == 2  # bob's own: those in alice's name have not come


def test_other_certificates_of_the_company_bring_no_pictures(company, keys, tmp_path):
    """A vehicle of the same name whose key nobody asked for, and a viewer whom the vehicle's keys do not know."""
    from test_secure import sending, watching

    others = issue(company, tmp_path / "others")
    intruder = shutil.copytree(others / "bob", tmp_path / "intruder")
    shutil.copy(keys / "bob" / "holders.json", intruder)  # it accepts the vehicle
    with (
        sending(keys) as (plans, reports),
        watching(plans, keys / "bob") as (seen, _),
        watching(plans, intruder) as (none, _),
    ):
        until(lambda: min(seen().values()) > 10, every_s=0.1)
        assert passes(lambda: any("of nobody whom these keys know" in each for each in reports), 10), reports
        assert set(none().values()) == {0}
    for name in ("people.json", "holders.json"):
        shutil.copy(keys / NAME / name, others / NAME)  # it accepts the viewer
    with sending(others) as (plans, _), watching(plans, keys / "bob") as (none, _):
        end = time.monotonic() + 3
        while time.monotonic() < end:
            assert set(none().values()) == {0}
            time.sleep(0.1)


# --- why there is no control link -------------------------------------------------------------------------------------


@contextmanager
def connecting(control, keyring=None):
    """A link of alice's; yields what it reports, after the address."""
    notes, begin = [], f"no control link: MQTT broker at {control}: "
    login = login_of(control, keyring, notes.append)
    listen = {f"tod/{NAME}/state": print}
    link = ControlLink(
        control,
        None,
        listen,
        lambda here: None,
        lambda what: notes.append(what.removeprefix(begin)),
        login,
        prefix=control.prefix,
    )
    link.connect()
    try:
        yield link, notes
    finally:
        link.close()


def test_what_a_company_s_broker_refuses_is_named(company, tmp_path):
    port, other = free_port(), Company(tmp_path / "other")
    ca, right, wrong = str(company.ca), company.credentials("alice", "ecila"), company.credentials("bob", "guessed")
    listing = tmp_path / "listing.pem"
    listing.write_bytes(company.ca.read_bytes() + company.revocations(1).read_bytes())
    by_password = f" (user and password are those of {wrong}); retrying"
    cases = (
        (
            "localhost",
            ForeignBroker(ca, str(right)),
            "acme",
            "control.host is not in the broker's certificate, which must name it; retrying",
        ),
        (
            "127.0.0.1",
            ForeignBroker(str(other.ca), str(right)),
            "acme",
            f"the broker's certificate is of another authority than {other.ca}; retrying",
        ),
        ("127.0.0.1", ForeignBroker(ca, str(wrong)), PREFIX, f"refused: not authorized{by_password}"),
        ("127.0.0.1", ForeignBroker(str(listing), str(right)), PREFIX, ""),
    )
    with company.broker(Endpoint("127.0.0.1", port), HOLDERS, RULES):
        for host, foreign, prefix, why in cases:
            with connecting(Control(host, port, prefix, foreign)) as (link, notes):
                if why:
                    until(lambda: notes)
                    assert notes[0] == why
                else:
                    assert link.wait_connected(WAIT_S)


def test_a_certificate_in_place_of_a_password(company, keys):
    """Of the keys, by which the company's broker knows alice; and one of the company's own."""
    port = free_port()
    own, key = company.issue("card")
    more = "require_certificate true\nuse_subject_as_username true\n"
    rules = "topic read #\n"
    with company.broker(Endpoint("127.0.0.1", port), HOLDERS, rules, more=more):
        for foreign, ring in (
            (ForeignBroker(), Keyring.of(keys / "alice")),
            (ForeignBroker(str(company.ca), None, str(own), str(key)), None),
        ):
            with connecting(Control("127.0.0.1", port, PREFIX, foreign), ring) as (link, notes):
                assert link.wait_connected(WAIT_S), notes


def test_the_doctor_tells_a_broker_that_guards_its_topics_from_one_that_does_not(company, keys, tod):
    port = free_port()
    words = side(keys, company, "alice", f"control.port={port}")
    begin = f"broker 127.0.0.1:{port}: "

    def diagnosed(rules):
        with company.broker(Endpoint("127.0.0.1", port), HOLDERS, rules):
            lines = [line for line in tod("doctor", "ros", *words).out.splitlines() if begin in line]
        return [line.replace(begin, "") for line in lines]

    reached, *guarded = diagnosed(RULES)
    assert reached.startswith("ok      its certificate names it, and is valid until ")
    assert guarded == [
        "ok      login accepted as alice",
        "ok      refuses none of its topics",
        "ok      lets nobody write in the name of another",
    ]
    assert diagnosed("pattern readwrite acme/#\n")[3:] == [
        f"MISSING lets it write {PREFIX}/{NAME}/request/doctor-probe: see its rules"
    ]
    assert diagnosed(RULES.replace("write acme/tod/+/request/alice", "write x"))[2:] == [
        f"MISSING refuses to let it write {PREFIX}/{NAME}/request/alice",
        "ok      lets nobody write in the name of another",
    ]


def test_files_that_do_not_work_are_named_together(company, keys, tmp_path):
    exposed, ca = company.credentials("alice", "ecila"), tmp_path / "ca.pem"
    exposed.chmod(0o644)
    ca.write_text("x")
    own, key = company.issue("old", ends=timedelta(days=-1))
    key.chmod(0o640)
    words = (f"control.ca={ca}", f"control.certificate={own}", f"control.key={key}", f"control.credentials={exposed}")
    done = run("operator", *WORDS, f"keys={keys / 'alice'}", "control.foreign=true", *words)
    assert (done.returncode, done.stdout + done.stderr) == (
        2,
        f"control.ca: {ca}: must contain certificates of the broker's authority (PEM)\n"
        f"control.credentials: {exposed}: others may read it (mode 644); chmod 600\n"
        f"control.key: {key}: others may read it (mode 640); chmod 600\n"
        f"control.certificate: {own}: expired on {datetime.now(UTC) - timedelta(days=1):%Y-%m-%d}\n"
        "4 problems, nothing was started\n",
    )


def test_a_broker_beyond_this_machine_must_guard_its_topics(keys, tod):
    done = tod("operator", *WORDS, f"keys={keys / 'alice'}", "control.foreign=true", "control.host=mqtt.acme.example")
    assert (done.status, done.err.strip()) == (
        2,
        "command line: control.topics_guarded: false: the broker at mqtt.acme.example must let nobody write to the "
        "topics of another: give it the rules that `tod-runner keys output=DIR rules=true` prints, and then "
        "control.topics_guarded=true",
    )
